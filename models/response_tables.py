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
    means = _pixel_means(model, fine, _gradients(model, model.solve(1.0).potentials))
    return ResponseTables(_filled(means, _known(model, fine)).astype(np.float32), inside.reshape(coarse, coarse))


def mounted_fields(model: ForwardModel, tensors: Array, potentials: Array, n: int = FINE) -> npt.NDArray[np.float32]:
    """(2, n * n, E) `ResponseTables.fields` of a sheet of any conductivity, by whose square root they are multiplied:
    a drop takes a share of what conducts, so their products are to such a sheet what those of fields are to an even
    one. tensors (elements, 3): xx, xy, yy; potentials (nodes, E): of a unit current at each electrode.
    """
    means = _pixel_means(model, n, _rooted(tensors, _gradients(model, potentials)))
    return _filled(means, _known(model, n)).astype(np.float32)


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


def _pixel_means(model: ForwardModel, n: int, values: Array) -> Array:
    """(2, n * n, c) of values (2, elements, c)."""
    share = sparse.csr_array(model.element_map(n, 64).T * model.areas)
    total = np.maximum(np.asarray(share.sum(axis=1)).ravel(), 1e-12)
    return np.array([share @ part / total[:, None] for part in values])


def _known(model: ForwardModel, n: int) -> npt.NDArray[np.bool_]:
    return np.asarray(model.element_map(n, 64).sum(axis=0) > 0).ravel()


def _filled(values: Array, known: npt.NDArray[np.bool_]) -> Array:
    """Pixels off the skin take their nearest neighbour's values, so that interpolation at the edge has two sides."""
    n = round(len(known) ** 0.5)
    iy, ix = np.divmod(np.arange(n * n), n)
    return values[:, _nearest(np.column_stack([ix, iy]).astype(float), known)]


def _nearest(points: Array, known: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """For each point the nearest that is known."""
    there = np.flatnonzero(known)
    distance = ((points[:, None] - points[None, there]) ** 2).sum(axis=2)
    return np.asarray(there[distance.argmin(axis=1)], dtype=np.int64)
