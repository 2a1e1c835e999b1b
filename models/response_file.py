"""The file of a bundle's response tables, response.npz: less than half a megabyte (numpy only).

What outline and electrodes add to Gamma is smooth, so MODES of its eigenvectors hold all but 1e-3 of it: the response
of a touch changes by less than 1e-4 of itself, where the tables are known to 3e-3.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from models.bundle_check import Wrong
from models.skin_limits import MOST_PIXELS
from models.touch_response import ResponseTables

MODES = 128
MOST_FIELD = 1e4  # per model unit, of a unit current


def arrays_of_tables(tables: ResponseTables) -> dict[str, Any]:
    """As response.npz holds them: fields (2, F * F, E), modes (2 * G * G, R), strength (R,), inside (G, G)."""
    side = tables.inside.size
    whole = tables.regular.astype(float).transpose(0, 2, 1, 3).reshape(2 * side, 2 * side)
    values, vectors = np.linalg.eigh(0.5 * (whole + whole.T))
    strongest = np.argsort(-np.abs(values))[:MODES]
    return {
        "fields": tables.fields.astype(np.float16),
        "modes": vectors[:, strongest].astype(np.float16),
        "strength": values[strongest].astype(np.float32),
        "inside": tables.inside,
    }


def tables_of(arrays: Mapping[str, npt.NDArray[Any]], electrodes: int) -> ResponseTables:
    """The tables that a response.npz of a skin with so many electrodes holds. Raises Wrong."""
    missing = [name for name in ("fields", "modes", "strength", "inside") if name not in arrays]
    if missing:
        raise Wrong("response.npz", f"no {', '.join(missing)}", "fields, modes, strength, inside")
    fields, modes, strength, inside = (arrays[name] for name in ("fields", "modes", "strength", "inside"))
    n = inside.shape[0] if inside.ndim == 2 and inside.shape[0] == inside.shape[1] else 0
    if not 2 <= n <= MOST_PIXELS or inside.dtype.kind != "b" or not inside.any():
        raise Wrong("response.npz: inside", f"{inside.dtype} {inside.shape}", "booleans of a square grid, some true")
    fine = round(fields.shape[1] ** 0.5) if fields.ndim == 3 else 0
    ranks = len(strength) if strength.ndim == 1 else 0
    for name, array, shape in (
        ("fields", fields, (2, fine * fine, electrodes)),
        ("modes", modes, (2 * n * n, ranks)),
        ("strength", strength, (ranks,)),
    ):
        if array.shape != shape or not array.size or array.dtype.kind != "f":
            raise Wrong(f"response.npz: {name}", f"{array.dtype} {array.shape}", f"floats of shape {shape}")
        if not np.isfinite(array).all() or np.abs(array).max() > MOST_FIELD:
            raise Wrong(f"response.npz: {name}", "NaN, infinity or more", f"numbers within {MOST_FIELD:g}")
    wide = modes.astype(np.float32)
    whole = (wide * strength) @ wide.T
    regular = np.ascontiguousarray(whole.reshape(2, n * n, 2, n * n).transpose(0, 2, 1, 3))
    return ResponseTables(fields.astype(np.float32), regular, inside)
