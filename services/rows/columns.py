"""Arrays of a file as rows by measurements of a skin: by their names and shapes, where one reading fits.

Where several fit, the file is refused with the likely one and the option that says it. A fit to the skin may speak
against a reading, never for one. K measurements of the skin.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.patterns import NAMES, pattern
from services.rows.order import ORDERS, InputError, Places, by_pattern
from services.rows.table import NamedColumns

Arrays = dict[str, NDArray[Any]]

OTHER_NAMES = {
    "measurements": ("measurement", "meas", "data", "frames", "rows", "impedance", "impedances", "voltage", "voltages")
    + ("vi", "real", "magnitude", "amplitude", "abs", "z"),
    "untouched": ("baseline", "background", "homogeneous", "empty", "vh"),
    "touched": (),
    "reference": ("references", "ref"),
    "delta": ("deltas", "difference", "differences", "dv"),
}
"""What people call them: vh and vi are EIDORS's."""
ROWS = ("measurements", "touched", "untouched", "reference", "delta")
PARTS = [("real", "imaginary"), ("real", "imag"), ("re", "im")]
PARTS += [(name, "phase") for name in ("magnitude", "amplitude", "mag", "abs")]
FITS, FAILS = 0.95, 0.8  # correlation of log |Z| with the skin's prediction, of an order that does and does not
MOST_BESIDE = 8  # columns before the measurements, such as a time


@dataclass(frozen=True)
class ReadingOptions:
    """What a person says of a file: the options of these names."""

    columns: str = ""
    order: str | NDArray[Any] = ""  # --pattern: a name of ORDERS, or a pattern (k, 4)
    untouched: NDArray[Any] | int = 0  # an array of another file, or how many rows come first


AS_DOCUMENTED = ReadingOptions()
INTERLEAVED: dict[str, tuple[bool, bool]] = {  # whether in turn, whether complex
    "magnitude-phase": (True, False),
    "real-imaginary": (True, True),
    "magnitude-then-phase": (False, False),
    "real-then-imaginary": (False, True),
}
TRANSPOSED = "transposed"
SLICE = re.compile(r"(-?\d*)(:)?(-?\d*)(?::([1-9]\d*))?")
HELP = f"{', '.join((*INTERLEAVED, TRANSPOSED))}, or which of them, as 1:, :120, 0:240:2"


def read_columns(
    arrays: Mapping[str, NDArray[Any]], bundle: Bundle, options: ReadingOptions = AS_DOCUMENTED
) -> tuple[Arrays, str]:
    """The same arrays with rows (n, K), in the skin's order, and what was understood beside the documented form ("").

    Raises InputError.
    """
    found, notes = _named(arrays)
    if isinstance(options.untouched, np.ndarray) or options.untouched:
        notes += _without_own(found, options.untouched)
    rows = {name: each for name in ROWS if (each := np.asarray(found.get(name))).dtype.kind in "biufc"}
    for token in filter(None, options.columns.split(",")):
        rows = {name: _selected(each, token.strip()) for name, each in rows.items()}
    notes.append(options.columns and f"columns {options.columns}, as told")
    layout = Layout(bundle, options.order, found.get("pattern"))
    rows, more = _upright(rows, layout)
    notes += more
    plain = next((rows[name] for name in ("untouched", "reference", "measurements") if name in rows), None)
    for name, each in rows.items():
        rows[name], note = layout.taken(name, each)
        notes.append(note)
    notes.append(_real_beside_complex(rows))
    if plain is not None and layout.by_default and bundle.matrices.normalisation == "model":
        _doubt(plain, layout)
    if isinstance(options.untouched, int) and options.untouched and "measurements" in rows:
        rows |= _parted(rows["measurements"], options.untouched)
    found.pop("pattern", None)
    return {**found, **rows}, "; ".join(dict.fromkeys(filter(None, notes)))


def _real_beside_complex(rows: Mapping[str, NDArray[Any]]) -> str:
    with_phase = {name for name, each in rows.items() if each.dtype.kind == "c" and each.imag.any()}
    real = rows.keys() - with_phase
    return f"`{min(real)}` is real beside a complex `{min(with_phase)}`, so magnitudes" if with_phase and real else ""


def _named(arrays: Mapping[str, NDArray[Any]]) -> tuple[Arrays, list[str]]:
    """The arrays by the names that we know them by; parts of complex ones put together."""
    found, notes = _joined(arrays)
    for known, others in OTHER_NAMES.items():
        theirs = [name for name in found if name.lower() in (known, *others) and name not in ROWS]
        if known in found or not theirs or (known == "measurements" and "touched" in found):
            continue
        if len(theirs) > 1:
            raise InputError(f"`{theirs[0]}` and `{theirs[1]}` may both be `{known}`: name one of them so")
        found[known] = found.pop(theirs[0])
        notes.append(f"`{theirs[0]}` is `{known}`")
    numbers = {name for name, each in found.items() if np.asarray(each).dtype.kind in "iufc"}
    unknown = [*numbers.difference(ROWS, ["pattern"])]
    if len(unknown) == 1 and not found.keys() & {"measurements", "touched", "delta"}:
        found["measurements"] = found.pop(unknown[0])
        notes.append(f"`{unknown[0]}` is `measurements`")
    return found, notes


def _joined(arrays: Mapping[str, NDArray[Any]]) -> tuple[Arrays, list[str]]:
    """Two arrays that their names say are the parts of one are that one."""
    found, notes = dict(arrays), list[str]()
    if isinstance(arrays, NamedColumns) and arrays.understood:
        notes.append(arrays.understood)
    by_small = {name.lower(): name for name in arrays}
    ends = [(small, *parts) for small in by_small for parts in PARTS if small.endswith(parts[0])]
    for small, first, second in ends:
        of, name = small.removesuffix(first), by_small[small]
        other = by_small.get(of + second, "")
        if other in found and name in found and arrays[name].shape == arrays[other].shape:
            one, two = found.pop(name), found.pop(other)
            found[of.strip("_ ") or "measurements"] = one if second == "phase" else one + 1j * two
            notes.append(f"`{name}` and `{other}` are {first} and {second}")
    return found, notes


def _without_own(found: Arrays, untouched: NDArray[Any] | int) -> list[str]:
    """Puts the untouched rows that a person names into a file that has none."""
    if own := {"untouched", "reference"} & found.keys():
        raise InputError(f"--untouched: the file has `{min(own)}` of its own: leave the option out")
    if isinstance(untouched, np.ndarray):
        found["untouched"] = untouched
        return ["`untouched` is of another file"]
    return [f"the first {untouched} rows are `untouched`"]


def _parted(rows: NDArray[Any], first: int) -> Arrays:
    if first >= len(rows):
        raise InputError(f"--untouched: found {first}, but the file has {len(rows)} rows, and one must be left")
    return {"untouched": rows[:first], "measurements": rows[first:]}


def _selected(values: NDArray[Any], token: str) -> NDArray[Any]:
    """What --columns says to take."""
    if values.ndim == 1:
        values = values[None]
    elif values.ndim == 3:
        values = values.reshape(len(values), -1)
    if token == TRANSPOSED and values.ndim == 2:
        return values.T
    if token in INTERLEAVED and values.ndim == 2:
        return _interleaved(values, token)
    form = SLICE.fullmatch(token)
    if form is None or values.ndim != 2:
        raise InputError(f"--columns: found {token!r}, expected {HELP}")
    first, colon, last, step = form.groups()
    if not colon:
        raise InputError(f"--columns: found {token!r}, expected several, as {token}: or {HELP}")
    return values[:, slice(int(first) if first else None, int(last) if last else None, int(step) if step else None)]


def _interleaved(values: NDArray[Any], name: str) -> NDArray[Any]:
    in_turn, whole = INTERLEAVED[name]
    if values.shape[1] % 2:
        raise InputError(f"--columns {name}: found {values.shape[1]} columns, expected an even number of them")
    half = values.shape[1] // 2
    one, other = (values[:, ::2], values[:, 1::2]) if in_turn else (values[:, :half], values[:, half:])
    return one + 1j * other if whole else one


class Layout:
    """How many columns a file for this skin may have, and which of them are the skin's measurements."""

    def __init__(self, bundle: Bundle, order: str | NDArray[Any], theirs: NDArray[Any] | None) -> None:
        """order: as an option names it; theirs: the file's own pattern."""
        self.bundle, self.k = bundle, len(bundle.pattern)
        self.electrodes, rows = int(bundle.pattern.max()) + 1, np.asarray(bundle.pattern, np.int64)
        self.places = Places(rows, self.electrodes)
        table = order if isinstance(order, np.ndarray) else None if order else theirs
        self.name = order if isinstance(order, str) and order else "skin"
        self.by_default = table is None and not order
        self.order = None if table is None else by_pattern(table, rows, bundle.name)
        self.own = self.whole = self.k if table is None else max(np.shape(table))
        if table is None and isinstance(bundle.skin.get("pattern"), str):
            self.whole = self.places.shape[0] * self.places.shape[1]  # of others nobody knows the whole table's order

    def fits(self, count: int) -> bool:
        """Whether rows of so many values can be read."""
        return count in (self.own, self.whole) or self._is_doubled(count)

    def _is_doubled(self, count: int) -> bool:
        return count in (2 * self.own, 2 * self.whole)

    def taken(self, name: str, values: NDArray[Any]) -> tuple[NDArray[Any], str]:
        """(n, K) of (n, columns), and what was understood. Raises InputError."""
        count = values.shape[1] if values.ndim == 2 else -1
        if count == self.own and self.order is not None:
            return values[:, self.order.columns], self.order.said
        if count == self.own:
            said = "" if self.by_default else f"columns {ORDERS[self.name].said}, as told"
            return values[:, self.places.columns(self.name)], said
        if count == self.whole:
            return self._of_whole(name, values)
        raise InputError((self._doubled if self._is_doubled(count) else self._strange)(name, values))

    def _of_whole(self, name: str, values: NDArray[Any]) -> tuple[NDArray[Any], str]:
        drives, senses = self.places.shape
        columns = self.places.columns(self.name, whole=True)
        if self.places.itself:
            diagonal = values[:, :: self.electrodes + 1]
            if (np.nan_to_num(diagonal) != 0).any():
                raise InputError(
                    f"`{name}` has {values.shape[1]} columns, likely {drives} drive pairs by {senses} sense pairs of "
                    f"neighbours; {self.bundle.name} measures {self.k} (each pair of electrodes itself, for which the "
                    "table of electrodes by electrodes is 0 where both are one): choose the skin that was measured, or "
                    "say which columns are which with --pattern FILE"
                )
            return values[:, columns], f"{drives} by {senses} electrodes, each pair taken once"
        note = f"{drives} drive pairs by {senses} sense pairs, those of driving electrodes left out"
        return values[:, columns], note

    def _doubled(self, name: str, values: NDArray[Any]) -> str:
        half = values.shape[1] // 2
        likely, why = likely_interleaving(values)
        return (
            f"`{name}` has {values.shape[1]} columns, two for each of {half} measurements: {why}. "
            f"If so, say --columns {likely}; else one of {', '.join(each for each in INTERLEAVED if each != likely)}"
            + self._both_ways(values)
        )

    def _both_ways(self, values: NDArray[Any]) -> str:
        n = self.electrodes
        if not self.places.itself or values.shape[1] != n * (n - 1):
            return ""
        return f", or --pattern FILE, if each of the {n * (n - 1)} is a pair of electrodes, both ways"

    def _strange(self, name: str, values: NDArray[Any]) -> str:
        found = f"`{name}` is {values.dtype} of shape {values.shape}"
        expected = f"expected numbers of shape (n, {self.own}) in the skin's pattern order"
        if values.ndim != 2:
            return f"{found}, {expected}"
        counts = {count for count in values.shape if count not in (self.own, self.whole)}
        for other in NAMES:
            if other == "opposite" and self.electrodes % 2:
                continue
            their = pattern(other, self.electrodes)
            places = Places(their, self.electrodes)
            if counts & {len(their), places.shape[0] * places.shape[1]}:
                return (
                    f"{found}, {expected} ({self.bundle.name} measures {self.k}): {self.electrodes} electrodes "
                    f"measured `{other}` give {len(their)}, or {places.shape[0] * places.shape[1]} with those of "
                    "driving electrodes; choose the skin that was measured"
                )
        more = values.shape[1] - self.own
        if 0 < more <= MOST_BESIDE:
            return (
                f"{found}, {expected}: if times or numbers stand in its first columns, say --columns "
                f"{more}:, in its last ones, :{self.own}"
            )
        return f"{found}, {expected}"


def likely_interleaving(values: NDArray[Any]) -> tuple[str, str]:
    """How two values for each measurement probably stand, and what speaks for it."""
    half = values.shape[1] // 2
    size = np.where(np.isfinite(values), np.abs(values), 0.0)
    turn = _apart(float(np.median(size[:, ::2])), float(np.median(size[:, 1::2])))
    in_turn = turn >= _apart(float(np.median(size[:, :half])), float(np.median(size[:, half:])))
    one = (values[:, ::2] if in_turn else values[:, :half]).real
    positive = bool((one[np.isfinite(one)] >= 0).all())
    parts = ("magnitude", "phase") if positive else ("real", "imaginary")
    which = "every other one, from the first on," if in_turn else f"the first {half}"
    why = f"{which} are {'all positive' if positive else 'of both signs'}, so likely {parts[0]} and {parts[1]}"
    return ("-" if in_turn else "-then-").join(parts), why


def _apart(one: float, other: float) -> float:
    return float(abs(np.log(max(one, 1e-30) / max(other, 1e-30))))


def _upright(rows: Arrays, layout: Layout) -> tuple[Arrays, list[str]]:
    """Rows first, then columns. One reading holds for all arrays of a file that may be read in two ways."""
    rows, notes = _flat(rows, layout)
    flat = {name: each for name, each in rows.items() if each.ndim == 2}
    if all(each.shape[1] == layout.own for each in flat.values()):
        return rows, notes
    fitting = any(layout.fits(count) for each in flat.values() for count in each.shape)
    if not fitting and (blocks := _blocks(flat, layout)):
        rows |= {name: each.reshape(1, -1) for name, each in blocks.items()}
        return rows, [*notes, "one row each, as drive pairs by sense pairs"]
    turned = _turned(flat, layout)
    rows |= {name: flat[name].T for name in turned}
    if turned:
        notes.append(f"transposed: {', '.join(sorted(turned))}, whose columns stand as rows")
    return rows, notes


def _turned(flat: Arrays, layout: Layout) -> set[str]:
    """The arrays whose columns stand as rows. Raises InputError where that cannot be told."""
    upright = {name for name, each in flat.items() if layout.fits(each.shape[1])}
    lying = {name for name, each in flat.items() if layout.fits(each.shape[0])}
    turned, either = lying - upright, lying & upright
    if either and bool(turned) == bool(upright - lying):
        raise InputError(_either_way(min(either), flat[min(either)]))
    return lying if turned else set()


def _flat(rows: Arrays, layout: Layout) -> tuple[Arrays, list[str]]:
    """One row, and rows that are tables themselves, as rows."""
    found, notes = dict(rows), []
    for name, each in rows.items():
        if each.ndim == 1 and layout.fits(len(each)):
            found[name] = each[None]
            notes.append(f"`{name}` is one row")
        elif each.ndim == 3 and layout.fits(each.shape[1] * each.shape[2]):
            found[name] = each.reshape(len(each), -1)
            notes.append(f"`{name}` is {each.shape[1]} by {each.shape[2]} values a row")
        elif each.ndim == 3 and len(each) == 1:
            found[name] = each[0]
    return found, notes


def _either_way(name: str, values: NDArray[Any]) -> str:
    rows, columns = values.shape
    return (
        f"`{name}` of shape {values.shape} may be {rows} rows of {columns} values, or {columns} rows of {rows}, likely "
        "the latter: say --columns transposed if so, else --columns :"
    )


def _blocks(flat: Arrays, layout: Layout) -> Arrays:
    """Arrays that each are one row, as a table of drive pairs by sense pairs; empty where they are not."""
    drives, senses = layout.places.shape
    shapes = {layout.places.shape, (drives, layout.k // drives)} if not layout.k % drives else {(drives, senses)}
    return flat if flat and all(each.shape in shapes for each in flat.values()) else {}


def _doubt(values: NDArray[Any], layout: Layout) -> None:
    """Raises InputError where another order would fit the skin's own prediction, and this one does not."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of numpy, for columns without a value
        level = np.log(np.nanmedian(np.abs(values.astype(complex)), axis=0))
    fit, whole = {}, values.shape[1] != layout.own
    for name in ORDERS:
        found = level[layout.places.columns(name, whole)]
        good = np.isfinite(found)
        fit[name] = _alike(found[good], np.log(layout.bundle.z0)[good]) if good.mean() > 0.5 else 0.0
    likely = max(fit, key=lambda each: fit[each])
    if fit["skin"] < FAILS and fit[likely] > FITS:
        raise InputError(
            f"the columns are not in the order of {layout.bundle.name} (correlation of |Z| with its prediction "
            f"{fit['skin']:.2f}), likely {ORDERS[likely][0]} ({fit[likely]:.2f}): if so, say --pattern {likely}; "
            "--pattern skin if not"
        )


def _alike(one: NDArray[Any], other: NDArray[Any]) -> float:
    one, other = one - one.mean(), other - other.mean()
    scale = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / scale if scale > 0 else 0.0
