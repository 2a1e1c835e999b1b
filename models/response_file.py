"""A bundle's response tables, and their file, response.npz (numpy only)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from models.bundle_check import Wrong
from models.skin_limits import MOST_PIXELS

MOST_FIELD = 1e4  # per model unit, of a unit current


@dataclass(frozen=True)
class ResponseTables:
    """What a bundle ships of the untouched sheet, on pixels of the square [-1, 1]^2, [iy, ix] raveled.

    fields (2, F * F, E): x and y of the field of a unit current in at each electrode and out at the last. inside
    (G, G): pixels with their centre on the skin.
    """

    fields: npt.NDArray[np.float32]
    inside: npt.NDArray[np.bool_]


def arrays_of_tables(tables: ResponseTables) -> dict[str, Any]:
    """As response.npz holds them."""
    return {"fields": tables.fields.astype(np.float16), "inside": tables.inside}


def tables_of(arrays: Mapping[str, npt.NDArray[Any]], electrodes: int) -> ResponseTables:
    """The tables that a response.npz of a skin with so many electrodes holds; further arrays are not read.
    Raises Wrong.
    """
    missing = [name for name in ("fields", "inside") if name not in arrays]
    if missing:
        raise Wrong("response.npz", f"no {', '.join(missing)}", "fields, inside")
    fields, inside = arrays["fields"], arrays["inside"]
    n = inside.shape[0] if inside.ndim == 2 and inside.shape[0] == inside.shape[1] else 0
    if not 2 <= n <= MOST_PIXELS or inside.dtype.kind != "b" or not inside.any():
        raise Wrong("response.npz: inside", f"{inside.dtype} {inside.shape}", "booleans of a square grid, some true")
    fine = round(fields.shape[1] ** 0.5) if fields.ndim == 3 else 0
    shape = (2, fine * fine, electrodes)
    if fields.shape != shape or not fields.size or fields.dtype.kind != "f":
        raise Wrong("response.npz: fields", f"{fields.dtype} {fields.shape}", f"floats of shape {shape}")
    if not np.isfinite(fields).all() or np.abs(fields).max() > MOST_FIELD:
        raise Wrong("response.npz: fields", "NaN, infinity or more", f"numbers within {MOST_FIELD:g}")
    return ResponseTables(fields.astype(np.float32), inside)
