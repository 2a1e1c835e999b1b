"""Which measurement of a skin each column of a file is: by the file's own `pattern`, or by the order that is meant.

A pattern (K, 4) is drive+, drive-, sense+, sense-, electrodes from 0. E electrodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.errors import EitskinError

Rows = NDArray[np.int64]


class InputError(EitskinError, ValueError):
    """The file's arrays are not what is needed; says which, what was found and what is expected."""


class Order(NamedTuple):
    columns: NDArray[np.intp]  # (K,) of the file, of each measurement of the skin
    said: str  # what was understood, for a person


def by_pattern(theirs: NDArray[Any], pattern: Rows, skin: str) -> Order:
    """Of a file that says its order: (k, 4), or (k, 2) where each pair drives and senses itself. Raises InputError.

    An amplitude has no sign, so either pair may be the other way round. On a real board the two ways of a drive pair
    are two measurements: one that is there as the skin has it is taken first. Only where it is not there, the one with
    sense and drive exchanged is taken, which is the same by reciprocity.
    """
    rows, said = _electrodes(theirs, pattern)
    direct, other = _found(rows, pattern), _found(rows[:, [2, 3, 0, 1]], pattern)
    found = np.where(direct >= 0, direct, other)
    if (found >= 0).all():
        swapped = int((direct < 0).sum())
        said += [f": {swapped} have sense and drive exchanged"] if swapped else []
        turned = int((rows[found][direct >= 0, 0] != pattern[direct >= 0, 0]).sum())
        said += [f": {turned} drive pairs are the other way round"] if turned else []
        left = len(rows) - len(np.unique(found))
        said += [f": {left} of its {len(rows)} columns are none of the skin's and are left out"] if left else []
        return Order(found, "the order of the file's `pattern`" + "".join(said))
    lacking = pattern[found < 0]
    raise InputError(
        f"`pattern` has {len(rows)} rows, and lacks {len(lacking)} that {skin} measures, such as "
        f"{lacking[0].tolist()}: choose the skin that was measured (electrodes count from 0: drive+, drive-, sense+, "
        "sense-)"
    )


def _electrodes(theirs: NDArray[Any], pattern: Rows) -> tuple[Rows, list[str]]:
    rows = np.asarray(theirs)
    if rows.ndim == 2 and rows.shape[1] not in (2, 4) and rows.shape[0] in (2, 4):
        rows = rows.T
    whole = rows.dtype.kind in "iu" or (rows.dtype.kind == "f" and (rows == np.round(rows)).all())
    if rows.ndim != 2 or rows.shape[1] not in (2, 4) or not whole or not rows.size or np.abs(rows).max() > 1e6:
        raise InputError(
            f"`pattern` is {theirs.dtype} of shape {theirs.shape}, "
            "expected integers (k, 4): drive+, drive-, sense+, sense-"
        )
    rows, said = rows.astype(np.int64), []
    if rows.shape[1] == 2:
        rows = np.hstack([rows, rows])
    if rows.min() == 1 and rows.max() == pattern.max() + 1:
        rows, said = rows - 1, [" with electrodes counted from 1"]
    return rows, said


def _found(rows: Rows, pattern: Rows) -> NDArray[np.intp]:
    """(K,) the first row of each measurement, -1 where there is none."""
    either: dict[Any, int] = {}
    exact: dict[Any, int] = {}
    for at, (plus, minus, *sense) in enumerate(rows.tolist()):
        exact.setdefault((plus, minus, frozenset(sense)), at)
        either.setdefault((frozenset((plus, minus)), frozenset(sense)), at)
    keys = [(plus, minus, frozenset(sense)) for plus, minus, *sense in pattern.tolist()]
    return np.array([exact.get(key, either.get((frozenset(key[:2]), key[2]), -1)) for key in keys])


class Places:
    """Where each measurement of a skin stands in the table of all its drive pairs by all its sense pairs."""

    def __init__(self, pattern: Rows, electrodes: int) -> None:
        self.itself = bool((pattern[:, :2] == pattern[:, 2:]).all())  # each pair drives and senses itself
        if self.itself:
            self.drive, self.sense, self.shape = pattern[:, 0], pattern[:, 1], (electrodes, electrodes)
            return
        first: dict[tuple[int, ...], int] = {}
        self.drive = np.array([first.setdefault(tuple(pair), len(first)) for pair in pattern[:, :2].tolist()])
        self.sense = _numbered(pattern[:, 2:], electrodes)
        self.shape = int(self.drive.max()) + 1, int(self.sense.max()) + 1

    def columns(self, order: str, whole: bool = False) -> NDArray[np.intp]:
        """(K,) the column of each measurement, by an order of ORDERS. whole: the file has the whole table."""
        slow, fast, count = ORDERS[order].of(self)
        place = slow * count + fast
        if whole:
            return np.asarray(place)
        return np.arange(len(place)) if order == "skin" else np.argsort(np.argsort(place))


def _numbered(pairs: Rows, electrodes: int) -> Rows:
    """The number of each pair: neighbours by the first of the two round the skin, others as they first come."""
    one, other = pairs.T
    ahead, behind = (other - one) % electrodes == 1, (one - other) % electrodes == 1
    if (ahead | behind).all():
        return np.asarray(np.where(ahead, one, other))
    first: dict[Any, int] = {}
    return np.array([first.setdefault(frozenset(pair), len(first)) for pair in pairs.tolist()])


class KnownOrder(NamedTuple):
    said: str
    of: Callable[[Places], tuple[Rows, Rows, int]]  # what changes slowly, what fast, and how many of that there are


ORDERS: dict[str, KnownOrder] = {
    "skin": KnownOrder("in the skin's own order", lambda of: (of.drive, of.sense, of.shape[1])),
    "sense-first": KnownOrder("one sense pair after the other", lambda of: (of.sense, of.drive, of.shape[0])),
    "drive-reversed": KnownOrder(
        "from the last drive pair to the first", lambda of: (of.shape[0] - 1 - of.drive, of.sense, of.shape[1])
    ),
    "rotated": KnownOrder(
        "with sense pairs counted from the drive pair on",
        lambda of: (of.drive, (of.sense - of.drive) % of.shape[1], of.shape[1]),
    ),
}
"""Orders that a file may have without saying so."""
