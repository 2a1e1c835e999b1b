"""The complete electrode model on P1 triangles: from a sheet's conductivity to the impedances a board would read, and their Jacobians.

Source: Somersalo, Cheney, Isaacson, "Existence and uniqueness for electrode models", SIAM J. Appl. Math. 52 (1992). With sheet
conductivity s [S], contact impedance z_l [ohm m in 2-D] and electrode l of length |E_l|, the energy

    int s |grad u|^2  +  sum_l 1/z_l int_{E_l} (u - U_l)^2

gives a symmetric system in the node potentials u and electrode potentials U. The last electrode is grounded, unit currents enter
at the others: one sparse factorisation and n-1 right-hand sides give the transfer matrix, and every pattern is read from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu
from skfem import MeshTri

from models import geometry, meshing, patterns
from models.geometry import Skin
from models.shapes import Shape

Array = NDArray[np.float64]

# Share of the laminate's anisotropy in elements that an outline crosses, see ForwardModel.touched. Chosen so that the difference
# signals of the coarser meshes are those of the reference mesh, whose elements are small enough for plain area fractions.
LAMINATE = 0.65
LAMINATE_REFERENCE = 0.0
CROSSED_LEVEL = 7  # such an element is sampled at the centroids of 7 x 7 equal sub-triangles


class ForwardModel:
    """The skin's finite elements, assembled once; `solve` is dominated by the factorisation.

    skin: a Skin or its name. pattern: None (the skin's own), a name or a (K, 4) array. mesh: "training", "reference", "stub",
    "inverse", a meshing.Grading, or a skfem MeshTri of one's own. Lengths are model units; impedances are ohm.

        model = ForwardModel("square16")
        z0 = model.solve(1.0).impedances()                     # (120,)
        touched = model.solve(model.touched([Shape("circle", 0.2, 0.1, 0.3, 0.15)]))
        touched.impedances("adjacent"), touched.jacobian()     # (208,), (120, n_elements)

    Attributes: n_elements, areas (n_elements,), centroids (n_elements, 2), pattern (K, 4), contact_impedance (n,), mesh.
    """

    def __init__(
        self, skin: Skin | str = "square16", pattern: str | ArrayLike | None = None, mesh: str | meshing.Grading | MeshTri = "training"
    ) -> None:
        self.skin = geometry.load(skin) if isinstance(skin, str) else skin
        n = self.skin.n_electrodes
        self.pattern = self.skin.pattern if pattern is None else patterns.pattern(pattern, n)
        self.mesh = mesh if isinstance(mesh, MeshTri) else meshing.build(self.skin, mesh)
        self.contact_impedance: Array = self.skin.contact_impedance
        self._share = LAMINATE_REFERENCE if mesh == "reference" else LAMINATE
        self._geometry()
        self._electrodes()
        self._structure()

    # --- what a shape needs to become a conductivity ---

    def subpoints(self, q: int = 16) -> Array:
        """(n_elements, q, 2) points of equal weight in every element; q is a square: 1, 4, 9, 16 ..."""
        level = round(q**0.5)
        if level**2 != q:
            raise ValueError(f"{q} points per element: expected a square number (an element is cut into that many)")
        return np.asarray(np.einsum("qc,eck->eqk", _barycentric(level), self.corners))

    def average(self, field, q: int = 16) -> Array:  # type: ignore[no-untyped-def]
        """(n_elements,) mean over each element of field(points (n_elements, q, 2)) -> (n_elements, q)."""
        return np.asarray(np.asarray(field(self.subpoints(q)), dtype=float).mean(axis=1))

    def touched(self, shapes: Iterable[Shape], background: float = 1.0) -> Array:
        """(n_elements, 3) conductivity xx, xy, yy [S] of a background less the drop of touches (where two overlap, the larger).

        An element that an outline crosses conducts like a laminate: the harmonic mean across the outline, the arithmetic mean
        along it. A part LAMINATE of that anisotropy gives on the training mesh what plain area fractions give on the reference
        mesh: the difference signals of the EIDORS scenes to 0.13 % (pairs; rms), where area fractions alone are 0.6 % off and
        biased low. (All of it would give the limit of ever finer meshes, up to 0.9 % above EIDORS's own frames for small sharp shapes.)
        Background scales the sheet, drop included: a touch takes the same share of whatever conducts there.
        """
        shapes = list(shapes)
        near, sampled = np.zeros(self.n_elements, dtype=bool), np.zeros(self.n_elements, dtype=bool)
        for shape in shapes:
            reach = np.hypot(self.centroids[:, 0] - shape.x, self.centroids[:, 1] - shape.y) - self._sizes
            close = np.flatnonzero(reach < shape.radius)
            near[close] = True
            if shape.kind == "hertz":
                sampled[close] = True
            else:
                sampled[close[shape.edge_distance(self.centroids[close]) < self._sizes[close]]] = True
        result = np.tile([1.0, 0.0, 1.0], (self.n_elements, 1))
        whole = np.flatnonzero(near & ~sampled)
        result[whole, 0] = result[whole, 2] = 1 - _drop(shapes, self.centroids[whole])
        cut = np.flatnonzero(sampled)
        result[cut] = _laminate(self.corners[cut], lambda points: 1 - _drop(shapes, points), self._share)
        return background * result

    def pixel_map(self, n: int, q: int = 4) -> sparse.csr_array:
        """(n*n, n_elements) row-stochastic: pixel values of an element-wise field, pixel [iy, ix] at row iy*n + ix.

        Each pixel of the square [-1, 1]^2 is sampled at q x q points; those outside the skin do not count, and the rows of pixels
        wholly outside are zero. Its transpose puts a Jacobian on pixels: J_pix = J @ element_map(n).
        """
        return _pixel_map(self, n, q)

    def element_map(self, n: int, q: int = 16) -> sparse.csr_array:
        """(n_elements, n*n) row-stochastic: mean over each element of a pixel image (raveled [iy, ix]); J_pix = J @ element_map."""
        points = self.subpoints(q)
        index = np.clip(((points + 1) * n / 2).astype(int), 0, n - 1)
        columns = index[..., 1] * n + index[..., 0]
        rows = np.repeat(np.arange(self.n_elements), q)
        shape = (self.n_elements, n * n)
        return sparse.csr_array(sparse.coo_array((np.full(rows.size, 1 / q), (rows, columns.ravel())), shape=shape))

    # --- the solution ---

    def solve(self, conductivity: ArrayLike = 1.0, contact_impedance: ArrayLike | None = None) -> Solution:
        """Fields of unit currents for a sheet conductivity [S] and contact impedances (n,) or scalar.

        conductivity: a number, (n_elements,), or symmetric tensors (n_elements, 3) as xx, xy, yy (what `touched` returns).
        Raises ValueError where a conductivity or contact impedance is not positive and finite, or has the wrong length.
        """
        contact = _positive(
            self.contact_impedance if contact_impedance is None else contact_impedance, self.skin.n_electrodes, "contact impedance"
        )
        data = self._stiffness(conductivity) + self._from_contact @ (1 / contact)
        matrix = sparse.csc_matrix((data, self._indices, self._indptr), shape=(self._size, self._size))
        factor = splu(
            matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1, panel_size=8, options={"SymmetricMode": True}
        )
        fields = factor.solve(self._currents)
        return Solution(self, contact, fields[self._unpermute])

    def _stiffness(self, conductivity: ArrayLike) -> Array:
        """The matrix entries of the sheet without its electrodes."""
        tensor = np.asarray(conductivity, dtype=float)
        if tensor.shape != (self.n_elements, 3):
            return np.asarray(self._from_sigma @ _positive(tensor, self.n_elements, "conductivity"))
        xx, xy, yy = tensor.T
        _positive(np.minimum(np.minimum(xx, yy), xx * yy - xy**2), self.n_elements, "conductivity (xx, yy and determinant)")
        stretch, shear = self._from_tensor
        return np.asarray(self._from_sigma @ ((xx + yy) / 2) + stretch @ ((xx - yy) / 2) + shear @ xy)

    # --- precomputation ---

    def _geometry(self) -> None:
        corners: Array = self.mesh.p.T[self.mesh.t.T]
        self.corners = corners
        edge = np.stack([corners[:, 2] - corners[:, 1], corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 0]], axis=1)
        twice = edge[:, 2, 0] * -edge[:, 1, 1] + edge[:, 2, 1] * edge[:, 1, 0]
        self.areas: Array = np.abs(twice) / 2
        self.centroids: Array = corners.mean(axis=1)
        self.n_elements: int = len(self.areas)
        self._sizes: Array = np.sqrt(((corners - self.centroids[:, None]) ** 2).sum(axis=2).max(axis=1))
        # gradients of the three hat functions: the opposite edge turned by a right angle, over twice the area
        self._gradients: Array = np.stack([-edge[..., 1], edge[..., 0]], axis=2) / twice[:, None, None]

    def _electrodes(self) -> None:
        """Boundary edges of each electrode: nodes (m, 2), lengths (m,), electrode number (m,)."""
        facets = self.mesh.facets[:, self.mesh.boundary_facets()].T
        ends = self.mesh.p.T[facets]
        s = self.skin.arc(ends.mean(axis=1))
        offset = s[:, None] - self.skin.electrodes
        offset -= np.round(offset / self.skin.perimeter) * self.skin.perimeter
        electrode, distance = np.abs(offset).argmin(axis=1), np.abs(offset).min(axis=1)
        under = distance < self.skin.widths[electrode] / 2
        self._facets, self._facet_electrode = facets[under], electrode[under]
        self._facet_lengths: Array = np.linalg.norm(ends[under, 1] - ends[under, 0], axis=1)
        length = np.bincount(self._facet_electrode, self._facet_lengths, self.skin.n_electrodes)
        wrong = np.abs(length - self.skin.widths) > 0.02 * self.skin.widths
        if wrong.any():
            bad = int(np.flatnonzero(wrong)[0])
            raise ValueError(f"the mesh has {length[bad]:.4g} of electrode {bad}'s width {self.skin.widths[bad]:.4g}: its ends must be nodes")

    def _structure(self) -> None:
        """The matrix's sparsity in a fill-reducing order, and its entries as linear functions of conductivity and 1/contact."""
        n_nodes, n = self.mesh.p.shape[1], self.skin.n_electrodes
        self._n_nodes, self._size = n_nodes, n_nodes + n - 1
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
        order = _fill_reducing(all_rows, all_columns, self._size)
        position = np.empty(self._size, dtype=np.int64)
        position[order] = np.arange(self._size)
        keys = position[all_columns] * self._size + position[all_rows]
        unique, where = np.unique(keys, return_inverse=True)
        self._indices = (unique % self._size).astype(np.int32)
        self._indptr = np.searchsorted(unique, np.arange(self._size + 1) * self._size).astype(np.int32)

        def scatter(values: Array, to: NDArray[np.int64], source: NDArray[np.int64], n_source: int) -> sparse.csr_array:
            return sparse.csr_array(sparse.coo_array((values.ravel(), (to, source)), shape=(len(unique), n_source)))

        gx, gy = self._gradients[..., 0], self._gradients[..., 1]
        xx, yy, xy = (np.einsum("ei,ej,e->eij", p, q, self.areas) for p, q in ((gx, gx), (gy, gy), (gx, gy)))
        to, element = where[: len(rows)], np.repeat(np.arange(self.n_elements), 9)
        self._from_sigma = scatter(xx + yy, to, element, self.n_elements)
        self._from_tensor = tuple(
            scatter(local, to, element, self.n_elements) for local in (xx - yy, xy + xy.transpose(0, 2, 1))
        )
        self._from_contact = scatter(c_values[free], where[len(rows) :], c_electrode[free], n)
        self._unpermute = position
        self._currents: Array = np.zeros((self._size, n - 1), order="F")
        self._currents[position[n_nodes:], np.arange(n - 1)] = 1.0


class Solution:
    """Fields of one conductivity: potentials (n_nodes, n-1) and electrode potentials of unit currents that leave at the last electrode."""

    def __init__(self, model: ForwardModel, contact_impedance: Array, fields: Array) -> None:
        self.model = model
        self.contact_impedance = contact_impedance
        self._fields = fields

    @property
    def potentials(self) -> Array:
        """(n_nodes, n): node potentials of unit current into each electrode and out of the last."""
        nodes = self._fields[: self.model._n_nodes]
        return np.hstack([nodes, np.zeros((len(nodes), 1))])

    @property
    def transfer(self) -> Array:
        """(n, n) ohm: potential of electrode i over the last one, with unit current into j and out of the last one."""
        n = self.model.skin.n_electrodes
        full = np.zeros((n, n))
        full[:-1, :-1] = self._fields[self.model._n_nodes :]
        return full

    def impedances(self, pattern: str | ArrayLike | None = None) -> Array:
        """(K,) ohm, signed: V(sense+) - V(sense-) of unit current drive+ -> drive-. None: the model's pattern."""
        rows = self._rows(pattern)
        t = self.transfer
        drive_plus, drive_minus, sense_plus, sense_minus = rows.T
        return np.asarray(
            t[sense_plus, drive_plus] - t[sense_plus, drive_minus] - t[sense_minus, drive_plus] + t[sense_minus, drive_minus]
        )

    def jacobian(self, pattern: str | ArrayLike | None = None) -> Array:
        """(K, n_elements) dZ/dconductivity [ohm/S] by the adjoint: -int_e grad u_drive . grad u_sense."""
        rows, n, model = self._rows(pattern), self.model.skin.n_electrodes, self.model
        drive, sense = patterns.incidence(rows[:, :2], n), patterns.incidence(rows[:, 2:], n)
        potentials = self.potentials
        corner = potentials[model.mesh.t.T]  # (n_elements, 3, n)
        result = np.zeros((len(rows), model.n_elements))
        for k in range(2):
            field = np.einsum("ec,ecn->ne", model._gradients[..., k], corner)
            result -= (drive @ field) * (sense @ field)
        return result * model.areas

    def jacobian_contact(self, pattern: str | ArrayLike | None = None) -> Array:
        """(K, n) dZ/d contact impedance [ohm/(ohm m)]: 1/z_l^2 int_{E_l} (u_drive - U_drive)(u_sense - U_sense)."""
        rows, n, model = self._rows(pattern), self.model.skin.n_electrodes, self.model
        drive, sense = patterns.incidence(rows[:, :2], n), patterns.incidence(rows[:, 2:], n)
        jump = self.potentials[model._facets] - self.transfer[model._facet_electrode][:, None]  # (m, 2, n)
        d, s = jump @ drive.T, jump @ sense.T
        mean = (2 * (d * s).sum(axis=1) + d[:, 0] * s[:, 1] + d[:, 1] * s[:, 0]) / 6
        result = np.zeros((n, len(rows)))
        np.add.at(result, model._facet_electrode, mean * model._facet_lengths[:, None])
        return np.asarray((result / self.contact_impedance[:, None] ** 2).T)

    def _rows(self, pattern: str | ArrayLike | None) -> NDArray[np.int64]:
        return self.model.pattern if pattern is None else patterns.pattern(pattern, self.model.skin.n_electrodes)


@lru_cache(maxsize=8)
def shared(skin: str, mesh: str = "training") -> ForwardModel:
    """One ForwardModel of a shipped skin for everybody in this process (building one takes seconds)."""
    return ForwardModel(skin, mesh=mesh)


def _positive(values: ArrayLike, n: int, what: str) -> Array:
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{what} has shape {array.shape}, expected a number or ({n},)")
    if not (np.isfinite(array) & (array > 0)).all():
        raise ValueError(f"{what} must be positive and finite everywhere, found {np.min(array)}")
    return np.broadcast_to(array, (n,)).copy()


def _barycentric(k: int) -> Array:
    """(k*k, 3) centroids of the k*k equal sub-triangles."""
    up = [(i, j) for i in range(k) for j in range(k - i)]
    points = [((3 * i + 1) / (3 * k), (3 * j + 1) / (3 * k)) for i, j in up]
    points += [((3 * i + 2) / (3 * k), (3 * j + 2) / (3 * k)) for i, j in up if i + j < k - 1]
    xy = np.array(points)
    return np.column_stack([1 - xy.sum(axis=1), xy])


def _drop(shapes: list[Shape], points: Array) -> Array:
    """Conductivity drop at points (..., 2)."""
    drop = np.zeros(points.shape[:-1])
    for shape in shapes:
        np.maximum(drop, shape.drop * shape.profile(points), out=drop)
    return drop


def _laminate(corners: Array, conductivity: Callable[[Array], Array], share: float) -> Array:
    """(m, 3) conductivity tensors of triangles (m, 3, 2) that an outline crosses; its normal is along the mean gradient."""
    points = np.einsum("qc,eck->eqk", _barycentric(CROSSED_LEVEL), corners)
    sigma = conductivity(points)
    along, across = sigma.mean(axis=1), 1 / (1 / sigma).mean(axis=1)
    offset = points - points.mean(axis=1, keepdims=True)
    moment = np.einsum("eqi,eqj->eij", offset, offset)
    slope = np.einsum("eqi,eq->ei", offset, sigma - along[:, None])
    gradient = np.linalg.solve(moment, slope[..., None])[..., 0]
    steepness = np.linalg.norm(gradient, axis=1, keepdims=True)
    normal = np.divide(gradient, steepness, out=np.zeros_like(gradient), where=steepness > 1e-9)
    less = share * (across - along)
    nx, ny = normal.T
    return np.column_stack([along + less * nx**2, less * nx * ny, along + less * ny**2])


def _fill_reducing(rows: NDArray[np.int64], columns: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """A minimum-degree elimination order of the symmetric pattern: found once, used for every conductivity."""
    pattern = sparse.csc_matrix((np.full(len(rows), -1e-9), (rows, columns)), shape=(size, size))
    pattern.setdiag(1.0)
    factor = splu(pattern, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c)


def _pixel_map(model: ForwardModel, n: int, q: int) -> sparse.csr_array:
    fine = -1 + 2 * (np.arange(n * q) + 0.5) / (n * q)
    x, y = np.meshgrid(fine, fine)
    points = np.column_stack([x.ravel(), y.ravel()])
    inside = np.flatnonzero(model.skin.inside(points))
    element = _find(model, points[inside])
    hit = element >= 0
    iy, ix = np.divmod(inside[hit], n * q)
    pixel = (iy // q) * n + ix // q
    counts = np.bincount(pixel, minlength=n * n)
    weights = 1 / counts[pixel]
    matrix = sparse.coo_array((weights, (pixel, element[hit])), shape=(n * n, model.n_elements))
    return sparse.csr_array(matrix)


def _find(model: ForwardModel, points: Array) -> NDArray[np.int64]:
    """(N,) element that holds each point, -1 where none does (between a chord and its arc)."""
    from matplotlib.tri import Triangulation

    finder = Triangulation(*model.mesh.p, model.mesh.t.T).get_trifinder()
    return np.asarray(finder(points[:, 0], points[:, 1]), dtype=np.int64)
