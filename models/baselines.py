"""Known reconstruction methods for comparison: NOSER in one step, total variation, several Gauss-Newton steps, GREIT.

Every method maps a relative difference d = |Z|/|Z0| - 1, (K,), to an image of the conductivity drop [S/m], (n, n), row
0 at the lowest y. None of them knows a touch's sign, size or shape; all share one linearisation, on the "inverse" mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu

from models.forward import ForwardModel
from models.shapes import Array, Shape

PUBLISHED_LAMBDA = 0.15  # of the MM-CNN paper; reproduces its NOSER LDCI with the impedances in ohm
NOSER_POWER = 0.5  # EIDORS's exponent of diag(J^T W J)


@dataclass(frozen=True, eq=False)
class PeerPhysics:
    """The untouched skin on a mesh, seen from d: K measurements, m elements."""

    model: ForwardModel

    @cached_property
    def z0(self) -> Array:
        """(K,) signed, ohm."""
        return self.model.solve(1.0).impedances()

    @cached_property
    def J(self) -> Array:
        """(K, m) d per S/m of drop in an element."""
        return -self.model.solve(1.0).jacobian() / self.z0[:, None]

    def pixel_jacobian(self, n: int) -> Array:
        """(K, n*n) d per S/m of drop in a pixel."""
        return np.asarray(self.J @ self.model.element_map(n))

    def inside(self, n: int) -> NDArray[np.bool_]:
        """(n*n,) pixels that the skin covers at least in part."""
        return np.asarray(self.model.pixel_map(n).sum(axis=1)).ravel() > 0


class LinearMethod:
    """An image is one matrix times the difference: matrix (n*n, K)."""

    def __init__(self, matrix: Array) -> None:
        self.matrix = matrix
        self.n = round(len(matrix) ** 0.5)

    def __call__(self, d: Array) -> Array:
        return (self.matrix @ d).reshape(self.n, self.n)


def noser(
    physics: PeerPhysics, lambda_: float = PUBLISHED_LAMBDA, n: int = 96, units: str = "ohm", power: float = NOSER_POWER
) -> LinearMethod:
    """One step of Gauss-Newton with the NOSER prior, equation 1 of the paper: RM = (J^T W J + lambda^2 R)^-1 J^T W.

    units "ohm": W = 1 on impedances of unit current, as published; "relative": W = 1 on d. R = diag(J^T W J)^power:
    with power 1/2 the image does not depend on the elements' sizes, and lambda means the same on any mesh.
    """
    if units not in ("ohm", "relative"):
        raise ValueError(f"units {units!r}: expected 'ohm' or 'relative'")
    scale = np.abs(physics.z0) if units == "ohm" else np.ones(len(physics.z0))
    J = physics.J * scale[:, None]
    back = J / (J**2).sum(0) ** power  # R^-1 J^T, transposed
    A = J @ back.T
    RM = np.linalg.solve(A + lambda_**2 * np.eye(len(A)), back).T * scale
    return LinearMethod(np.asarray(physics.model.pixel_map(n) @ RM))


def greit(
    physics: PeerPhysics, n: int = 48, noise_figure: float = 0.5, target: float = 0.1, wanted: float = 0.2
) -> LinearMethod:
    """GREIT, Adler et al. 2009: the matrix that turns small targets into round blobs of one size and amplitude.

    Trained on circles of radius `target` all over the skin (linear responses), each to become a blob of radius
    `wanted` with the same integral; the noise's weight is set so that a central target has the noise figure asked for.
    """
    J = physics.pixel_jacobian(n)
    inside = physics.inside(n)
    line = -1 + 2 * (np.arange(n) + 0.5) / n
    pixels = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    centres = [(x, y) for y in line[::2] for x in line[::2]]
    shapes = [Shape("circle", x, y, target, 1.0) for x, y in centres]
    shapes = [s for s in shapes if physics.model.skin.curve.inside(s.outline(16)).all()]
    targets = np.array([s.fraction(n).ravel() for s in shapes])
    distance = np.hypot(*(pixels[None] - np.array([(s.x, s.y) for s in shapes])[:, None]).transpose(2, 0, 1))
    blobs = inside / (1 + np.exp(np.clip((distance - wanted) / (0.15 * wanted), -50, 50)))  # a softened edge
    blobs *= (targets.sum(1) / blobs.sum(1))[:, None]
    Y = J @ targets.T
    cross, gram = blobs.T @ Y.T, Y @ Y.T
    middle = J @ Shape("circle", 0.0, 0.0, target, 1.0).fraction(n).ravel()

    values, vectors = np.linalg.eigh(gram)
    values = np.maximum(values / values.mean(), 0)
    rotated, rotated_middle = cross @ vectors / np.trace(gram) * len(gram), vectors.T @ middle

    def figure(weight: float) -> float:
        """SNR of the measurements over SNR of the image, for white noise on d (Adler et al., section 2.3)."""
        image = rotated[inside] @ (rotated_middle / (values + weight))
        noise = np.sqrt(rotated[inside] ** 2 @ (values + weight) ** -2.0)
        return float(np.abs(middle).mean() / (np.abs(image).mean() / noise.mean()))

    low, high = 1e-9, 1e3  # more weight, lower noise figure
    for _ in range(40):
        middle_weight = np.sqrt(low * high)
        low, high = (middle_weight, high) if figure(middle_weight) > noise_figure else (low, middle_weight)
    return LinearMethod(rotated / (values + np.sqrt(low * high)) @ vectors.T)


class TotalVariation:
    """min |J x - d|^2 / 2 + alpha int sqrt(|grad x|^2 + beta^2) by lagged diffusivity (Vogel and Oman 1996).

    Each step is a linear problem with the last image's diffusivity, solved in dual form: one sparse factorisation of
    the n*n pixels and a K x K system. `beta` is a share of the steepest slope of the last image.
    """

    def __init__(
        self, physics: PeerPhysics, alpha: float = 1e-6, beta: float = 0.02, n: int = 32, steps: int = 8
    ) -> None:
        self.n, self.alpha, self.beta, self.steps = n, alpha, beta, steps
        self.live = np.flatnonzero(physics.inside(n))
        self.J = physics.pixel_jacobian(n)[:, self.live]
        number = np.full(n * n, -1)
        number[self.live] = np.arange(len(self.live))
        grid = number.reshape(n, n)
        right = [(a, b) for a, b in zip(grid[:, :-1].ravel(), grid[:, 1:].ravel(), strict=True) if min(a, b) >= 0]
        up = [(a, b) for a, b in zip(grid[:-1].ravel(), grid[1:].ravel(), strict=True) if min(a, b) >= 0]
        self.Dx, self.Dy = self._difference(right), self._difference(up)

    def _difference(self, pairs: list[tuple[int, int]]) -> sparse.csr_array:
        """(P, P) forward difference over one pixel; a pixel with no neighbour there has a zero row."""
        a, b = np.array(pairs).T
        ones = np.ones(len(a))
        entries = (np.concatenate([-ones, ones]), (np.concatenate([a, a]), np.concatenate([a, b])))
        return sparse.csr_array(sparse.coo_array(entries, shape=(len(self.live),) * 2)) * (self.n / 2)

    def __call__(self, d: Array) -> Array:
        pixel = (2 / self.n) ** 2
        K, P = self.J.shape
        x = np.zeros(P)
        weight = np.full(P, 1.0)
        for _ in range(self.steps):
            scaled = sparse.diags_array(weight * pixel)
            L = self.Dx.T @ scaled @ self.Dx + self.Dy.T @ scaled @ self.Dy
            # the constant image has no variation: what keeps L regular is a drop of zero being likelier than any other
            L = L + 1e-3 * sparse.diags_array(L.diagonal().mean() * np.ones(P))
            back = splu(sparse.csc_matrix(L), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
                np.ascontiguousarray(self.J.T)
            )
            x = back @ cho_solve(cho_factor(self.J @ back + self.alpha * np.eye(K)), d)
            slope = np.hypot(self.Dx @ x, self.Dy @ x)
            weight = 1 / np.sqrt(slope**2 + (self.beta * max(slope.max(), 1e-12)) ** 2)
        image = np.zeros(self.n * self.n)
        image[self.live] = x
        return image.reshape(self.n, self.n)


class GaussNewton:
    """Several steps of regularised Gauss-Newton on the non-linear model, with the NOSER prior towards no drop.

    The unknown is y = -log conductivity, so that conductivity stays positive:
    y_{k+1} = R^-1 J_k^T (J_k R^-1 J_k^T + lambda^2)^-1 (d - d(y_k) + J_k y_k), J_k and d(y_k) from a new solution.
    """

    def __init__(self, physics: PeerPhysics, lambda_: float = 0.03, n: int = 96, steps: int = 4) -> None:
        self.physics, self.lambda_, self.steps, self.n = physics, lambda_, steps, n
        self.pixels = physics.model.pixel_map(n)
        self.R = (physics.J**2).sum(0) ** NOSER_POWER

    def elements(self, d: Array) -> Array:
        """(n_elements,) drop [S/m]."""
        z0 = self.physics.z0
        y = np.zeros(self.physics.model.n_elements)
        J, fitted = self.physics.J, np.zeros(len(z0))
        for step in range(self.steps):
            if step:
                solution = self.physics.model.solve(np.exp(-y))
                J, fitted = -solution.jacobian() / z0[:, None] * np.exp(-y), solution.impedances() / z0 - 1
            back = (J / self.R).T
            A = J @ back + self.lambda_**2 * np.eye(len(z0))
            y = np.clip(back @ cho_solve(cho_factor(A), d - fitted + J @ y), -3, 5)
        return np.asarray(1 - np.exp(-y))

    def __call__(self, d: Array) -> Array:
        return np.asarray(self.pixels @ self.elements(d)).reshape(self.n, self.n)
