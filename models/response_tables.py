"""The tables a bundle ships for `touch_response.TouchResponse`, from a forward model.

The field of a dipole on the sheet is the infinite sheet's plus a smooth rest. The rest solves the sheet's own
equations with the dipole's current through the outline, and its potential under the electrodes, as the only sources:
both are integrated over the outline, so a dipole's singularity never meets the mesh.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sparse

from models.elements import Array
from models.forward import ForwardModel
from models.touch_response import ResponseTables

COARSE, FINE = 24, 48
GAUSS = ((0.5 - np.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + np.sqrt(0.15), 5 / 18))


def response_tables(model: ForwardModel, coarse: int = COARSE, fine: int = FINE) -> ResponseTables:
    """About a second and a half for each thousand of 2 * coarse^2 dipoles."""
    axis = -1 + 2 * (np.arange(coarse) + 0.5) / coarse
    x, y = np.meshgrid(axis, axis)
    centres = np.column_stack([x.ravel(), y.ravel()])
    inside = np.asarray(model.skin.inside(centres), dtype=bool)
    solution = model.solve(1.0)
    fields = _filled(_mean_gradients(model, fine, solution.potentials), _known(model, fine))
    rest = model.solve_sources(_sources(model, centres[inside]))
    regular = np.zeros((2, 2, coarse**2, coarse**2))
    found = _filled(_mean_gradients(model, coarse, rest), _known(model, coarse))  # (2, P, 2 * I)
    count = int(inside.sum())
    for axis_of_dipole in range(2):
        part = found[..., axis_of_dipole * count : (axis_of_dipole + 1) * count]
        regular[:, axis_of_dipole][:, :, inside] = part
    # Reciprocity; what two meshes' worth of rounding leaves is averaged out.
    regular = 0.5 * (regular + regular.transpose(1, 0, 3, 2))
    near = _nearest(centres, inside)
    regular = regular[:, :, near[:, None], near]
    return ResponseTables(fields.astype(np.float32), regular.astype(np.float32), inside.reshape(coarse, coarse))


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


def _mean_gradients(model: ForwardModel, n: int, potentials: Array) -> Array:
    """(2, n * n, c) mean field of each pixel, of potentials (nodes, c); 0 where a pixel has no element."""
    return _pixel_means(model, n, _gradients(model, potentials))


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


def _sources(model: ForwardModel, dipoles: Array) -> Array:
    """(nodes + electrodes, 2 * I) right-hand sides of unit dipoles at (I, 2), along x and then along y."""
    facets = model.mesh.facets[:, model.mesh.boundary_facets()]
    start, end = model.mesh.p[:, facets[0]].T, model.mesh.p[:, facets[1]].T
    step = end - start
    length = np.linalg.norm(step, axis=1)
    normal = np.column_stack([step[:, 1], -step[:, 0]]) / length[:, None]
    outward = (normal * ((start + end) / 2 - model.centroids[model.mesh.f2t[0, model.mesh.boundary_facets()]])).sum(1)
    normal *= np.sign(outward)[:, None]
    electrode = model.electrode_of(facets.T)
    under = np.flatnonzero(electrode >= 0)
    per_ohm = 1 / model.contact_impedance[electrode[under]]
    result = np.zeros((model.n_nodes + model.skin.n_electrodes, 2 * len(dipoles)))
    for at, weight in GAUSS:
        offset = (start + at * step)[:, None] - dipoles[None]  # (facets, I, 2)
        r2 = (offset**2).sum(axis=2)
        for axis in range(2):
            part = result[:, axis * len(dipoles) : (axis + 1) * len(dipoles)]
            potential = offset[..., axis] / r2 / (2 * np.pi)
            along = (offset * normal[:, None]).sum(axis=2)
            flux = (normal[:, axis, None] - 2 * offset[..., axis] * along / r2) / r2 / (2 * np.pi)
            through = -(weight * length)[:, None] * flux
            into = -(weight * length[under] * per_ohm)[:, None] * potential[under]
            for nodes, share in ((facets[0], 1 - at), (facets[1], at)):
                np.add.at(part, nodes, share * through)
                np.add.at(part, nodes[under], share * into)
            np.add.at(part, model.n_nodes + electrode[under], -into)
    return result
