"""Impedances under touches from the untouched sheet's own inverse, several times faster than a solution of each.

A touch changes the stiffness of the m nodes under it, A = A0 + E D E^T. With G = A0^-1 (dense, made once) the
electrodes see

    S^T A^-1 S = G_SS - G_ST D (I + G_TT D)^-1 G_TS,        S electrodes, T the nodes under the touch

(the Sherman-Morrison-Woodbury identity): one m x m problem, and the result is the finite elements' own to rounding. G
is kept in single precision: 340 MB for the training mesh of square16, made in two seconds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.forward import ForwardModel

Array = NDArray[np.float64]

MOST_NODES = 800  # under a touch: beyond, the sparse factorisation is faster
COLUMNS = 16  # of the inverse at a time: more leave the processor's cache
SAME = 1e-12  # relative: what counts as an untouched element


class CondensedSheet:
    """One untouched sheet: conductivity as ForwardModel.solve takes it, contact impedances too."""

    def __init__(self, model: ForwardModel, untouched: Array, contact_impedance: ArrayLike | None = None) -> None:
        """untouched (n_elements, 3): conductivity tensors."""
        self.model, self.untouched, self.contact_impedance = model, untouched, contact_impedance
        factor = model.factorise(model.matrix(untouched, contact_impedance))
        size = len(model.currents)
        self._inverse = np.empty((size, size), np.float32)
        for start in range(0, size, COLUMNS):
            unit = np.zeros((size, min(COLUMNS, size - start)), order="F")
            unit[start + np.arange(unit.shape[1]), np.arange(unit.shape[1])] = 1.0
            self._inverse[start : start + unit.shape[1]] = factor.solve(unit).T  # symmetric: rows are columns
        node = model.unknown_of_node
        self._node: NDArray[np.int64] = node[: model.n_nodes]
        self._electrode: NDArray[np.int64] = node[model.n_nodes :]
        self._seen = self._inverse[np.ix_(self._electrode, self._electrode)].astype(float)

    def impedances(self, conductivity: Array) -> Array:
        """(K,) ohm of the model's pattern, for conductivity tensors (n_elements, 3)."""
        model = self.model
        change = conductivity - self.untouched
        element = np.flatnonzero(np.abs(change).max(axis=1) > SAME)
        nodes, local = np.unique(model.mesh.t[:, element], return_inverse=True)
        if len(nodes) > MOST_NODES:
            return model.solve(conductivity, self.contact_impedance).impedances()
        local = local.reshape(3, len(element))
        xx, xy, yy = (change[element] * model.areas[element, None]).T
        gx, gy = (model.gradients[element, :, axis] for axis in range(2))
        flow_x, flow_y = gx * xx[:, None] + gy * xy[:, None], gx * xy[:, None] + gy * yy[:, None]
        entries = gx[:, :, None] * flow_x[:, None, :] + gy[:, :, None] * flow_y[:, None, :]
        m = len(nodes)
        place = (local.T[:, :, None] * m + local.T[:, None, :]).ravel()
        stiffness = np.bincount(place, entries.ravel(), m * m).reshape(m, m)
        under = self._node[nodes]
        between = self._inverse[np.ix_(under, under)].astype(float)
        seen = self._inverse[np.ix_(under, self._electrode)].astype(float)
        moved = stiffness @ np.linalg.solve(np.eye(m) + between @ stiffness, seen)
        n = model.skin.n_electrodes
        transfer = np.zeros((n, n))
        transfer[:-1, :-1] = self._seen - seen.T @ moved
        return model.read(transfer)
