"""Presses of known force from a CSV file, and back.

A line of names, then one press a line. `force_n` [N] and either what was seen of it, and each one's relative sigma

    force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m,
    pressure_relative,peak_relative,integral_relative,indenter_m,tip_m

(from pressure_relative on, a column may be left out, a cell be empty; indenter_m: the radius that skin.toml named as
`indenter`, by which the quantities were read),

which is what `skin calibrate force --save` writes, or, with a file of measurements beside it (touched, untouched (n, k)
or measurements, untouched, as `skin reconstruct` reads it), the row there that was measured under that force:

    force_n,row,tip_m                                            (rows count from 0; tip_m may be left out)
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from models.files import FileError, read_text
from protocol.whole_file import whole_file
from services.calibration.force_fit import CalibrationError, Press
from services.calibration.seen import SeenTouch
from services.contacts.force.calibration_file import Of
from services.contacts.force.curve import Quantity

QUANTITIES: dict[Of, str] = {"pressure": "pressure_n", "peak": "peak_s_per_m", "integral": "integral_s_m"}
SEEN = ("x_m", "y_m", *QUANTITIES.values())
MAY = (*(f"{of}_relative" for of in QUANTITIES), "indenter_m", "tip_m")
WRITTEN = 1e-5  # relative: as exactly as numbers are written
COLUMNS = ("force_n", *SEEN, *MAY)


def read(path: Path, indenter_m: float | None = None, seen_in: Callable[[int], SeenTouch] | None = None) -> list[Press]:
    """The presses of a file. indenter_m: radius that skin.toml names. seen_in: what is seen in a row of the
    measurements; raises ValueError.

    Raises CalibrationError, which names line and column.
    """
    try:
        rows = list(csv.reader(read_text(path).splitlines()))
    except FileError as why:
        raise CalibrationError(str(why)) from None
    except csv.Error as why:
        raise CalibrationError(f"{path} is no CSV file: {why}") from None
    names = [name.strip() for name in rows[0]] if rows else []
    wanted = ("force_n", "row") if seen_in is not None else ("force_n", *SEEN)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise CalibrationError(
            f"{path}, line 1: found columns {', '.join(names) or 'none'}; missing {', '.join(missing)}; "
            f"expected {', '.join(wanted)}" + ("" if seen_in or "row" not in names else " (or --measurements FILE.npz)")
        )
    return [
        _press(_Line(f"{path}, line {number}", dict(zip(names, row, strict=False))), indenter_m, seen_in)
        for number, row in enumerate(rows[1:], start=2)
        if any(cell.strip() for cell in row)
    ]


@dataclass(frozen=True)
class _Line:
    """One line of the file: where it stands, for a person, and its cells by column."""

    where: str
    cells: dict[str, str]

    def value(self, column: str, least: float = -math.inf) -> float:
        """Raises CalibrationError for what is no number above `least`."""
        text = self.cells.get(column, "").strip()
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and found > least):
            bound = "" if least == -math.inf else f" above {least:g}"
            raise CalibrationError(f"{self.where}, column {column}: found {text!r}, expected a number{bound}")
        return found

    def optional(self, column: str) -> float | None:
        return self.value(column, 0.0) if self.cells.get(column, "").strip() else None


def _press(line: _Line, indenter_m: float | None, seen_in: Callable[[int], SeenTouch] | None) -> Press:
    force, tip = line.value("force_n", 0.0), line.optional("tip_m")
    if seen_in is not None:
        row = line.value("row", -1.0)
        try:
            return Press(force, seen_in(int(row)), line.where, tip)
        except ValueError as why:
            raise CalibrationError(f"{line.where}, column row: found {int(row)}: {why}") from None
    known = line.optional("indenter_m")
    if (known is None) != (indenter_m is None) or not math.isclose(known or 0.0, indenter_m or 0.0, rel_tol=WRITTEN):
        raise CalibrationError(
            f"{line.where}, column indenter_m: found {known}, skin.toml names {indenter_m}: quantities were read by "
            "another one; press again, or put that `indenter` back"
        )
    found = {of: Quantity(line.value(name, 0.0), line.optional(f"{of}_relative")) for of, name in QUANTITIES.items()}
    return Press(force, SeenTouch(line.value("x_m"), line.value("y_m"), found), line.where, tip)


def write(path: Path, presses: Sequence[Press], indenter_m: float | None = None) -> None:
    """The first form of the file. indenter_m: radius that skin.toml names. Raises OSError."""
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as out:
        lines = csv.writer(out)
        lines.writerow(COLUMNS)
        for p in presses:
            found = [p.seen.quantities[of] for of in QUANTITIES]
            known = [p.seen.x, p.seen.y, *(q.value for q in found)]
            may = [*(q.relative for q in found), indenter_m, p.tip_m]
            lines.writerow([p.force_n, *(f"{v:.6g}" for v in known), *(f"{v:.6g}" if v else "" for v in may)])
