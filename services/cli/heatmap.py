"""The skin in the terminal: the conductivity drop as coloured half blocks, contacts as marks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

RAMP = ((16, 18, 32), (56, 24, 96), (150, 30, 90), (230, 90, 40), (255, 200, 60), (255, 255, 220))
"""Colours from no drop to the full one."""
LETTERS = ".:-=+*#%@"
OUTSIDE = (0, 0, 0)


def colour(value: float) -> tuple[int, int, int]:
    """Red, green, blue of a value from 0 to 1."""
    at = min(max(value, 0.0), 1.0) * (len(RAMP) - 1)
    k = min(int(at), len(RAMP) - 2)
    return tuple(round(a + (at - k) * (b - a)) for a, b in zip(RAMP[k], RAMP[k + 1], strict=True))  # type: ignore[return-value]


def coarse(image: NDArray[np.floating[Any]], cells: int) -> NDArray[np.floating[Any]]:
    """(H, W) -> (cells, cells), each the largest drop within it: a small contact must not fade in the average."""
    rows = np.array_split(np.arange(image.shape[0]), cells)
    columns = np.array_split(np.arange(image.shape[1]), cells)
    return np.array([[image[np.ix_(r, c)].max(initial=0.0) for c in columns] for r in rows])


def inside(outline: Sequence[Sequence[float]], x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Which points lie in a polygon (even-odd rule)."""
    result = np.zeros(np.broadcast(x, y).shape, dtype=bool)
    for (x1, y1), (x2, y2) in zip(outline, [*outline[1:], outline[0]], strict=True):
        if y1 != y2:
            result ^= ((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) / (y2 - y1) * (x2 - x1))
    return result


def draw(
    image: NDArray[np.floating[Any]] | None,
    half_width_m: float,
    contacts: Sequence[tuple[float, float]] = (),
    outline: Sequence[Sequence[float]] | None = None,
    full_scale: float = 0.5,
    cells: int = 32,
    coloured: bool = True,
) -> Text:
    """Text of cells / 2 lines of `cells` columns, y upwards; `contacts` are (x, y) in metres, `full_scale` in S/m.

    Not `coloured`: one character for the stronger of each two cells.
    """
    values = np.zeros((cells, cells)) if image is None or image.size == 0 else coarse(image, cells)
    values = values / max(full_scale, float(values.max()))
    axis = (-1 + 2 * (np.arange(cells) + 0.5) / cells) * half_width_m
    covered = np.ones((cells, cells), bool) if outline is None else inside(outline, axis[None, :], axis[:, None])
    marks = {(_cell(y, half_width_m, cells) // 2, _cell(x, half_width_m, cells)) for x, y in contacts}
    text = Text()
    for row in range(cells // 2 - 1, -1, -1):
        for column in range(cells):
            top, bottom = (colour(values[r, column]) if covered[r, column] else OUTSIDE for r in (2 * row + 1, 2 * row))
            if not coloured:
                value = max(values[2 * row, column], values[2 * row + 1, column])
                letter = LETTERS[min(int(value * len(LETTERS)), len(LETTERS) - 1)]
                on = covered[2 * row, column] or covered[2 * row + 1, column]
                text.append("X" if (row, column) in marks else letter if on else " ")
            elif (row, column) in marks:
                text.append("+", style=f"bold white on rgb({bottom[0]},{bottom[1]},{bottom[2]})")
            else:
                text.append("▀", style=f"rgb({top[0]},{top[1]},{top[2]}) on rgb({bottom[0]},{bottom[1]},{bottom[2]})")
        text.append("\n")
    return text


def _cell(position: float, half_width_m: float, cells: int) -> int:
    return min(max(int((position / half_width_m + 1) / 2 * cells), 0), cells - 1)
