"""Presses of known force from a CSV file, and back.

A line of names, then one press a line. `force_n` [N] and either what an image showed of it

    force_n,x_m,y_m,peak_s_per_m,integral_s_m,area_m2,noise,peak_sigma_s_per_m,whole_s_m,tip_m

(from noise on, a column may be left out, a cell be empty),

which is what `skin calibrate force --save` writes, or, with a file of measurements beside it (touched, untouched (n, k)
or measurements, untouched, as `skin reconstruct` reads it), the row there that was measured under that force:

    force_n,row,tip_m                                            (rows count from 0; tip_m may be left out)
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from models.files import FileError, read_text
from services.calibration.force_fit import CalibrationError, Press
from services.contacts.force import Look

SHOWN = ("x_m", "y_m", "peak_s_per_m", "integral_s_m", "area_m2")
MAY = ("noise", "peak_sigma_s_per_m", "whole_s_m", "tip_m")  # whole_s_m: integral with the faint rest of the image
COLUMNS = ("force_n", *SHOWN, *MAY)


def read(path: Path, look_of: Callable[[int], Look] | None = None) -> list[Press]:
    """The presses of a file. look_of: what the image of a row of the measurements shows; raises ValueError.

    Raises CalibrationError, which names line and column.
    """
    try:
        rows = list(csv.reader(read_text(path).splitlines()))
    except FileError as why:
        raise CalibrationError(str(why)) from None
    except csv.Error as why:
        raise CalibrationError(f"{path} is no CSV file: {why}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    wanted = ("force_n", "row") if look_of is not None else ("force_n", *SHOWN)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise CalibrationError(
            f"{path}, line 1: found columns {', '.join(names) or 'none'}; missing {', '.join(missing)}; "
            f"expected {', '.join(wanted)}" + ("" if look_of or "row" not in names else " (or --measurements FILE.npz)")
        )
    return [
        _press(path, number, dict(zip(names, row, strict=False)), look_of)
        for number, row in enumerate(rows[1:], start=2)
        if any(cell.strip() for cell in row)
    ]


def _press(path: Path, number: int, cells: dict[str, str], look_of: Callable[[int], Look] | None) -> Press:
    where = f"{path}, line {number}"

    def value(name: str, least: float = -math.inf) -> float:
        text = cells.get(name, "").strip()
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and found > least):
            bound = "" if least == -math.inf else f" above {least:g}"
            raise CalibrationError(f"{where}, column {name}: found {text!r}, expected a number{bound}")
        return found

    def given(name: str) -> float | None:
        return value(name, 0.0) if cells.get(name, "").strip() else None

    force, tip = value("force_n", 0.0), given("tip_m")
    if look_of is not None:
        row = value("row", -1.0)
        try:
            return Press(force, look_of(int(row)), where, tip)
        except ValueError as why:
            raise CalibrationError(f"{where}, column row: found {int(row)}: {why}") from None
    x, y = value("x_m"), value("y_m")
    peak, integral, area = (value(name, 0.0) for name in SHOWN[2:])
    sigma, whole = given("peak_sigma_s_per_m") or 0.0, given("whole_s_m") or 0.0
    return Press(force, Look(peak, sigma, integral, area, x, y, given("noise"), whole), where, tip)


def write(path: Path, presses: Sequence[Press]) -> None:
    """The first form of the file. Raises OSError."""
    with path.open("w", encoding="utf-8", newline="") as out:
        lines = csv.writer(out)
        lines.writerow(COLUMNS)
        for p in presses:
            k = p.look
            may = ("" if not v else f"{v:.6g}" for v in (k.noise, k.peak_sigma, k.whole, p.tip_m))
            lines.writerow([p.force_n, *(f"{v:.6g}" for v in (k.x, k.y, k.peak, k.integral, k.area)), *may])
