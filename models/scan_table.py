"""`skin limits --scan`: what each setting of a scan leaves of noise and disturbances, and how soon a touch is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.scan_limits import INTERFERENCE, SIGNAL_V, EarlyFloor, EarlyTouch, SettingErrors, errors
from models.scan_orders import Neighbours, by_change, by_switching
from models.scan_response import LINE_HZ, MOTOR_HZ, SWITCHING_HZ, decibels, offset_left, sine_left, transient_left
from protocol.part_size import BAUD, frame_bytes, line_load, line_s, parts_on_line
from protocol.scan_setting import NAMED, PAPER, ScanSetting

AFTER_S = (0.005, 0.010, 0.025, 0.100)
JUDGED = 2
"""Which of them settings are compared after: 25 ms, the time in which a reflex has begun. Our choice."""
BAUDS = (BAUD, 2_000_000)
SMALL_F = 10e-9
"""Smaller blocking capacitors that are tried."""
HEAD = """\
{skin}, {measurements} measurements a scan, white noise of {snr_db:g} dB at the paper's setting (the first row).
What is left of disturbances, in dB of their amplitude: of the transient after a switch (100 nF and 1 to 10 kohm, at its
worst), of a steady offset where no capacitor blocks it, of 50 Hz of mains, 300 Hz of a motor, 20 kHz of its drive.
Bears: how far the electrodes' offsets may change after the tare until their transient is as large as the noise, also
with 10 nF. A change of {wander_mv:g} mV is assumed: who bears less does not settle.
All: noise with the transient of that change, and with mains and motor, of each of which the paper's setting leaves
{left:g} of {signal_v:g} V.
"""
NOTHING_DB = -150.0
"""Below it is the rounding of floating point."""
LEFT = ("transient_db", "offset_db", "mains_db", "motor_db", "switching_db")

SETTINGS: tuple[ScanSetting, ...] = (
    PAPER,
    ScanSetting(50_000, 256),
    ScanSetting(50_000, 128),
    ScanSetting(50_000, 64),
    ScanSetting(50_000, 32),
    ScanSetting(75_000, 64),
    ScanSetting(75_000, 32),
    ScanSetting(50_000, 256, window="none"),
    ScanSetting(50_000, 128, window="none"),
    ScanSetting(50_000, 64, window="none"),
    ScanSetting(50_000, 32, window="none"),
    ScanSetting(50_000, 128, window="none", settle_s=200e-6),
    ScanSetting(50_000, 128, window="none", settle_s=400e-6),
    ScanSetting(50_000, 64, window="none", settle_s=100e-6),
    ScanSetting(50_000, 64, window="none", settle_s=400e-6),
    ScanSetting(40_000, 16, 5, "none"),
    ScanSetting(40_000, 16, 5, "hanning"),
    ScanSetting(50_000, 32, 2, "none"),
    ScanSetting(50_000, 32, 2, "hanning"),
    ScanSetting(50_000, 16, 4, "none"),
    ScanSetting(50_000, 16, 4, "hanning"),
    ScanSetting(50_000, 32, 4, "fit"),
    ScanSetting(50_000, 16, 4, "fit"),
    ScanSetting(50_000, 8, 4, "fit"),
)
"""Those of the table: the paper's, coherent ones with and without a window, longer settling (which is the same as to
discard the first cycles), the sinc3 filter before the DFT, and fits of the transient."""


@dataclass(frozen=True)
class ScanLimit:
    """One setting's row. small_bears_v: what it bears with capacitors of 10 nF."""

    setting: ScanSetting
    errors: SettingErrors
    small_bears_v: float
    floors: tuple[EarlyFloor, ...]  # by AFTER_S

    @property
    def judged(self) -> float:
        """What settings are compared by: the product of both floors after 25 ms, so that a per cent of either counts as
        much.
        """
        return self.floors[JUDGED].place_m * self.floors[JUDGED].force

    @property
    def told(self) -> str:
        """The setting and its floors after 25 ms."""
        floor = self.floors[JUDGED]
        return f"{self.setting}: {floor.place_m * 1e3:.3f} mm, {100 * floor.force:.2f} %"

    def figures(self, snr_db: float, measurements: int) -> dict[str, float | str | bool]:
        """As --json has it: units stand in the names; noise is that of a value over the paper's white noise."""
        unit = 10 ** (-snr_db / 20)
        found: dict[str, float | str | bool] = {
            "setting": str(self.setting),
            "pair_us": self.setting.pair_s * 1e6,
            "scan_ms": self.setting.scan_s(measurements) * 1e3,
            "noise": self.errors.white / unit,
            "noise_with_all": self.errors.together / unit,
            "transient_db": decibels(transient_left(self.setting)),
            "offset_db": decibels(offset_left(self.setting)),
            "mains_db": decibels(sine_left(self.setting, LINE_HZ)),
            "motor_db": decibels(sine_left(self.setting, MOTOR_HZ)),
            "switching_db": decibels(sine_left(self.setting, SWITCHING_HZ)),
            "bears_mv": self.errors.bears_v * 1e3,
            "bears_with_10nf_mv": self.small_bears_v * 1e3,
            "settles": self.errors.settles,
        }
        for after_s, floor in zip(AFTER_S, self.floors, strict=True):
            found[f"place_mm_after_{after_s * 1e3:.0f}_ms"] = floor.place_m * 1e3
            found[f"force_percent_after_{after_s * 1e3:.0f}_ms"] = 100 * floor.force
        return found


class ScanTable:
    """All settings on one skin. snr_db: white noise of the paper's setting. wander_v: of the electrodes' offsets since
    the tare. interference: whether floors have that of a mains cable and of a motor in them.
    """

    def __init__(self, skin: str, snr_db: float, per_side: int, wander_v: float, interference: bool) -> None:
        self.skin, self.snr_db, self.wander_v, self.interference = skin, snr_db, wander_v, interference
        touch = EarlyTouch(skin, per_side)
        self.measurements, self.parts = len(touch.order), touch.parts
        self.neighbours = {
            "whole": Neighbours.of(touch.z0, touch.pattern, np.arange(self.measurements)),
            "in parts": Neighbours.of(touch.z0, touch.pattern, touch.order),
            "in parts, least change of |Z|": Neighbours.of(
                touch.z0, touch.pattern, by_change(touch.z0, touch.order, touch.parts)
            ),
            "in parts, fewest switches": Neighbours.of(
                touch.z0, touch.pattern, by_switching(touch.pattern, touch.order, touch.parts)
            ),
        }
        self.rows = [self._row(touch, setting) for setting in SETTINGS]

    def _row(self, touch: EarlyTouch, setting: ScanSetting) -> ScanLimit:
        change = self.neighbours["in parts"].change
        of = errors(setting, self.snr_db, change, self.wander_v)
        small = errors(setting, self.snr_db, change, self.wander_v, SMALL_F)
        floors = tuple(touch.floor(setting, of, after_s, self.interference) for after_s in AFTER_S)
        return ScanLimit(setting, of, small.bears_v, floors)

    def best(self, fits: bool) -> ScanLimit | None:
        """The setting that settles with the lowest floors after 25 ms. fits: also of fits of the transient."""
        rows = [row for row in self.rows if row.errors.settles and (fits or row.setting.window != "fit")]
        return min(rows, key=lambda row: row.judged, default=None)

    def json(self) -> dict[str, object]:
        """Everything, for a program."""
        given = {
            "skin": self.skin,
            "snr_db": self.snr_db,
            "wander_mv": self.wander_v * 1e3,
            "interference": self.interference,
        }
        orders = {
            name: {"change_of_z": each.change, "lines_switched": each.switched}
            for name, each in self.neighbours.items()
        }
        return {
            "case": given,
            "orders": orders,
            "rows": [row.figures(self.snr_db, self.measurements) for row in self.rows],
        }

    def text(self) -> str:
        """For a person."""
        return "\n".join(
            [
                *self._head(),
                *self._left(),
                "",
                *self._floors(),
                "",
                *self._orders(),
                "",
                *self._line(),
                "",
                *self._finding(),
            ]
        )

    def _head(self) -> list[str]:
        return HEAD.format(
            skin=self.skin,
            measurements=self.measurements,
            snr_db=self.snr_db,
            wander_mv=self.wander_v * 1e3,
            left=INTERFERENCE,
            signal_v=SIGNAL_V,
        ).splitlines()

    def _left(self) -> list[str]:
        names = ("scans/s", "noise", "all", "transient", "offset", "50 Hz", "300 Hz", "20 kHz", "bears mV", "10 nF mV")
        lines = [f"{'setting':<42}" + "".join(f"{name:>10}" for name in names) + "  settles"]
        for row in self.rows:
            told = row.figures(self.snr_db, self.measurements)
            rate = 1 / row.setting.scan_s(self.measurements)
            cells = [f"{rate:10.1f}", f"{told['noise']:10.2f}", f"{told['noise_with_all']:10.2f}"]
            cells += [_decibels(float(told[key])) for key in LEFT]
            cells += [f"{told[key]:10.2f}" for key in ("bears_mv", "bears_with_10nf_mv")]
            lines.append(f"{row.setting!s:<42}" + "".join(cells) + ("      yes" if row.errors.settles else "       no"))
        return lines

    def _floors(self) -> list[str]:
        heard = "with mains and motor" if self.interference else "without mains and motor"
        lines = [
            "A touch of 2 N with a radius of 10 mm, this long after it began, at any moment of a scan in parts, "
            f"{heard}:",
            "what no estimator beats, root mean square over the skin; place in mm, force in % (its size is unknown).",
            f"{'setting':<42}" + "".join(f"{f'{after_s * 1e3:.0f} ms':>17}" for after_s in AFTER_S) + "  settles",
        ]
        for row in self.rows:
            cells = "".join(f"{each.place_m * 1e3:9.3f} {100 * each.force:5.2f} %" for each in row.floors)
            lines.append(f"{row.setting!s:<42}" + cells + ("      yes" if row.errors.settles else "       no"))
        return lines

    def _orders(self) -> list[str]:
        lines = [
            "Orders of the measurements: mean step of |Z|, and lines that change their electrode, from one to the next"
        ]
        for name, each in self.neighbours.items():
            lines.append(f"{name:<42}{100 * each.change:8.0f} %{each.switched:10.2f} of 2")
        return lines

    def _line(self) -> list[str]:
        lines = [
            "The line: a part of the scan measured, on the line, and the line's load; scan settings by their names"
        ]
        for name, setting in NAMED.items():
            for baud in BAUDS:
                parts = parts_on_line(self.measurements, self.parts, setting, baud)
                each = self.measurements // parts
                load = line_load(self.measurements, parts, setting, baud)
                lines.append(
                    f"{name:<12}{baud:>10} baud{parts:>4} parts of {each}, {frame_bytes(each)} bytes: "
                    f"{1e3 * setting.scan_s(each):.2f} ms, {1e3 * line_s(each, baud):.2f} ms, {100 * load:.0f} %"
                )
        return lines

    def _finding(self) -> list[str]:
        best, fitted = self.best(fits=False), self.best(fits=True)
        if best is None or fitted is None:
            return ["No setting settles."]
        paper = next(row for row in self.rows if row.setting == PAPER)
        lines = [
            f"Lowest floors after {AFTER_S[JUDGED] * 1e3:.0f} ms of the settings that settle (place times force):",
            f"by the chip's own DFT      {best.told}",
            f"the paper's                {paper.told}",
        ]
        if fitted is not best:
            lines.append(f"samples read and fitted    {fitted.told}")
        return lines


def _decibels(value: float) -> str:
    return f"{value:10.0f}" if value > NOTHING_DB else f"{'nothing':>10}"
