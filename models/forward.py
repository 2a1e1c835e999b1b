"""The complete electrode model on P1 triangles: from a sheet's conductivity to a board's impedances, and Jacobians.

Source: Somersalo, Cheney, Isaacson, "Existence and uniqueness for electrode models", SIAM J. Appl. Math. 52 (1992).
With sheet conductivity s [S], contact impedance z_l [ohm m in 2-D] and electrode l of length |E_l|, the energy

    int s |grad u|^2  +  sum_l 1/z_l int_{E_l} (u - U_l)^2

gives a symmetric system in the node potentials u and electrode potentials U. The last electrode is grounded, unit
currents enter at the others: one sparse factorisation and n-1 right-hand sides give the transfer matrix, and every
pattern is read from it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import SuperLU, splu
from skfem import MeshTri

from models import geometry, meshing, patterns
from models.elements import LAMINATE, LAMINATE_REFERENCE, Array, Elements
from models.geometry import SkinGeometry


class ForwardModel(Elements):
    """The skin's finite elements, assembled once; `solve` is dominated by the factorisation.

    skin: a Skin or its name. pattern: None (the skin's own), a name or a (K, 4) array. mesh: "training", "reference",
    "stub", "inverse", a meshing.Grading, or a skfem MeshTri of one's own. Lengths are model units; impedances are ohm.

        model = ForwardModel("square16")
        z0 = model.solve(1.0).impedances()                     # (120,)
        touched = model.solve(model.touched([Shape("circle", 0.2, 0.1, 0.3, 0.15)]))
        touched.impedances("adjacent"), touched.jacobian()     # (208,), (120, n_elements)

    Attributes: skin, pattern (K, 4), contact_impedance (n,), and those of Elements.
    """

    def __init__(
        self,
        skin: SkinGeometry | str = "square16",
        pattern: str | ArrayLike | None = None,
        mesh: str | meshing.Grading | MeshTri = "training",
    ) -> None:
        self.skin = geometry.load(skin) if isinstance(skin, str) else skin
        n = self.skin.n_electrodes
        self.pattern = self.skin.pattern if pattern is None else patterns.pattern(pattern, n)
        self.contact_impedance: Array = self.skin.contact_impedance
        built = mesh if isinstance(mesh, MeshTri) else meshing.build(self.skin, mesh)
        super().__init__(built, LAMINATE_REFERENCE if mesh == "reference" else LAMINATE)
        self._electrodes()
        self._structure()

    def solve(self, conductivity: ArrayLike = 1.0, contact_impedance: ArrayLike | None = None) -> Solution:
        """Fields of unit currents for a sheet conductivity [S] and contact impedances (n,) or scalar.

        conductivity: a number, (n_elements,), or symmetric tensors (n_elements, 3) as xx, xy, yy (what `touched`
        returns). Raises ValueError where a conductivity or contact impedance is not positive and finite, or has the
        wrong length.
        """
        contact = self._contact(contact_impedance)
        fields = self.factorise(self.matrix(conductivity, contact)).solve(self.currents)
        return Solution(self, contact, fields[self._position])

    @property
    def unknown_of_node(self) -> NDArray[np.int64]:
        """(n_nodes + n - 1,) row of `matrix` of each node, then of each electrode but the last."""
        return self._position

    def read(self, transfer: Array, pattern: str | ArrayLike | None = None) -> Array:
        """(K,) ohm, signed: V(sense+) - V(sense-) of unit current drive+ -> drive-, from a transfer matrix (n, n) as
        Solution has it. None: the model's pattern.
        """
        drive_plus, drive_minus, plus, minus = self._rows(pattern).T
        t = transfer
        return np.asarray(t[plus, drive_plus] - t[plus, drive_minus] - t[minus, drive_plus] + t[minus, drive_minus])

    def _rows(self, pattern: str | ArrayLike | None) -> NDArray[np.int64]:
        if pattern is None:
            return self.pattern
        if isinstance(pattern, str):
            return patterns.pattern(pattern, self.skin.n_electrodes)
        return np.asarray(pattern, dtype=np.int64).reshape(-1, 4)  # any measurements, of whatever rank

    def matrix(self, conductivity: ArrayLike = 1.0, contact_impedance: ArrayLike | None = None) -> sparse.csc_matrix:
        """The system's matrix, nodes and all electrodes but the last, in the fill-reducing order (`currents` too)."""
        data = self._stiffness(conductivity) + self._from_contact @ (1 / self._contact(contact_impedance))
        return sparse.csc_matrix((data, self._indices, self._indptr), shape=(self._size, self._size))

    @staticmethod
    def factorise(matrix: sparse.csc_matrix) -> SuperLU:
        """Its factorisation: already in a fill-reducing order and positive definite, so no pivoting, no reordering."""
        return splu(
            matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1, panel_size=8, options={"SymmetricMode": True}
        )

    def _contact(self, given: ArrayLike | None) -> Array:
        values = self.contact_impedance if given is None else given
        return _positive(values, self.skin.n_electrodes, "contact impedance")

    def _stiffness(self, conductivity: ArrayLike) -> Array:
        """The matrix entries of the sheet without its electrodes."""
        tensor = np.asarray(conductivity, dtype=float)
        if tensor.shape != (self.n_elements, 3):
            return np.asarray(self._from_sigma @ _positive(tensor, self.n_elements, "conductivity"))
        xx, xy, yy = tensor.T
        least = np.minimum(np.minimum(xx, yy), xx * yy - xy**2)
        _positive(least, self.n_elements, "conductivity (xx, yy, determinant)")
        stretch, shear = self._from_tensor
        return np.asarray(self._from_sigma @ ((xx + yy) / 2) + stretch @ ((xx - yy) / 2) + shear @ xy)

    def _electrodes(self) -> None:
        """Boundary edges under electrodes: nodes (m, 2), lengths (m,), electrode number (m,)."""
        facets = self.mesh.facets[:, self.mesh.boundary_facets()].T
        ends = self.mesh.p.T[facets]
        offset = self.skin.curve.arc(ends.mean(axis=1))[:, None] - self.skin.electrodes
        offset -= np.round(offset / self.skin.perimeter) * self.skin.perimeter
        electrode, distance = np.abs(offset).argmin(axis=1), np.abs(offset).min(axis=1)
        under = distance < self.skin.widths[electrode] / 2
        self._facets, self._facet_electrode = facets[under], electrode[under]
        self._facet_lengths: Array = np.linalg.norm(ends[under, 1] - ends[under, 0], axis=1)
        length = np.bincount(self._facet_electrode, self._facet_lengths, self.skin.n_electrodes)
        wrong = np.flatnonzero(np.abs(length - self.skin.widths) > 0.02 * self.skin.widths)
        if wrong.size:
            bad = int(wrong[0])
            raise ValueError(
                f"the mesh has {length[bad]:.4g} of electrode {bad}, which is {self.skin.widths[bad]:.4g} wide: "
                "both its ends must be nodes of the mesh"
            )

    def _structure(self) -> None:
        """The matrix's sparsity in a fill-reducing order; its entries as linear maps of conductivity and 1/contact."""
        n_nodes, n = self.mesh.p.shape[1], self.skin.n_electrodes
        self.n_nodes, self._size = n_nodes, n_nodes + n - 1
        cells = self.mesh.t.T
        rows, columns = np.repeat(cells, 3, axis=1).ravel(), np.tile(cells, (1, 3)).ravel()

        a, b = self._facets.T
        electrode, length = self._facet_electrode, self._facet_lengths
        u = n_nodes + electrode
        third, sixth, half = length / 3, length / 6, -length / 2
        blocks = [(a, a, third), (b, b, third), (a, b, sixth), (b, a, sixth)]
        blocks += [(a, u, half), (b, u, half), (u, a, half), (u, b, half), (u, u, length)]
        c_rows, c_columns, c_values = (np.concatenate([block[k] for block in blocks]) for k in range(3))
        c_electrode = np.tile(electrode, len(blocks))
        free = (c_rows < self._size) & (c_columns < self._size)  # the last electrode is the ground

        all_rows, all_columns = np.concatenate([rows, c_rows[free]]), np.concatenate([columns, c_columns[free]])
        position = _fill_reducing(all_rows, all_columns, self._size)
        keys = position[all_columns] * self._size + position[all_rows]
        unique, where = np.unique(keys, return_inverse=True)
        self._indices = (unique % self._size).astype(np.int32)
        self._indptr = np.searchsorted(unique, np.arange(self._size + 1) * self._size).astype(np.int32)

        def scatter(values: Array, to: NDArray[np.int64], source: NDArray[np.int64], n_source: int) -> sparse.csr_array:
            entries = (values.ravel(), (to, source))
            return sparse.csr_array(sparse.coo_array(entries, shape=(len(unique), n_source)))

        gx, gy = self.gradients[..., 0], self.gradients[..., 1]
        xx, yy, xy = (np.einsum("ei,ej,e->eij", p, q, self.areas) for p, q in ((gx, gx), (gy, gy), (gx, gy)))
        to, element = where[: len(rows)], np.repeat(np.arange(self.n_elements), 9)
        self._from_sigma = scatter(xx + yy, to, element, self.n_elements)
        self._from_tensor = tuple(
            scatter(local, to, element, self.n_elements) for local in (xx - yy, xy + xy.transpose(0, 2, 1))
        )
        self._from_contact = scatter(c_values[free], where[len(rows) :], c_electrode[free], n)
        self._position = position
        self.currents: Array = np.zeros((self._size, n - 1), order="F")
        self.currents[position[n_nodes:], np.arange(n - 1)] = 1.0


class Solution:
    """Fields of one conductivity, of unit currents that enter at one electrode and leave at the last.

    potentials (n_nodes, n): of the nodes. transfer (n, n) ohm, symmetric: of electrode i over the last one, with the
    current into electrode j; its last row and column are zero.
    """

    def __init__(self, model: ForwardModel, contact_impedance: Array, fields: Array) -> None:
        self.model = model
        self.contact_impedance = contact_impedance
        n = model.skin.n_electrodes
        self.transfer: Array = np.zeros((n, n))
        self.transfer[:-1, :-1] = fields[model.n_nodes :]
        self.potentials: Array = np.zeros((model.n_nodes, n))
        self.potentials[:, :-1] = fields[: model.n_nodes]

    def impedances(self, pattern: str | ArrayLike | None = None) -> Array:
        """See ForwardModel.read."""
        return self.model.read(self.transfer, pattern)

    def jacobian(self, pattern: str | ArrayLike | None = None) -> Array:
        """(K, n_elements) dZ/dconductivity [ohm/S] by the adjoint: -int_e grad u_drive . grad u_sense."""
        xx, _, yy = self.products(pattern)
        return np.asarray(-(xx + yy))

    def products(self, pattern: str | ArrayLike | None = None) -> tuple[Array, Array, Array]:
        """Each (K, n_elements): int_e grad u_drive . S grad u_sense for S of xx, of xy and of yy alone.

        A change of the conductivity by (xx, xy, yy) changes Z by minus the sum of their products with these.
        """
        drive, sense = self._incidence(pattern)
        model = self.model
        corner = self.potentials[model.mesh.t.T]  # (n_elements, 3, n)
        field = [np.einsum("ec,ecn->ne", model.gradients[..., axis], corner) for axis in range(2)]
        dx, dy, sx, sy = (pair @ part for pair in (drive, sense) for part in field)
        return dx * sx * model.areas, (dx * sy + dy * sx) * model.areas, dy * sy * model.areas

    def jacobian_contact(self, pattern: str | ArrayLike | None = None) -> Array:
        """(K, n) dZ/d contact impedance [1/m]: 1/z_l^2 int_{E_l} (u_drive - U_drive)(u_sense - U_sense)."""
        drive, sense = self._incidence(pattern)
        model = self.model
        jump = self.potentials[model._facets] - self.transfer[model._facet_electrode][:, None]  # (m, 2, n)
        d, s = jump @ drive.T, jump @ sense.T
        mean = (2 * (d * s).sum(axis=1) + d[:, 0] * s[:, 1] + d[:, 1] * s[:, 0]) / 6  # of a product of linear functions
        result = np.zeros((model.skin.n_electrodes, len(drive)))
        np.add.at(result, model._facet_electrode, mean * model._facet_lengths[:, None])
        return np.asarray((result / self.contact_impedance[:, None] ** 2).T)

    def _incidence(self, pattern: str | ArrayLike | None) -> tuple[Array, Array]:
        rows, n = self.model._rows(pattern), self.model.skin.n_electrodes
        return patterns.incidence(rows[:, :2], n), patterns.incidence(rows[:, 2:], n)


@lru_cache(maxsize=8)
def shared(skin: str, mesh: str = "training") -> ForwardModel:
    """One ForwardModel of a shipped skin for everybody in this process (building one takes a second or more)."""
    return ForwardModel(skin, mesh=mesh)


def _positive(values: ArrayLike, n: int, what: str) -> Array:
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{what} has shape {array.shape}, expected a number or ({n},)")
    if not (np.isfinite(array) & (array > 0)).all():
        raise ValueError(f"{what} must be positive and finite everywhere, found {np.min(array)}")
    return np.broadcast_to(array, (n,)).copy()


def _fill_reducing(rows: NDArray[np.int64], columns: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """(size,) position of each unknown in a minimum-degree order: found once, used for every conductivity."""
    pattern = sparse.csc_matrix((np.full(len(rows), -1e-9), (rows, columns)), shape=(size, size))
    pattern.setdiag(1.0)
    factor = splu(pattern, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.perm_c, dtype=np.int64)
