"""The analogue side of the board, from transfer impedances to measured Z: electrodes, multiplexers, DFT, FIFO.

One measurement is a DFT of the voltage and one of the current through RTIA; the board reports Z = V/I * RTIA, from
18-bit registers whose imaginary part has its sign inverted. The sheet's ohm are model ohm (a sheet of 1 S): INPUT_GAIN
brings 10 uA across a few of them into the converter's range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.scan_response import noise as noise_over_papers
from protocol.ad5940 import DATA_MAX, decode_fifo, dft_pair, encode_fifo, impedance
from protocol.frame_types import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA
from protocol.scan_setting import ScanSetting

from .electrode_volts import ElectrodeVolts
from .faults import MUXES, Faults
from .worlds.disturbances import Disturbances

CURRENT_A = 1e-5
FULL_SCALE_V = 0.9  # amplitude the converter takes at PGA 1
INPUT_GAIN = 8000.0
PGA = np.array([9.0, 4.0, 2.0, 1.5, 1.0])
HEADROOM = 0.8
PHASE = np.exp(-0.03j)  # the foam is slightly capacitive
EXCITATION = np.exp(0.7j)  # phase of the current to the DFT's own reference
OPEN_CURRENT = 0.02  # of the nominal current: below, the electrode counts as open
LEAKAGE = 2e-5  # of the nominal current, through an open switch
FLOATING_OHM = 0.05  # voltage at an input that nothing drives, over the nominal current
OVERRANGE = 1e6  # ohm: what the firmware reports at most

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class BoardNoise:
    """sigma^2 = (relative |Z|)^2 + floor^2 with the paper's setting; another one makes of both what it makes of white
    noise (models/scan_response.py).
    """

    relative: float = 1e-4
    floor: float = 0.0

    def sigma(self, z: NDArray[np.float64], setting: ScanSetting) -> NDArray[np.float64]:
        return np.asarray(np.hypot(self.relative * np.abs(z), self.floor) * noise_over_papers(setting))


def four_terminal(transfer: NDArray[np.float64], scan_list: NDArray[np.int64]) -> NDArray[np.float64]:
    """(K,) V(sense+) - V(sense-) over the current drive+ -> drive-."""
    dp, dm, sp, sm = scan_list.T
    return np.asarray(transfer[sp, dp] - transfer[sp, dm] - transfer[sm, dp] + transfer[sm, dm])


def shorted(transfer: NDArray[np.float64], a: int, b: int, ohm: float = 1e-3) -> NDArray[np.float64]:
    """Transfer impedances once electrodes a and b are joined through `ohm`: one rank-one update."""
    u = np.zeros(len(transfer))
    u[a], u[b] = 1.0, -1.0
    tu = transfer @ u
    return np.asarray(transfer - np.outer(tu, u @ transfer) / (u @ tu + ohm))


def clip(amplitude: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
    """Amplitude of the fundamental of a sine cut at `limit`: the describing function of a saturation."""
    r = np.minimum(1.0, limit / np.maximum(amplitude, 1e-300))
    return np.asarray(amplitude * (2 / np.pi) * (np.arcsin(r) + r * np.sqrt(1 - r * r)))


class Analog:
    """Measures scan lists; keeps its random numbers and what the last result was."""

    def __init__(
        self,
        noise: BoardNoise,
        faults: Faults,
        rng: np.random.Generator,
        disturbances: Disturbances | None = None,
        volts: ElectrodeVolts | None = None,
    ) -> None:
        self.noise, self.faults, self.rng, self.disturbances = noise, faults, rng, disturbances
        self.volts = volts

    def measure(
        self,
        transfer: Sequence[NDArray[np.float64]] | NDArray[np.float64],
        scan_list: NDArray[np.int64],
        setting: ScanSetting,
        rtia: float,
        now: float,
        weights: NDArray[np.float64] | None = None,
        instants: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.complex64], NDArray[np.uint8]]:
        """Z (K,) ohm and status (K,) of one scan. transfer: m matrices; weights (K, m): each one's share in what each
        measurement feels. Without weights the sheet goes steadily from the first of two matrices to the second.
        instants (K,): of the measurements, where something disturbs them or lies on the electrodes.
        """
        rows, driven, sensed = self._routed(scan_list, len(transfer[0]), now)
        z = self._sheet(transfer, rows, now, weights)
        if self.disturbances is not None and instants is not None:
            z = z + self.disturbances.ohm(rows, instants, z)
        current = np.full(len(z), CURRENT_A * EXCITATION)
        voltage = z * PHASE * current
        if self.volts is not None and instants is not None:
            voltage = voltage + self.volts.left(rows, instants, np.abs(z) * INPUT_GAIN, setting) / INPUT_GAIN
        sigma = self.noise.sigma(z, setting) * CURRENT_A
        voltage = voltage + sigma * self._normal(len(z))
        if self.faults.active("brown_out", now) is not None:
            driven, sensed = np.zeros_like(driven), np.zeros_like(sensed)
        current = np.where(driven, current, LEAKAGE * CURRENT_A * self._normal(len(z)))
        voltage = np.where(driven & sensed, voltage, FLOATING_OHM * CURRENT_A * self._normal(len(z)))
        registers, status = self._converted(voltage, current, rtia, now)
        registers, status = self._fifo(registers, status, now)
        return self._quotient(registers, status, rtia, now)

    # --- the ways to the sheet ---

    def _routed(
        self, scan_list: NDArray[np.int64], electrodes: int, now: float
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Electrodes that each measurement really reaches, whether current flows, and whether the voltage is real."""
        rows = scan_list.copy()
        reached = np.ones(rows.shape, bool)
        if (stuck := self.faults.active("mux_stuck", now)) is not None:
            k, bit = MUXES.index(stuck["mux"]), 1 << (stuck["bit"] & 3)
            rows[:, k] = (rows[:, k] | bit) if stuck["value"] else (rows[:, k] & ~bit)
        if (disabled := self.faults.active("mux_disabled", now)) is not None:
            reached[:, MUXES.index(disabled["mux"])] = False
        if (swap := self.faults.active("electrodes_swapped", now)) is not None:
            a, b = (e % electrodes for e in swap["electrodes"])
            wires = np.arange(max(electrodes, 16))
            wires[[a, b]] = wires[[b, a]]
            rows = wires[rows]
        if (broken := self.faults.active("electrode_open", now)) is not None:
            reached &= (rows != broken["electrode"]) & (rows != broken["second"])
        reached &= rows < electrodes  # a stuck address bit may lead to where nothing is connected
        return np.minimum(rows, electrodes - 1), np.all(reached[:, :2], axis=1), np.all(reached[:, 2:], axis=1)

    def _sheet(
        self,
        transfer: Sequence[NDArray[np.float64]] | NDArray[np.float64],
        rows: NDArray[np.int64],
        now: float,
        weights: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        if (short := self.faults.active("electrodes_shorted", now)) is not None:
            a, b = (e % len(transfer[0]) for e in short["electrodes"])
            transfer = [shorted(m, a, b) for m in transfer] if a != b else transfer
        z = np.array([four_terminal(m, rows) for m in transfer])
        if weights is None:
            share = (np.arange(len(rows)) + 0.5) / len(rows)
            weights = np.stack([1 - share, share], axis=1)
        return np.asarray(np.einsum("km,mk->k", weights, z))

    # --- the converter ---

    def _converted(
        self, voltage: Complex, current: Complex, rtia: float, now: float
    ) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
        """Registers (K, 4): V re, V im, I re, I im, the imaginary parts inverted."""
        status = np.zeros(len(voltage), np.uint8)
        v = voltage * INPUT_GAIN
        gain = PGA[(np.abs(v)[:, None] * PGA <= HEADROOM * FULL_SCALE_V).argmax(1)]
        gain = np.where(np.abs(v) > HEADROOM * FULL_SCALE_V, 1.0, gain)
        self._gain = gain
        clipped = self.faults.active("clipped", now)
        over = self.faults.active("rtia_overrange", now)
        # too high a gain: the firmware divides by the one it believes in, so only the clipping is felt
        v_limit = HEADROOM * FULL_SCALE_V / clipped["gain"] if clipped else FULL_SCALE_V
        i_limit = HEADROOM * FULL_SCALE_V / over["gain"] if over else FULL_SCALE_V
        v_code, v_hit = _register(v * gain, v_limit)
        i_code, i_hit = _register(current * rtia, i_limit)
        if not (clipped and clipped["silent"]):
            status[v_hit] |= STATUS_CLIPPED
        if not (over and over["silent"]):
            status[i_hit] |= STATUS_RTIA
        return np.concatenate([v_code, i_code], axis=1), status

    def _fifo(
        self, registers: NDArray[np.int32], status: NDArray[np.uint8], now: float
    ) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
        """The registers as the firmware reads them from the FIFO, and what it noticed."""
        k = np.arange(len(status))
        words = encode_fifo(registers).ravel()
        noticed = np.zeros(len(status), bool)
        if (fault := self.faults.active("missed_interrupt", now)) is not None:
            late = self.rng.random(len(k)) < fault["fraction"]
            words = words.reshape(-1, 4)[np.where(late, k - 1, k)].ravel()
            noticed |= late & (not fault["silent"])
        if (fault := self.faults.active("fifo_overflow", now)) is not None:
            n = min(max(fault["words"], 1), len(words))
            at = int(self.rng.integers(0, len(words) - n + 1))
            words = np.concatenate([words[:at], words[at + n :], np.zeros(n, np.uint32)])
            noticed |= (k >= at // 4) & (not fault["silent"])
        if (fault := self.faults.active("fifo_underflow", now)) is not None:
            n = min(max(fault["words"], 1), len(words))
            words = np.concatenate([words[:-n], np.zeros(n, np.uint32)])
            noticed |= (k >= (len(words) - n) // 4) & (not fault["silent"])
        if (fault := self.faults.active("fifo_misaligned", now)) is not None:
            words = np.roll(words, 1)
            noticed |= not fault["silent"]
        return decode_fifo(words)[0].reshape(-1, 4), status | np.where(noticed, STATUS_FIFO, 0).astype(np.uint8)

    # --- the firmware's arithmetic ---

    def _quotient(
        self, registers: NDArray[np.int32], status: NDArray[np.uint8], rtia: float, now: float
    ) -> tuple[NDArray[np.complex64], NDArray[np.uint8]]:
        current_v = np.hypot(registers[:, 2], registers[:, 3]) * (FULL_SCALE_V / DATA_MAX)
        status = status | np.where(current_v < OPEN_CURRENT * CURRENT_A * rtia, STATUS_OPEN, 0).astype(np.uint8)
        z = impedance(registers[:, :2], registers[:, 2:], rtia) / (INPUT_GAIN * self._gain)
        if (stale := self.faults.active("stale_rtia", now)) is not None:
            z = z * (stale["gain"] * np.exp(1j * stale["phase"]))
        if (gain := self.faults.active("gain", now)) is not None:
            z = z * gain["factor"]
        z = np.where(np.isfinite(z), z, OVERRANGE)
        return (z * np.minimum(1.0, OVERRANGE / np.maximum(np.abs(z), 1e-12))).astype(np.complex64), status

    def _normal(self, n: int) -> Complex:
        return self.rng.standard_normal(n) + 1j * self.rng.standard_normal(n)


def _register(volts: Complex, limit: float) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """DFT registers (K, 2), clipped at `limit` V and to 18 bits, and where the converter hit its limit (K,)."""
    size = np.abs(volts)
    hit = size > limit
    if hit.any():
        volts = np.where(hit, volts * clip(size, limit) / np.maximum(size, 1e-300), volts)
    return dft_pair(volts * (DATA_MAX / FULL_SCALE_V)), hit
