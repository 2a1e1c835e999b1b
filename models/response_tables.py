"""The tables a bundle ships of its untouched sheet, from a forward model."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sparse

from models.elements import Array
from models.forward import ForwardModel
from models.response_file import ResponseTables

COARSE, FINE = 24, 48


def response_tables(model: ForwardModel, coarse: int = COARSE, fine: int = FINE) -> ResponseTables:
    axis = -1 + 2 * (np.arange(coarse) + 0.5) / coarse
    x, y = np.meshgrid(axis, axis)
    inside = np.asarray(model.skin.inside(np.column_stack([x.ravel(), y.ravel()])), dtype=bool)
    fields = _on_pixels(model, fine, _gradients(model, model.solve(1.0).potentials))
    return ResponseTables(fields, inside.reshape(coarse, coarse))


def mounted_fields(model: ForwardModel, tensors: Array, potentials: Array, n: int = FINE) -> npt.NDArray[np.float32]:
    """(2, n * n, E) `ResponseTables.fields` of a sheet of any conductivity, by whose square root they are multiplied:
    a drop takes a share of what conducts, so their products are to such a sheet what those of fields are to an even
    one. tensors (elements, 3): xx, xy, yy; potentials (nodes, E): of a unit current at each electrode.
    """
    return _on_pixels(model, n, _rooted(tensors, _gradients(model, potentials)))


def _rooted(tensors: Array, field: Array) -> Array:
    """Fields (2, elements, c) times the square root of symmetric tensors (elements, 3)."""
    xx, xy, yy = tensors.T[:, :, None]
    root_det = np.sqrt(xx * yy - xy**2)
    scale = np.sqrt(xx + yy + 2 * root_det)
    along_x = ((xx + root_det) * field[0] + xy * field[1]) / scale
    along_y = (xy * field[0] + (yy + root_det) * field[1]) / scale
    return np.stack([along_x, along_y])


def _gradients(model: ForwardModel, potentials: Array) -> Array:
    """(2, elements, c)"""
    corner = potentials[model.mesh.t.T]
    return np.stack([np.einsum("ek,ekc->ec", model.gradients[..., a], corner) for a in range(2)])


def _on_pixels(model: ForwardModel, n: int, values: Array) -> npt.NDArray[np.float32]:
    """(2, n * n, c) means over pixels of values (2, elements, c). Pixels off the skin take their nearest neighbour's,
    so that interpolation at the edge has two sides.
    """
    elements = model.element_map(n, 64)
    share = sparse.csr_array(elements.T * model.areas)
    total = np.maximum(np.asarray(share.sum(axis=1)).ravel(), 1e-12)
    means = np.array([share @ part / total[:, None] for part in values])
    on_skin = np.flatnonzero(np.asarray(elements.sum(axis=0) > 0).ravel())
    points = np.column_stack(np.divmod(np.arange(n * n), n)[::-1]).astype(float)
    nearest = ((points[:, None] - points[None, on_skin]) ** 2).sum(axis=2).argmin(axis=1)
    return means[:, on_skin[nearest]].astype(np.float32)
