"""How a board measures one pair of electrodes: frequency, points, filter, window and settling, and what time they take.

The facts are the AD5940's: the clocks that its maker's library waits, and 800 kSPS of its data sheet ("Features"). The
limit of 80 kHz was not looked up there. What a setting makes of noise and disturbances: models/scan_response.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from .errors import EitskinError

CLOCK_HZ = 16e6
"""The AD5940's system clock."""
SAMPLES_HZ = 800e3
"""Samples that its converter takes a second in the low-power mode, one each 20 clocks."""
CLOCKS_A_SAMPLE = 20
DFT_CLOCKS = 25
"""Clocks until the DFT's result is in the FIFO (the maker's library waits so long)."""
SINC3_AHEAD = 2
"""Outputs that the sinc3 filter needs to fill, before its first one counts."""
MOST_HZ = 80_000
"""Beyond it the AD5940 needs its high-power mode, with another clock and twice the samples."""
LEAST_HZ = 1_000
"""Below it a capacitor of 100 nF is in the way: 1.6 kohm. Our choice."""
POINTS = tuple(2**k for k in range(2, 15))
"""What the DFT can take."""
FITTED_POINTS = tuple(2**k for k in range(3, 8))
"""Samples of a fit: four unknowns need more than four, and the FIFO holds so many of voltage and current."""
FIT_LEAST_SINC3 = 4
"""Every sample of a fit crosses the SPI: 32 bits at 16 MHz are 2 us. One of two raw samples comes each 2.5 us, which
leaves no reserve; one of four each 5 us."""
MOST_SETTLE_S = 0.01
"""Our choice: 100 time constants of a blocking capacitor of 100 nF and 1 kohm."""

Window = Literal["none", "hanning", "fit"]
WINDOWS: tuple[Window, ...] = get_args(Window)
Sinc3 = Literal[1, 2, 4, 5]
SINC3: tuple[Sinc3, ...] = get_args(Sinc3)


class ScanSettingError(EitskinError, ValueError):
    """No board can measure so: says what was found and what is allowed."""


@dataclass(frozen=True)
class ScanSetting:
    """How each pair is measured. Raises ScanSettingError.

    frequency_hz: of the excitation. points: of each DFT. sinc3: how many raw samples of 800 kSPS the sinc3 filter makes
    one of before the DFT; 1: none, the DFT takes raw samples. window: of the DFT; "fit" is no DFT: the microcontroller
    fits sine, cosine, constant and a decaying exponential to `points` samples of the sinc3 filter. settle_s: before the
    voltage is measured, and again before the current is.
    """

    frequency_hz: int = 40_000
    points: int = 128
    sinc3: Sinc3 = 1
    window: Window = "hanning"
    settle_s: float = 20e-6

    def __post_init__(self) -> None:
        if wrong := self._wrong():
            raise ScanSettingError(wrong)

    def _wrong(self) -> str:
        """Why no board can measure so; "" where one can."""
        if self.window not in WINDOWS:
            return f"window {self.window!r}: expected one of {', '.join(WINDOWS)}"
        if self.sinc3 not in SINC3:
            return f"sinc3 of {self.sinc3} samples: expected {', '.join(map(str, SINC3))}; 1 is none"
        points = FITTED_POINTS if self.window == "fit" else POINTS
        if self.points not in points:
            of = "points of a fit" if self.window == "fit" else "DFT points"
            return f"{self.points} {of}: a power of two from {points[0]} to {points[-1]}"
        if self.window == "fit" and self.sinc3 < FIT_LEAST_SINC3:
            return f"a fit with sinc3 of {self.sinc3}: at least {FIT_LEAST_SINC3}, else samples outrun the SPI"
        highest = int(min(MOST_HZ, SAMPLES_HZ / self.sinc3 / 3))
        if not LEAST_HZ <= self.frequency_hz <= highest:
            return f"{self.frequency_hz} Hz: {LEAST_HZ} to {highest} with this filter"
        if self.cycles < 2:
            return f"{self.cycles:.3g} cycles in {self.points} points at {self.frequency_hz} Hz: at least 2"
        if not 0 <= self.settle_s <= MOST_SETTLE_S:
            return f"settling for {self.settle_s} s: 0 to {MOST_SETTLE_S}"
        return ""

    @property
    def cycles(self) -> float:
        """Cycles of the excitation within a DFT's points."""
        return self.frequency_hz * self.points * self.sinc3 / SAMPLES_HZ

    @property
    def coherent(self) -> bool:
        """Whether these are a whole number: then a steady signal needs no window."""
        return abs(self.cycles - round(self.cycles)) < 1e-9

    @property
    def dft_s(self) -> float:
        """Seconds that one DFT takes: 20 N + 25 clocks of raw samples; the sinc3 filter has to fill first."""
        samples = self.points if self.sinc3 == 1 else (self.points + SINC3_AHEAD) * self.sinc3 + 1
        return (CLOCKS_A_SAMPLE * samples + DFT_CLOCKS) / CLOCK_HZ

    @property
    def pair_s(self) -> float:
        """Seconds that a measurement takes: settling and a DFT, of the voltage and of the current."""
        return 2 * (self.dft_s + self.settle_s)

    def scan_s(self, measurements: int) -> float:
        """Seconds of a scan of so many measurements."""
        return measurements * self.pair_s

    def __str__(self) -> str:
        taken = "raw" if self.sinc3 == 1 else f"sinc3 {self.sinc3}"
        window = {"none": "no window", "hanning": "Hanning", "fit": "fit"}[self.window]
        return f"{self.frequency_hz / 1e3:g} kHz, N {self.points}, {taken}, {window}, {self.settle_s * 1e6:.3g} us"


PAPER = ScanSetting()
"""The paper's: 40 kHz, raw samples, N = 128, Hanning. Settling of 20 us is ours."""
COHERENT = ScanSetting(50_000)
"""The default: 16 samples a cycle, eight whole cycles in 128 points. As quick as the paper's and no noisier, but the
Hanning window's zeros then lie on what is steady (`skin limits --scan`)."""
SettingName = Literal["coherent", "paper", "quick", "fit"]
NAMED: dict[SettingName, ScanSetting] = {
    "coherent": COHERENT,
    "paper": PAPER,
    "quick": ScanSetting(50_000, 64),
    "fit": ScanSetting(50_000, 16, 4, "fit"),
}
"""What skin.toml's `scan_setting` may say. quick: twice the scans, each value with 1.4 times the noise. fit: of samples
that the microcontroller reads; the lowest floors in a third less time than the default."""
WITH_POINTS: tuple[SettingName, ...] = ("coherent", "paper")
"""Those whose points skin.toml's `dft_points` may raise."""
