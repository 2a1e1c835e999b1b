"""pyEIT as a peer: its own adjacent pattern and point electrodes, through its public API.

It has no complete electrode model, so the difference is handed over relative to the untouched frame, and put on the
impedances of its own model. Images come out in its own units; the benchmark scales them by one known touch.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from models import geometry, patterns
from models.shapes import Array

SIDE_CELLS = 40  # electrodes at multiples of a quarter fall on nodes


def installed() -> bool:
    return importlib.util.find_spec("pyeit") is not None


def name() -> str:
    return f"pyEIT {version('pyeit')}"


class PyEIT:
    """Three of pyEIT's methods on the square skin: "jac", "greit", "bp". `value`: its `lamb`."""

    def __init__(self, method: str, value: float | None = None, n: int = 48) -> None:
        import pyeit.eit.protocol as protocol
        from pyeit.eit.bp import BP
        from pyeit.eit.fem import EITForward
        from pyeit.eit.greit import GREIT
        from pyeit.eit.jac import JAC
        from pyeit.mesh import PyEITMesh

        skin = geometry.load("square16")
        line = np.linspace(-1, 1, SIDE_CELLS + 1)
        nodes = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        centres = skin.curve.point(skin.electrodes)
        el_pos = np.linalg.norm(nodes[None] - centres[:, None], axis=2).argmin(1)
        middle = (SIDE_CELLS // 2) * (SIDE_CELLS + 2)
        mesh = PyEITMesh(nodes, _triangles(SIDE_CELLS), 1.0, el_pos, int(middle))
        plan = protocol.create(16, dist_exc=1, step_meas=1, parser_meas="std")
        self.rows = _rows(plan)
        self.v0 = EITForward(mesh, plan).solve_eit()
        self.method, self.n = method, n
        if method == "jac":
            self.solver = JAC(mesh, plan)
            self.solver.setup(p=0.5, lamb=value or 0.01, method="kotre", perm=1, jac_normalized=True)
        elif method == "greit":
            self.solver = GREIT(mesh, plan)
            self.solver.setup(p=0.5, lamb=value or 0.01, n=n, perm=1, jac_normalized=True)
        elif method == "bp":
            self.solver = BP(mesh, plan)
            self.solver.setup(weight="none", perm=1)
        else:
            raise ValueError(f"pyEIT method {method!r}: expected jac, greit or bp")
        self._to_pixels = _interpolation(nodes, _triangles(SIDE_CELLS), n)

    def __call__(self, d: Array) -> Array:
        """(n, n) image, larger where touched, of a relative difference (208,) of the pattern `adjacent`."""
        solved = self.solver.solve(self.v0 * (1 + d[self.rows]), self.v0, normalize=True)
        if self.method == "greit":
            _, _, image = self.solver.mask_value(solved, mask_value=0)
            return -np.real(np.asarray(image))
        return -self._to_pixels(np.real(np.asarray(solved)))


def _rows(plan: object) -> NDArray[np.int64]:
    """Which row of our pattern `adjacent` each of pyEIT's measurements is (their signs do not matter to |Z|)."""
    ours = {
        (frozenset(r[:2].tolist()), frozenset(r[2:].tolist())): k
        for k, r in enumerate(patterns.pattern("adjacent", 16))
    }
    drive, sense = plan.ex_mat, plan.meas_mat  # type: ignore[attr-defined]
    return np.array(
        [ours[frozenset(d.tolist()), frozenset(m.tolist())] for d, own in zip(drive, sense, strict=True) for m in own]
    )


def _triangles(cells: int) -> NDArray[np.int64]:
    n = cells + 1
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    lower = np.stack([corner, corner + 1, corner + n + 1], axis=1)
    upper = np.stack([corner, corner + n + 1, corner + n], axis=1)
    return np.concatenate([lower, upper])


def _interpolation(nodes: Array, triangles: NDArray[np.int64], n: int) -> Callable[[Array], Array]:
    """From values on nodes or on elements to pixel values (n, n)."""
    line = -1 + 2 * (np.arange(n) + 0.5) / n
    x, y = np.meshgrid(line, line)
    cell = 2 / SIDE_CELLS
    column, row = ((x + 1) / cell).astype(int), ((y + 1) / cell).astype(int)
    along, up = (x + 1) / cell - column, (y + 1) / cell - row
    element = row * SIDE_CELLS + column + np.where(up > along, SIDE_CELLS**2, 0)

    def values(solved: Array) -> Array:
        if len(solved) == len(nodes):
            solved = solved[triangles].mean(1)
        return np.asarray(solved[element])

    return values
