"""Voltages on the electrodes that are not the excitation's, and what a setting leaves of them: the electrodes' own
offsets, which blocking capacitors take up after each switch of the multiplexers, and mains that the wires pick up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.scan_response import CAPACITOR_F, LINE_HZ, phasor, transient
from protocol.scan_setting import ScanSetting

SERIES_OHM = 1e3
"""In each loop of two blocking capacitors (docs/hardware.md)."""
WANDERS_S = 60.0
"""Time constant of the offsets' wander: minutes. An assumption, as its size is."""

Volts = NDArray[np.complex128]


@dataclass
class ElectrodeVolts:
    """One skin's. offset_v: standard deviation of the electrodes' steady offsets. wander_v: of what is added to each of
    them in the long run. mains_v: amplitude between two electrodes, root mean square over pairs. Questions come in the
    order of time.
    """

    electrodes: int
    seed: int
    offset_v: float = 0.0
    wander_v: float = 0.0
    mains_v: float = 0.0
    _then: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 47])
        self._steady = self.offset_v * self._rng.standard_normal(self.electrodes)
        self._wander = self.wander_v * self._rng.standard_normal(self.electrodes)
        self._pickup = self._rng.standard_normal(self.electrodes) / np.sqrt(2)
        self._turns = self._rng.random()
        self._held_v = 0.0

    def left(
        self, rows: NDArray[np.int64], instants: NDArray[np.float64], ohm: NDArray[np.float64], setting: ScanSetting
    ) -> Volts:
        """(K,) V that are left in the phasors of voltages that are sensed between electrodes `rows` (K, 4), through
        |Z| of `ohm` (K,), at `instants` [s].
        """
        between = self._offsets(instants, rows)
        steps = np.diff(between, prepend=self._held_v)
        self._held_v = float(between[-1])
        taus = CAPACITOR_F * (SERIES_OHM + ohm / 2)  # two capacitors are in series
        rest = np.array([step * transient(setting, float(tau)) for step, tau in zip(steps, taus, strict=True)])
        picked_up = self.mains_v * (self._pickup[rows[:, 2]] - self._pickup[rows[:, 3]])
        return np.asarray(rest + picked_up * phasor(setting, LINE_HZ, LINE_HZ * instants + self._turns))

    def _offsets(self, instants: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K,) V between the sensing electrodes."""
        passed, self._then = max(0.0, float(instants[-1]) - self._then), float(instants[-1])
        keep = np.exp(-passed / WANDERS_S)
        fresh = self.wander_v * self._rng.standard_normal(self.electrodes)
        self._wander = keep * self._wander + np.sqrt(1 - keep**2) * fresh
        now = self._steady + self._wander
        return np.asarray(now[rows[:, 2]] - now[rows[:, 3]])
