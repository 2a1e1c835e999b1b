"""The skin in the terminal: the conductivity drop as coloured half blocks, contacts as marks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from services.polygon import inside

RAMP = ((16, 18, 32), (56, 24, 96), (150, 30, 90), (230, 90, 40), (255, 200, 60), (255, 255, 220))
"""Colours from no drop to the full one."""
LETTERS = ".:-=+*#%@"
SCALE = 9  # characters of the scale below the skin
FULL_SCALE = 0.5  # S/m, the brightest colour, unless a larger drop is there


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


def top_of_scale(image: NDArray[np.floating[Any]] | None) -> float:
    """The drop [S/m] that the brightest colour stands for."""
    return FULL_SCALE if image is None or image.size == 0 else max(FULL_SCALE, float(image.max()))


def draw(
    image: NDArray[np.floating[Any]] | None,
    half_width_m: float,
    contacts: Sequence[tuple[float, float]] = (),
    outline: Sequence[Sequence[float]] | None = None,
    cells: int = 32,
    coloured: bool = True,
) -> Text:
    """Text of cells / 2 lines of `cells` columns, y upwards; `contacts` are (x, y) in metres.

    Not `coloured`: one character for the stronger of each two cells.
    """
    values = np.zeros((cells, cells)) if image is None or image.size == 0 else coarse(image, cells)
    values = values / top_of_scale(image)
    axis = (-1 + 2 * (np.arange(cells) + 0.5) / cells) * half_width_m
    covered = np.ones((cells, cells), bool) if outline is None else inside(outline, axis[None, :], axis[:, None])
    marks = {(_cell(y, half_width_m, cells) // 2, _cell(x, half_width_m, cells)) for x, y in contacts}
    text = Text()
    for row in range(cells // 2 - 1, -1, -1):
        for column in range(cells):
            two = [2 * row + 1, 2 * row], column
            text.append(*_character(values[two], covered[two], (row, column) in marks, coloured))
        text.append("\n")
    return text


def _character(pair: NDArray[np.floating[Any]], on: NDArray[np.bool_], marked: bool, coloured: bool) -> tuple[str, str]:
    """The character of two cells, the upper one first, and its style. on: which of them are on the skin."""
    if marked:
        return ("+", f"bold white on {_rgb(pair[1])}") if coloured else ("X", "")
    if not on.any():
        return " ", ""
    if not coloured:
        return LETTERS[min(int(pair.max() * len(LETTERS)), len(LETTERS) - 1)], ""
    if on.all():
        return "▀", f"{_rgb(pair[0])} on {_rgb(pair[1])}"
    return ("▀", _rgb(pair[0])) if on[0] else ("▄", _rgb(pair[1]))


def framed(skin: Text, half_width_m: float, full_scale: float, coloured: bool = True) -> Text:
    """What `draw` gives, with axes in mm, and the scale of its colours below."""
    lines = [line for line in skin.split("\n") if line.plain]
    half, width = f"{half_width_m * 1e3:.0f}", len(lines[0])
    labels = {0: f"+{half}", len(lines) // 2: "0", len(lines) - 1: f"-{half}", 1: "y mm"}
    text = Text()
    for k, line in enumerate(lines):
        text.append(f"{labels.get(k, ''):>5s} ", style="dim").append(line).append("\n")
    middle = f"{'0':^{width - 2 * len(half) - 2}s}"
    text.append(f"{'':6s}-{half}{middle}+{half}\n", style="dim")
    text.append(f"{'x mm':^{width + 12}s}".rstrip() + "\n", style="dim")
    text.append("conductivity drop 0 ", style="dim")
    for k in range(SCALE):
        if coloured:
            text.append("█", style=_rgb((k + 0.5) / SCALE))
        else:
            text.append(LETTERS[k * len(LETTERS) // SCALE])
    return text.append(f" {full_scale:.2f} S/m", style="dim")


def _rgb(value: float) -> str:
    return "rgb({},{},{})".format(*colour(float(value)))


def _cell(position: float, half_width_m: float, cells: int) -> int:
    return min(max(int((position / half_width_m + 1) / 2 * cells), 0), cells - 1)
