"""What a scan setting makes of noise, of settling, of offsets and of interference (numpy only).

Every value is linear in the converter's raw samples: a sum of them with complex weights, those of the DFT with its
window and, where there is one, of the sinc3 filter before it (AD5940 data sheet, "DFT", "Hanning window", "sinc3
filter"). Its response to anything is that sum. Shares are of the amplitude of the measured sine.

A blocking capacitor holds the offset between the electrodes that it was connected to last. After a switch of the
multiplexers it charges to that of the new ones through the foam: an exponential, of which the DFT sees the rest.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protocol.scan_setting import PAPER, SAMPLES_HZ, ScanSetting

Weights = NDArray[np.complex128]

CAPACITOR_F = 100e-9
"""Blocking capacitor of docs/hardware.md."""
LOOP_OHM = (1e3, 10e3)
"""Least and most resistance that it charges through. Least: the series resistor alone. Most: half of the |Z| of 9 to 23
kohm that docs/hardware.md's range is made for, since two capacitors are in series. With 100 nF: 0.1 to 1 ms."""
FITTED_S = 2e-4
"""Time constant of a fit's exponential: near the geometric mean of those above. Our choice."""
TIMES = 41  # time constants tried, from the least to the most: a step of 6 %
LINE_HZ = 50.0  # of the stub's world "line"
MOTOR_HZ = 300.0  # highest of the stub's world "sweep"
SWITCHING_HZ = 20e3  # at which a motor's drive switches its current. Our choice


@lru_cache(maxsize=64)
def weights(setting: ScanSetting) -> Weights:
    """(M,) what each raw sample, since the settling's end, counts in a value; a sine's value is its phasor."""
    taken = _fit(setting) if setting.window == "fit" else _dft(setting)
    raw = taken if setting.sinc3 == 1 else _through_sinc3(taken, setting.sinc3)
    made: Weights = raw * (2 / abs(_response(raw, setting.frequency_hz)))
    made.setflags(write=False)
    return made


def _dft(setting: ScanSetting) -> Weights:
    n = np.arange(setting.points)
    window = np.ones(len(n)) if setting.window == "none" else np.sin(np.pi * n / len(n)) ** 2
    return np.asarray(window * np.exp(-2j * np.pi * setting.cycles * n / len(n)))


def _fit(setting: ScanSetting) -> Weights:
    """Of the least squares of sine, cosine, constant and exponential: the first two's rows of the pseudo-inverse."""
    t = np.arange(setting.points) * setting.sinc3 / SAMPLES_HZ
    turn = 2 * np.pi * setting.frequency_hz * t
    columns = np.column_stack([np.cos(turn), np.sin(turn), np.ones_like(t), np.exp(-t / FITTED_S)])
    rows = np.linalg.pinv(columns)
    return np.asarray(rows[0] - 1j * rows[1])


def _through_sinc3(taken: Weights, samples: int) -> Weights:
    """What raw samples count where each of the `taken` is one of the filter's outputs: three means in a row."""
    mean = np.full(samples, 1 / samples)
    kernel = np.convolve(np.convolve(mean, mean), mean)
    spread = np.zeros((len(taken) - 1) * samples + 1, complex)
    spread[::samples] = taken
    return np.convolve(spread, kernel)


def _response(raw: Weights, frequency_hz: float) -> complex:
    n = np.arange(len(raw))
    return complex(np.sum(raw * np.exp(2j * np.pi * frequency_hz * n / SAMPLES_HZ)))


def noise(setting: ScanSetting) -> float:
    """Standard deviation of a value under white noise of the raw samples, over that of the paper's setting."""
    return float(np.linalg.norm(weights(setting)) / np.linalg.norm(weights(PAPER)))


def sine_left(setting: ScanSetting, frequency_hz: float) -> float:
    """Share of a foreign sine that is left in a value, at its worst phase."""
    found = weights(setting)
    there, back = _response(found, frequency_hz), _response(found, -frequency_hz)
    return abs(found.sum()) if frequency_hz == 0 else (abs(there) + abs(back)) / 2


def phasor(setting: ScanSetting, frequency_hz: float, turns: NDArray[np.float64]) -> Weights:
    """What is left of foreign sines of amplitude 1 that have made so many turns when they begin to be sampled."""
    found = weights(setting)
    turned = np.exp(2j * np.pi * turns)
    there, back = _response(found, frequency_hz), _response(found, -frequency_hz)
    return np.asarray((there * turned - back * turned.conj()) / 2j)


def offset_left(setting: ScanSetting) -> float:
    """Share of a steady voltage that is left in a value: of the electrodes' offset, where no capacitor blocks it."""
    return sine_left(setting, 0.0)


def transient(setting: ScanSetting, tau_s: float) -> complex:
    """What a value of the voltage holds of exp(-t / tau_s), t from the switch of the multiplexers on."""
    t = setting.settle_s + np.arange(len(weights(setting))) / SAMPLES_HZ
    return complex(np.sum(weights(setting) * np.exp(-t / tau_s)))


def transient_left(setting: ScanSetting, capacitor_f: float = CAPACITOR_F) -> float:
    """The same, of the time constant that leaves most, over LOOP_OHM."""
    times = capacitor_f * np.geomspace(*LOOP_OHM, TIMES)
    return max(abs(transient(setting, float(tau))) for tau in times)


def decibels(share: float) -> float:
    """Of an amplitude; -200 where less is left than floating point can tell."""
    return float(20 * np.log10(max(share, 1e-10)))
