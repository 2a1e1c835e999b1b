"""Drive patterns: which electrodes carry the current and between which the voltage is read.

A pattern is an int array (K, 4), 0-based: drive+, drive-, sense+, sense-. Unit current enters at drive+ and leaves at
drive-; the impedance is the voltage of sense+ over sense-. Needs only numpy.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.skin_limits import MOST_MEASUREMENTS
from protocol.errors import EitskinError


class PatternError(EitskinError, ValueError):
    """A pattern that cannot be measured or cannot be inverted; the message says which entry or which rank."""


def pairs(n: int = 16) -> NDArray[np.int64]:
    """Each of the n(n-1)/2 electrode pairs drives and senses itself: (0,1), (0,2) ... (n-2,n-1)."""
    return np.array([(i, j, i, j) for i, j in combinations(range(n), 2)], dtype=np.int64)


def adjacent(n: int = 16) -> NDArray[np.int64]:
    """Neighbours drive (k+1, k), neighbours that carry no current sense (m, m+1): n(n-3) measurements."""
    rows = []
    for k in range(n):
        plus = (k + 1) % n
        rows += [(plus, k, m, (m + 1) % n) for m in range(n) if not {m, (m + 1) % n} & {k, plus}]
    return np.array(rows, dtype=np.int64)


def opposite(n: int = 16) -> NDArray[np.int64]:
    """Opposite electrodes drive (k, k+n/2), neighbours that carry no current sense (m+1, m): n(n-4) measurements."""
    if n % 2:
        raise PatternError(f"pattern 'opposite' needs an even number of electrodes, found {n}")
    rows = []
    for k in range(n):
        minus = (k + n // 2) % n
        rows += [(k, minus, (m + 1) % n, m) for m in range(n) if not {m, (m + 1) % n} & {k, minus}]
    return np.array(rows, dtype=np.int64)


NAMED = {"pairs": pairs, "adjacent": adjacent, "opposite": opposite}
NAMES = tuple(NAMED)


def pattern(spec: str | ArrayLike, n: int = 16) -> NDArray[np.int64]:
    """The (K, 4) array of a name in NAMES or of a custom list of [drive+, drive-, sense+, sense-]; checked.

    Raises PatternError for an unknown name, an electrode that does not exist, or a pattern that measures too little, or
    more than can be served.
    """
    if isinstance(spec, str) and spec not in NAMES:
        raise PatternError(f"unknown pattern {spec!r}: expected one of {', '.join(NAMES)} or a list")
    rows = NAMED[spec](n) if isinstance(spec, str) else check(spec, n)
    if len(rows) > MOST_MEASUREMENTS:
        raise PatternError(_too_many(spec if isinstance(spec, str) else "", len(rows), n))
    return rows


def fitting(n: int) -> list[str]:
    """Names of the patterns with which so many electrodes can be served."""
    found = []
    for name, rows in NAMED.items():
        with contextlib.suppress(PatternError):  # of an even number of electrodes alone
            found += [name] if len(rows(n)) <= MOST_MEASUREMENTS else []
    return found


def _too_many(name: str, found: int, n: int) -> str:
    todo = [f"the pattern {other!r} ({len(NAMED[other](n))})" for other in fitting(n)]
    if name:
        fewer = next(m for m in range(n - 1, 0, -1) if name in fitting(m))
        todo.append(f"at most {fewer} electrodes with {name!r}")
    what = f"{n} electrodes with the pattern {name!r} are" if name else "the pattern has"
    return (
        f"{what} {found} measurements, at most {MOST_MEASUREMENTS} can be served (a board's scan list, and what can be "
        f"estimated within a scan): choose {' or '.join(todo) or 'fewer electrodes'}"
    )


def _wrong(row: list[int], n: int) -> str:
    """What is wrong with a measurement of drive+, drive-, sense+, sense-; "" where nothing is."""
    bad = [e for e in row if not 0 <= e < n]
    if bad:
        return f"names electrode {bad[0]}: there are {n}, numbered 0 to {n - 1}"
    if row[0] == row[1]:
        return "drives an electrode against itself"
    return "senses an electrode against itself" if row[2] == row[3] else ""


def check(spec: ArrayLike, n: int = 16, minimum_rank: int | None = None) -> NDArray[np.int64]:
    """Validate a custom pattern and return it as (K, 4) int64.

    minimum_rank: fewest independent measurements accepted; the default is half of what `adjacent` gives, n(n-3)/4,
    below which an image of the skin is not determined in any useful sense.
    """
    raw = np.asarray(spec)
    if raw.ndim != 2 or raw.shape[1] != 4 or not np.issubdtype(raw.dtype, np.integer):
        raise PatternError(f"a pattern is rows of four integers, found an array of shape {raw.shape}, type {raw.dtype}")
    rows = raw.astype(np.int64)
    for k, row in enumerate(rows.tolist()):
        if wrong := _wrong(row, n):
            raise PatternError(f"measurement {k} {row} {wrong}")
    unseen = sorted(set(range(n)) - set(rows.ravel().tolist()))
    if unseen:
        raise PatternError(f"the pattern never uses electrode {', '.join(map(str, unseen))} of {n}")
    needed = int(np.ceil(n * (n - 3) / 4)) if minimum_rank is None else minimum_rank
    found = rank(rows, n)
    if found < needed:
        raise PatternError(
            f"the pattern's {len(rows)} measurements have rank {found}, at least {needed} is needed "
            f"({n} electrodes allow {n * (n - 1) // 2}): add measurements that are not sums of others"
        )
    return rows


def rank(rows: NDArray[np.int64], n: int = 16) -> int:
    """How many measurements are independent, reciprocity counted (at most n(n-1)/2)."""
    drive, sense = incidence(rows[:, :2], n), incidence(rows[:, 2:], n)
    outer = np.einsum("ki,kj->kij", drive, sense)
    upper = np.triu_indices(n)
    return int(np.linalg.matrix_rank((outer + outer.transpose(0, 2, 1))[:, upper[0], upper[1]]))


def incidence(pair: NDArray[np.int64] | Sequence[Sequence[int]], n: int = 16) -> NDArray[np.float64]:
    """(K, n): +1 at the first, -1 at the second electrode of each of the K pairs."""
    pair = np.asarray(pair)
    matrix = np.zeros((len(pair), n))
    matrix[np.arange(len(pair)), pair[:, 0]] += 1
    matrix[np.arange(len(pair)), pair[:, 1]] -= 1
    return matrix
