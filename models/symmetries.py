"""Which of the square's eight symmetries leave a skin as it is, and what each does to its measurements (numpy only).

Training turns its scenes by them (augmentation.py), a held touch's image is the mean over them (services/symmetry.py),
and test frames are moved by them (bench/accuracy/frames.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from models.turns import TURNS, Turn

SAME = 1e-6  # model units: places that are the same


@dataclass(frozen=True)
class Symmetry:
    """d'[k] = d[measurements[k]] belongs to the turned image: electrode e stands where electrodes[e] has been moved
    to.
    """

    measurements: npt.NDArray[np.integer]
    electrodes: npt.NDArray[np.integer]
    turn: Turn


def symmetries(skin: Mapping[str, Any], pattern: npt.NDArray[np.integer]) -> list[Symmetry]:
    """Those of the eight that map the skin's outline, its electrodes (place, width, contact impedance) and its drive
    pattern (K, 4) onto themselves; the first is the identity. skin: as a bundle's manifest holds it and
    `SkinGeometry.to_dict` makes it; none where it does not say where outline and electrodes are.

    A pattern may read the same |Z| twice, with the current turned round or with drive and sense exchanged. Each
    measurement is then mapped to the one that reads it in the same way: on a real skin the two differ.
    """
    electrodes = skin.get("electrodes", {})
    centres = np.asarray(electrodes.get("centre", ()), float).reshape(-1, 2)
    if not len(centres) or not {"outline", "radius"} & set(skin):
        return []
    outline = np.asarray(skin.get("outline", ()), float).reshape(-1, 2)  # a disc has none: any turn leaves it
    each = [
        np.broadcast_to(np.asarray(value, float), len(centres))
        for value in (electrodes.get("width", 0.0), skin.get("contact_impedance", 0.0))
    ]
    marked = np.column_stack([centres, *each])
    same_way = {_signed(m): k for k, m in enumerate(pattern)}
    any_way = {_key(m): k for k, m in enumerate(pattern)}
    found = []
    for turn in TURNS:
        apart = _apart(marked, np.column_stack([turn.points(centres), *each]))
        source = apart.argmin(axis=1)
        if apart.min(axis=1).max() > SAME or not _same(outline, turn.points(outline)):
            continue
        moved_to = [same_way.get(_signed(source[m]), any_way.get(_key(source[m]))) for m in pattern]
        if None not in moved_to:
            found.append(Symmetry(np.array(moved_to), source, turn))
    return found


def _apart(rows: npt.NDArray[np.float64], others: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Of each row to each of the others: the largest difference of two numbers."""
    return np.asarray(np.abs(rows[:, None] - others[None]).max(axis=2))


def _same(rows: npt.NDArray[np.float64], others: npt.NDArray[np.float64]) -> bool:
    """Whether both are the same set of rows."""
    return not len(rows) or bool(_apart(rows, others).min(axis=1).max() < SAME)


def _signed(measurement: npt.NDArray[np.integer]) -> tuple[int, ...]:
    """The same for the two orders that read the same Z: both pairs turned round leave its sign."""
    a, b, c, d = (int(e) for e in measurement)
    return min((a, b, c, d), (b, a, d, c))


def _key(measurement: npt.NDArray[np.integer]) -> tuple[tuple[int, ...], ...]:
    """The same for every order that reads the same |Z|: pairs turned round, drive and sense exchanged (reciprocity)."""
    a, b, c, d = (int(e) for e in measurement)
    first, second = sorted((tuple(sorted((a, b))), tuple(sorted((c, d)))))
    return (first, second)
