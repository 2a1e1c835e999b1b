"""A skin as it is mounted: what a calibration may find of it, as few numbers, and the physics that follow from them.

    log of the common factor of all |Z|                  1
    log of each contact impedance over the file's        E
    shift of each electrode along the outline            E    model units
    smooth field: log of the conductivity                M    coefficients of the field's leading modes, unit prior
    anisotropy: trace-free logarithm of the tensor       2    (xx - yy) / 2 and xy

The sheet conducts exp(field) * expm(anisotropy). The field is a Gaussian process of correlation length FIELD_LENGTH,
half a side of the square skin; its leading modes over the skin hold all but a thousandth of its variance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.forward import ForwardModel, Solution
from models.geometry import SkinGeometry
from models.patterns import incidence

Array = NDArray[np.float64]

FIELD_LENGTH = 1.0  # model units
FIELD_SD = 0.05  # relative
ANISOTROPY_SD = 0.05
CONTACT_SD = 0.7  # of the logarithm: a factor of two either way is nothing unusual
SHIFT_SD = 0.02  # model units: 1 % of the square's side
GAIN_SD = 3.0  # of the logarithm: boards in any unit
MOST_SHIFT = 0.08  # model units: 4 % of the square's side
LEFT_OUT = 1e-3  # of the field's variance
GRID = 17  # points a side on which the field's modes are found


class FieldModes:
    """Modes of a smooth field over a skin, each scaled to its prior's standard deviation; their means are taken out."""

    def __init__(self, skin: SkinGeometry) -> None:
        axis = np.linspace(-1, 1, GRID)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        self._points: Array = grid[skin.inside(grid)]
        values, vectors = np.linalg.eigh(self._kernel(self._points))
        keep = np.cumsum(values) > LEFT_OUT * values.sum()
        self._from_grid: Array = FIELD_SD * vectors[:, keep][:, ::-1] / np.sqrt(values[keep][::-1])
        self._mean: Array = np.zeros(self.count)
        self._mean = self(self._points).mean(axis=0)

    @property
    def count(self) -> int:
        return int(self._from_grid.shape[1])

    def __call__(self, points: Array) -> Array:
        """(m, M) of the logarithm of the conductivity at points (m, 2)."""
        return np.asarray(self._kernel(points) @ self._from_grid - self._mean)

    def _kernel(self, points: Array) -> Array:
        square = ((points[:, None] - self._points[None]) ** 2).sum(axis=2)
        return np.asarray(np.exp(-0.5 * square / FIELD_LENGTH**2))


@dataclass(frozen=True, eq=False)
class Mounting:
    """E electrodes, M modes of the field; see above.

    log_gain           logarithm of the common factor of all |Z|
    contact (E,)       logarithm of each contact impedance over the file's
    shift (E,)         model units along the outline, in the direction in which it is drawn
    field (M,)         coefficients of FieldModes, in units of their prior
    anisotropy (2,)    (xx - yy) / 2 and xy of the tensor's logarithm
    """

    log_gain: float
    contact: Array
    shift: Array
    field: Array
    anisotropy: Array

    @classmethod
    def nominal(cls, skin: SkinGeometry, modes: int) -> Mounting:
        n = skin.n_electrodes
        return cls(0.0, np.zeros(n), np.zeros(n), np.zeros(modes), np.zeros(2))

    @property
    def vector(self) -> Array:
        return np.concatenate([[self.log_gain], self.contact, self.shift, self.field, self.anisotropy])

    def with_vector(self, values: Array) -> Mounting:
        n, m = len(self.contact), len(self.field)
        parts = np.split(values, np.cumsum([1, n, n, m]))
        return Mounting(float(parts[0][0]), *parts[1:])

    @property
    def prior_sd(self) -> Array:
        """Standard deviations of `vector` before anything is measured."""
        n, m = len(self.contact), len(self.field)
        return np.repeat([GAIN_SD, CONTACT_SD, SHIFT_SD, 1.0, ANISOTROPY_SD], [1, n, n, m, 2])

    @property
    def tensor(self) -> Array:
        """(3,) xx, xy, yy that multiplies the sheet's conductivity; determinant 1."""
        a, b = self.anisotropy
        size = float(np.hypot(a, b))
        grow = np.sinh(size) / size if size > 1e-12 else 1.0
        return np.asarray(np.cosh(size) * np.array([1.0, 0.0, 1.0]) + grow * np.array([a, b, -a]))

    def skin(self, nominal: SkinGeometry) -> SkinGeometry:
        """The electrodes where they are, with the contact impedances that they have."""
        return nominal.moved(self.shift, nominal.contact_impedance * np.exp(self.contact))

    def conductivity(self, modes: Array) -> Array:
        """(m, 3) of the untouched sheet where the field's modes are (m, M)."""
        return np.asarray(np.exp(modes @ self.field)[:, None] * self.tensor)


def most_shift(skin: SkinGeometry) -> Array:
    """(E,) model units: how far each electrode may be thought off its place, MOST_SHIFT, and less where a neighbour is
    near: two that come together leave a fifth of their gap.
    """
    order = np.argsort(np.mod(skin.electrodes, skin.perimeter))
    place, width = skin.electrodes[order], skin.widths[order]
    after = np.mod(np.roll(place, -1) - place, skin.perimeter) - (width + np.roll(width, -1)) / 2  # to the next one
    most = np.empty(len(order))
    most[order] = np.minimum(MOST_SHIFT, 0.4 * np.minimum(after, np.roll(after, 1)))
    return most


class Predicted:
    """|Z| of a mounted skin (K measurements), and the derivative (K, P) of its logarithm to the P numbers of
    `Mounting.vector`.
    """

    def __init__(self, nominal: SkinGeometry, mounting: Mounting, modes: FieldModes, mesh: str) -> None:
        self.mounting = mounting
        self.model = ForwardModel(mounting.skin(nominal), mesh=mesh)
        self.modes: Array = modes(self.model.centroids)
        self.tensors: Array = mounting.conductivity(self.modes)
        self.solution: Solution = self.model.solve(self.tensors)
        self.signed: Array = self.solution.impedances()

    @property
    def log(self) -> Array:
        """(K,) logarithm of |Z|, the common factor included."""
        return np.asarray(np.log(np.abs(self.signed)) + self.mounting.log_gain)

    def derivative(self) -> Array:
        """(K, P) of `log`."""
        solution, signed = self.solution, self.signed[:, None]
        contact = solution.jacobian_contact() * self.model.contact_impedance
        products = solution.products()
        even = np.exp(self.modes @ self.mounting.field)
        field: Array = np.zeros((len(signed), self.modes.shape[1] + 2))
        for part, base, turned in zip(products, self.mounting.tensor, self._tensor_slopes(), strict=True):
            field -= part @ np.column_stack([base * even[:, None] * self.modes, even[:, None] * turned])
        return np.column_stack(
            [np.ones(len(signed)), np.column_stack([contact, shift_derivative(solution), field]) / signed]
        )

    def _tensor_slopes(self) -> Array:
        """(3, 2) of the tensor's xx, xy, yy to the two numbers of the anisotropy."""
        step, slopes = 1e-6, []
        for k in range(2):
            change = step * np.eye(2)[k]
            high, low = (replace(self.mounting, anisotropy=self.mounting.anisotropy + s * change) for s in (1, -1))
            slopes.append((high.tensor - low.tensor) / (2 * step))
        return np.column_stack(slopes)


def shift_derivative(solution: Solution) -> Array:
    """(K, E) dZ per model unit that an electrode moves along the outline.

    Moving electrode l adds what it draws at its front end and takes away what it drew at its back:
    -1/z_l [(u_drive - U_drive)(u_sense - U_sense)] from back to front.
    """
    model, skin = solution.model, solution.model.skin
    drive, sense = (incidence(model.pattern[:, k : k + 2], skin.n_electrodes) for k in (0, 2))
    found = np.zeros((len(model.pattern), skin.n_electrodes))
    for sign, ends in ((-1.0, skin.edges[:, 0]), (1.0, skin.edges[:, 1])):
        node = [int(((model.mesh.p.T - point) ** 2).sum(axis=1).argmin()) for point in skin.point(ends)]
        jump = solution.potentials[node] - solution.transfer  # (E, E): at the end of l, for each unit current
        found -= sign * (drive @ jump.T) * (sense @ jump.T) / solution.contact_impedance
    return found
