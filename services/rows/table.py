"""Measurements as text: one row a line, with or without a line of names; comma, semicolon, tab or blanks between.

Names may say what a column is: a time or a number of the row, which are no measurements; `re`, `im`, `mag`, `phase` at
a name's end; a label of the row, which tells untouched rows from others; the electrodes (`z_0_1_2_3`: drive+, drive-,
sense+, sense-).
"""

from __future__ import annotations

import re
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.files import FileError

MOST_TEXT = 64 * 1024 * 1024
LABELS = {"label", "kind", "state", "class", "type", "touched", "untouched"}
UNTOUCHED = {"untouched", "reference", "ref", "baseline", "background", "empty", "homogeneous", "none"}
BESIDE = re.compile(
    r"(time|timestamp|date|frame|scan|row|index|idx|id|seq|sequence|number|no|n|t|x|y|force|depth|temperature|temp|unnamed)"
    r"([ _]?(s|ms|us|ns|m|mm|n|c|number|no|id|stamp))?(\W.*)?"
)
"""Names of columns that stand beside measurements."""
PART = re.compile(r"(.*?)[ _.\-]*(re|real|im|imag|imaginary|mag|magnitude|abs|phase|arg|angle)", re.IGNORECASE)
REAL, IMAGINARY, MAGNITUDE = {"re", "real"}, {"im", "imag", "imaginary"}, {"mag", "magnitude", "abs"}
MOST_ELECTRODES = 256


class NamedColumns(dict[str, NDArray[Any]]):
    """Arrays of a text, and what of it was understood by its names."""

    understood = ""


def parse_table(text: str, name: str) -> NamedColumns:
    """measurements (n, k), and what else the names tell: untouched (m, k), pattern (k, 4) or (k, 2). Raises
    FileError, which names line and column.
    """
    if len(text) > MOST_TEXT:
        raise FileError(f"{name}: found {len(text)} characters, expected at most {MOST_TEXT}: save it as npz")
    lines = [(at, line.strip()) for at, line in enumerate(text.splitlines(), start=1)]
    remarks = [(at, line.strip("#% ")) for at, line in lines if line[:1] in "#%"]
    lines = [(at, line) for at, line in lines if line and line[0] not in "#%"]
    if not lines:
        raise FileError(f"{name}: found no line of numbers")
    split = _splitter(lines[-1][1])
    rows = [(at, split(line)) for at, line in lines]
    above = _preamble(rows)
    names = _names(rows, [split(line) for at, line in remarks if at < lines[0][0]])
    if names and rows and _holds_text_alone(rows[0][1]):  # units
        above.append(rows.pop(0)[0])
    width = _width(rows, names, name)
    found = _sorted_out(rows, [each.strip("\"' ").lower() for each in names] or [""] * width, name)
    if above:
        found.understood = "; ".join(filter(None, (f"line {', '.join(map(str, above))} left out", found.understood)))
    return found


def _preamble(rows: list[tuple[int, list[str]]]) -> list[int]:
    """Takes the lines before the table from `rows`: of text, and much shorter than most; their numbers."""
    width, taken = Counter(len(cells) for _, cells in rows).most_common(1)[0][0], []
    while len(rows[0][1]) <= width // 2 and any(_number(cell) is None for cell in rows[0][1]):
        taken.append(rows.pop(0)[0])
    return taken


def _holds_text_alone(cells: list[str]) -> bool:
    numbers = [_number(cell) for cell in cells]
    return None in numbers and all(number is None or np.isnan(number) for number in numbers)


def _width(rows: list[tuple[int, list[str]]], names: list[str], name: str) -> int:
    """How many cells each row has. Raises FileError."""
    width = len(names or rows[0][1]) if rows else 0
    if not rows or (width < 2 and len(rows) < 2):
        raise FileError(f"{name}: found no table of numbers, expected one row of measurements a line")
    for at, cells in rows:
        if len(cells) != width:
            raise FileError(f"{name}, line {at}: found {len(cells)} cells, expected {width} as in the first line")
    return width


def _names(rows: list[tuple[int, list[str]]], above: list[list[str]]) -> list[str]:
    """The names of the columns: the first row, taken from `rows`, or the last remark above, as numpy.savetxt has it."""
    first = rows[0][1]
    if _are_names(first):
        return rows.pop(0)[1]
    last = above[-1] if above else []
    return last if len(last) == len(first) and _are_names(last) else []


def _are_names(cells: list[str]) -> bool:
    """Whether the first line names columns: by text, or by their numbers, as pandas does. One of an index is empty."""
    filled = [name for cell in cells if (name := cell.strip("\"' "))]
    counted = len(filled) > 2 and all(map(str.isdecimal, filled)) and _counting(filled) is not None
    return counted or all(_number(cell) is None for cell in filled)


def _counting(names: list[str]) -> NDArray[np.intp] | None:
    """Which column is which measurement, by names that count them up from 0 or 1, in whatever order they stand; None
    where the names do not.
    """
    found = [re.findall(r"\d+", each) for each in names]
    if {len(each) for each in found} != {1}:
        return None
    numbers = np.array([int(each[0][:6]) for each in found])
    order, first = np.argsort(numbers), numbers.min()
    return order if first in (0, 1) and (numbers[order] - first == np.arange(len(numbers))).all() else None


def _splitter(line: str) -> Any:
    """How the cells of this line are parted; beside another sign than the comma, the comma is a decimal one."""
    for sign in (";", "\t"):
        if sign in line:
            return lambda text: [cell.strip().replace(",", ".") for cell in text.split(sign)]
    if "," in line:
        return lambda text: [cell.strip() for cell in text.split(",")]
    return str.split


def _number(cell: str) -> complex | None:
    """None where it is text; NaN where it is empty."""
    cell = re.sub(r"\s*([+-])\s*", r"\1", cell.strip("\"'()[] "))
    if cell.lower() in ("", "na", "n/a", "null", "none", "-"):
        return complex("nan")
    if "_" in cell:
        return None
    try:
        return complex(cell.replace("i", "j") if cell.endswith("i") else cell)
    except ValueError:
        return None


def _sorted_out(rows: list[tuple[int, list[str]]], names: list[str], name: str) -> NamedColumns:
    label = _label(rows, names)
    measured, beside = _measured(rows, names, label)
    table, own, parts = _complex(_numbers(rows, measured, name), [names[at] for at in measured])
    untouched = np.array([label >= 0 and _untouched(cells[label], names[label]) for _, cells in rows])
    splits = untouched.any() and not untouched.all()
    left = beside if splits or label < 0 else [*beside, label]
    notes = [*(f"column {names[at] or at + 1} left out" for at in left), parts]
    found = NamedColumns(measurements=table)
    if splits:
        found |= {"measurements": table[~untouched], "untouched": table[untouched]}
        notes.append(f"{untouched.sum()} rows are `untouched`, as column {names[label] or label + 1} says")
    if (pattern := _pattern(own)) is not None:
        found["pattern"] = pattern
    if (order := _counting(own)) is not None and (order[1:] < order[:-1]).any():
        found |= {each: values[:, order] for each, values in found.items()}
        notes.append("columns put in the order of their numbers")
    found.understood = "; ".join(filter(None, notes))
    return found


def _measured(rows: list[tuple[int, list[str]]], names: list[str], label: int) -> tuple[list[int], list[int]]:
    """The columns of measurements, and those that their names set beside them."""
    index = 0 if any(names) and not names[0] else -1
    beside = [at for at, each in enumerate(names) if at != label and (at == index or BESIDE.fullmatch(each))]
    measured = [at for at in range(len(names)) if at not in (label, *beside)]
    while measured and not any(cells[measured[-1]] for _, cells in rows):  # a sign at the end of each line
        measured.pop()
    return measured, beside


def _label(rows: list[tuple[int, list[str]]], names: list[str]) -> int:
    """The column that says what each row is, by its name or because it is text in every row; -1 where there is none."""
    for at, name in enumerate(names):
        if name in LABELS or (not name and all(_number(cells[at]) is None for _, cells in rows)):
            return at
    return -1


def _numbers(rows: list[tuple[int, list[str]]], wanted: list[int], name: str) -> NDArray[np.complex128]:
    values = np.empty((len(rows), len(wanted)), complex)
    for row, (line, cells) in enumerate(rows):
        for place, at in enumerate(wanted):
            number = _number(cells[at])
            if number is None:
                raise FileError(f"{name}, line {line}, column {at + 1}: found {cells[at][:40]!r}, expected a number")
            values[row, place] = number
    return values


def _untouched(cell: str, column: str) -> bool:
    cell = cell.strip("\"' ").lower()
    if column in ("touched", "untouched"):
        no = cell in ("false", "no", "off") or _number(cell) == 0
        return cell in UNTOUCHED or no == (column == "touched")
    return cell in UNTOUCHED


def _complex(values: NDArray[np.complex128], names: list[str]) -> tuple[NDArray[Any], list[str], str]:
    """The measurements and the name of each, of columns that are parts of complex ones; what was understood."""
    plain: NDArray[Any] = values if values.imag.any() else values.real
    parts = [PART.fullmatch(each) for each in names]
    if not names or not all(parts):
        return plain, names, ""
    named = [(each[1], each[2].lower()) for each in parts if each is not None]
    columns, own = _with_part(named, MAGNITUDE)
    if columns:
        return plain[:, columns], own, "magnitudes by their names"
    columns, own = _with_part(named, REAL)
    imaginary = {of: at for at, of in zip(*_with_part(named, IMAGINARY), strict=True)}
    if not columns or len(imaginary) != len(columns) or not imaginary.keys() >= set(own):
        return plain, names, ""
    values = plain[:, columns] + 1j * plain[:, [imaginary[each] for each in own]]
    return values, own, "real and imaginary parts by their names"


def _with_part(named: list[tuple[str, str]], wanted: set[str]) -> tuple[list[int], list[str]]:
    """The columns that are this part, and whose."""
    found = [(at, of) for at, (of, part) in enumerate(named) if part in wanted]
    return [at for at, _ in found], [of for _, of in found]


def _pattern(names: list[str]) -> NDArray[np.int64] | None:
    """Electrodes that the names of all measurements count up."""
    found = [re.findall(r"\d+", each) for each in names]
    widths = {len(each) for each in found}
    if widths not in ({2}, {4}):
        return None
    rows = np.array([[int(digits[:6]) for digits in each] for each in found])
    counts = rows.max() < MOST_ELECTRODES and len(np.unique(rows, axis=0)) == len(rows) and np.ptp(rows, axis=0).all()
    return rows if counts else None
