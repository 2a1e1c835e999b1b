"""Condition number and effective rank of every matrix that is inverted, and what rounding makes of the answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from bench.stability.run import Row, Setting, share
from models.bundle import Bundle
from models.elements import CROSSED_LEVEL, barycentric
from models.forward import ForwardModel
from models.prereconstruction import Drift, PreReconstructor
from models.shapes import Array, Shape

DRIFTS = {"no drift": Drift(), "usual drift": Drift(5e-5, 2e-4), "long drift": Drift(2.6e-2, 0.26)}
LEVELS = (30.0, 50.0, 70.0, 90.0, np.inf)
DIGITS_LOST = 1e-4  # of the answer: what rounding may make of it
LONG = np.longdouble


def stiffness(setting: Setting) -> Iterator[Row]:
    """The complete electrode model's matrix, by mesh, background and contact impedance."""
    cases = [("stub", 1.0, 1.0), ("stub", 0.2, 0.1), ("stub", 5.0, 10.0)]
    if not setting.quick:
        cases += [("inverse", 1.0, 1.0), ("training", 1.0, 1.0), ("training", 0.2, 0.1), ("training", 5.0, 10.0)]
    for mesh, background, contact in cases:
        model = setting.model(mesh)
        name = f"{mesh} mesh, {background:g} S/m, contacts x {contact:g}"
        yield {"case": name, **_stiffness(model, background, contact * model.contact_impedance)}
    model = setting.model("stub")
    points = np.einsum("qc,eck->eqk", barycentric(CROSSED_LEVEL), model.corners)
    offset = points - points.mean(axis=1, keepdims=True)
    moments = np.linalg.cond(np.einsum("eqi,eqj->eij", offset, offset))
    yield {
        "case": "moments of an element's points, worst",
        "size": 2,
        "condition": float(moments.max()),
        "rank": 2,
        "broken": {},
    }


def _stiffness(model: ForwardModel, background: float, contact: Array) -> Row:
    """Condition number in the 2-norm by Lanczos; error of the impedances by a step of refinement."""
    matrix = model.matrix(background, contact)
    factor = model.factorise(matrix)
    largest = float(eigsh(matrix, 1, which="LM", tol=1e-2, return_eigenvectors=False)[0])
    inverse = LinearOperator(matrix.shape, matvec=factor.solve, dtype=float)
    smallest = 1 / float(eigsh(inverse, 1, which="LM", tol=1e-2, return_eigenvectors=False)[0])
    fields = factor.solve(model.currents)
    correction = factor.solve(model.currents - matrix @ fields)
    error = float(np.abs(correction).max() / np.abs(fields).max())
    return {
        "size": matrix.shape[0],
        "condition": largest / smallest,
        "rank": matrix.shape[0],
        "error": error,
        "broken": {"rounding reaches the answer": 1} if not error < 1e-8 else {},
    }


def bundles(setting: Setting) -> Iterator[Row]:
    """Per bundle: the Gram matrix, the noise's covariance (Cholesky), the whitened Gram matrix + lambda^2 I."""
    rng = setting.rng("matrices")
    for name in ("square16", "disc16"):
        pre = (setting.bundle if name == setting.bundle.name else Bundle.load(name)).prereconstructor()
        values = np.maximum(np.linalg.eigvalsh(pre.m.gram), 0)
        yield {"case": f"{name}: Gram matrix A", **_spectrum(values), "broken": {}}
        columns = np.column_stack([np.ones(pre.measurements), pre.m.contact])
        singular = np.linalg.svd(columns, compute_uv=False)
        yield {"case": f"{name}: drift's directions (least squares)", **_spectrum(singular), "broken": {}}
        d = touch_of(pre, rng)
        for decibel in LEVELS if not setting.quick else (30.0, 70.0, np.inf):
            for drift_name, drift in DRIFTS.items():
                noise = "noise-free" if np.isinf(decibel) else f"{decibel:g} dB"
                yield {"case": f"{name}: {noise}, {drift_name}", "value": decibel} | _inverted(
                    pre, share(decibel), drift, d
                )


def touch_of(pre: PreReconstructor, rng: np.random.Generator) -> Array:
    """(K,) difference of a touch by the bundle's own Jacobian, with noise."""
    h, w = pre.m.inside.shape
    image = 0.3 * Shape("circle", 0.2, 0.1, 0.25, 0.3).fraction(h)
    return np.asarray(pre.m.jacobian @ image.ravel()) + 1e-4 * rng.standard_normal(pre.measurements)


def _inverted(pre: PreReconstructor, relative: float, drift: Drift, d: Array) -> Row:
    """The matrices of one operator, and its images against those of a solve with 64 bits of mantissa."""
    m, sigma = pre.m, np.full(pre.measurements, relative)
    noise = sigma**2 * (1 + 1 / 64) + m.model_error**2
    covariance = np.diag(noise) + drift.scale**2 + drift.contact**2 * m.contact @ m.contact.T
    operator = pre.condition(sigma, drift=drift)
    white = operator.whiten @ m.gram @ operator.whiten.T  # diagonal, the eigenvalues
    values = np.maximum(np.diag(white), 0)
    mean = float(np.trace(m.gram) / len(noise) / noise.mean())
    smallest = float(m.ladder[-1])
    images = np.asarray(operator.images(d[None])[0], float)
    errors = []
    for k, rung in enumerate(m.ladder):
        exact = np.asarray(m.back, LONG) @ solved_long(m.gram + rung * mean * covariance, d)
        errors.append(float(np.abs(images[k] - exact).max() / np.abs(exact).max()))
    scaled = errors[m.scale_index]
    return {
        "size": len(noise),
        "condition": float((values.max() + smallest * mean) / (values.min() + smallest * mean)),
        "condition_covariance": float(np.linalg.cond(covariance)),
        "rank": int((values > values.max() * len(values) * np.finfo(float).eps).sum()),
        "effective_rank": float((values / (values + smallest * mean)).sum()),
        "effective_rank_sharp": float((values / (values + m.ladder[m.scale_index] * mean)).sum()),
        "error": max(errors),
        "broken": {"rounding reaches the answer": 1} if not scaled < DIGITS_LOST else {},
    }


def solved_long(matrix: Array, right: Array) -> NDArray[np.longdouble]:
    """Cholesky solution of a symmetric positive definite system in extended precision (64 bits of mantissa)."""
    a, x, n = np.asarray(matrix, LONG).copy(), np.asarray(right, LONG).copy(), len(matrix)
    for k in range(n):
        a[k, k] = np.sqrt(a[k, k])
        a[k + 1 :, k] /= a[k, k]
        a[k + 1 :, k + 1 :] -= np.outer(a[k + 1 :, k], a[k + 1 :, k])
    for k in range(n):
        x[k] = (x[k] - a[k, :k] @ x[:k]) / a[k, k]
    for k in reversed(range(n)):
        x[k] = (x[k] - a[k + 1 :, k] @ x[k + 1 :]) / a[k, k]
    return x


def _spectrum(values: Array) -> Row:
    """Condition number, numerical rank, and effective rank exp(entropy) (Roy and Vetterli 2007)."""
    values = np.sort(values)[::-1]
    weights = values[values > 0] / values.sum()
    smallest = values[-1]
    return {
        "size": len(values),
        "condition": float(values[0] / smallest) if smallest > 0 else float("inf"),
        "rank": int((values > values[0] * len(values) * np.finfo(float).eps).sum()),
        "effective_rank": float(np.exp(-(weights * np.log(weights)).sum())),
    }


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "matrices: forward model": stiffness,
    "matrices: reconstruction": bundles,
}
