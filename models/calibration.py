"""A skin calibrated from one untouched frame: what its |Z0| tell of how it is mounted, and matrices that follow.

    found = fit(skin, bundle.matrices, z0, sigma)      # a few guarded Gauss-Newton steps; seconds
    matrices = calibrated(bundle.matrices, skin, found.mounting)
    fields = fields_as_mounted(skin, found.mounting)     # those of the response tables

|Z0| is explained by contact impedances, electrode shifts, a smooth field and anisotropy (models/mounted.py), each held
by its prior. A step is computed from four fifths of the measurements and counts only if the misfit of the fifth that it
has not seen falls; which fifth that is changes from step to step. Nothing here can tell a touch from a mismatch of the
skin: whoever calls it knows that nothing touches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.geometry import SkinGeometry
from models.linearise import linearise
from models.mounted import FieldModes, Mounting, Predicted, most_shift
from models.prereconstruction import Matrices
from models.response_tables import mounted_fields
from protocol.errors import EitskinError

Array = NDArray[np.float64]

MESH = "training"  # the bundle's matrices were computed on it, and the network trained with those
STEPS_MESH = "inverse"  # coarser: steps are taken on it, corrected by what it gets wrong of the skin of the file
PARTS = 5  # of the measurements; each step leaves one of them out
MOST_STEPS = 8
MODEL_ERROR = 3e-4  # relative: what this mesh gets wrong of |Z|
SHORTER = (1.0, 0.5, 0.25)  # parts of a step that are tried
ENOUGH = 0.03  # relative fall of the held-out misfit below which a step brings nothing more
PATIENCE = 2  # such steps, or steps that did not count, after which the fit ends
MOST_CONTACT = np.log(30.0)
MOST_FIELD = 6.0  # of a mode's prior
MOST_ANISOTROPY = 0.4


class TooFewMeasured(EitskinError):
    """A frame that no calibration can be fitted to; says what was found and what to do."""


@dataclass(frozen=True, eq=False)
class CalibrationFit:
    """mounting, its standard deviations (a Mounting too), and the relative rms misfit of |Z0| before and after."""

    mounting: Mounting
    sd: Mounting
    before: float
    after: float
    held_out: tuple[float, ...]  # of the held-out parts after each step that counted


def fit(skin: SkinGeometry, matrices: Matrices, z0: Array, sigma: Array) -> CalibrationFit:
    """z0 (K,): |Z| of the untouched skin in the order of its pattern, 0 where not measured; any unit. sigma (K,): its
    standard deviation, same unit, infinite where not measured. matrices: the bundle's. Raises TooFewMeasured.
    """
    z0, sigma = np.asarray(z0, dtype=float), np.asarray(sigma, dtype=float)
    live = np.isfinite(z0) & (z0 > 0) & np.isfinite(sigma)
    if z0.shape != (len(skin.pattern),) or live.sum() < 0.8 * len(z0):
        raise TooFewMeasured(
            f"{int(live.sum())} of {len(skin.pattern)} measurements are usable, at least four fifths are needed to fit "
            "how the skin is mounted: mend what `skin doctor` names, then run `skin tare` again"
        )
    variance = np.where(live, (sigma / np.where(live, z0, 1.0)) ** 2 + MODEL_ERROR**2, np.inf)
    modes, bounds = FieldModes(skin), most_shift(skin)
    now = Predicted(skin, Mounting.nominal(skin, modes.count), modes, STEPS_MESH)
    seen = np.log(np.where(live, z0, 1.0)) - np.log(matrices.z0) + now.log  # less what this mesh gets wrong
    now.mounting = replace(now.mounting, log_gain=float(np.median((seen - now.log)[live])))
    before = _rms(seen - now.log, live)
    part = np.random.default_rng(11).permutation(np.arange(len(z0)) % PARTS)
    held_out: list[float] = []
    derivative = now.derivative()
    misses = 0
    for k in range(MOST_STEPS):
        left = live & (part == k % PARTS)
        step = _step(derivative, seen - now.log, variance, live & ~left, now.mounting)
        misfit = _rms(seen - now.log, left)
        tried = (Predicted(skin, _moved(now.mounting, share * step, bounds), modes, STEPS_MESH) for share in SHORTER)
        better = next((each for each in tried if _rms(seen - each.log, left) < misfit), None)
        if better is None:
            misses += 1
        else:
            now, derivative = better, better.derivative()
            held_out.append(_rms(seen - now.log, left))
            misses += held_out[-1] > (1 - ENOUGH) * misfit
        if misses == PATIENCE or min(held_out, default=np.inf) < MODEL_ERROR:
            break
    information = _information(derivative, variance, live, now.mounting)
    sd = now.mounting.with_vector(np.sqrt(np.diag(np.linalg.inv(information))))
    return CalibrationFit(now.mounting, sd, before, _rms(seen - now.log, live), tuple(held_out))


def calibrated(matrices: Matrices, skin: SkinGeometry, mounting: Mounting) -> Matrices:
    """The bundle's matrices, linearised about the skin as it is mounted. What the network was trained to see, the
    ladder of lambda and the levels of its images, stays.
    """
    now = Predicted(skin, replace(mounting, log_gain=0.0), FieldModes(skin), MESH)
    grid = matrices.inside.shape[0]
    made = linearise(now.model, matrices.normalisation, grid, matrices.model_error, now.tensors)
    return replace(
        made,
        pattern=matrices.pattern,
        inside=matrices.inside,
        ladder=matrices.ladder,
        level=matrices.level,
        scale_index=matrices.scale_index,
    )


def fields_as_mounted(skin: SkinGeometry, mounting: Mounting) -> NDArray[np.float32]:
    """(2, F * F, E) fields of the bundle's response tables, of the skin as it is mounted."""
    now = Predicted(skin, replace(mounting, log_gain=0.0), FieldModes(skin), MESH)
    return mounted_fields(now.model, now.tensors, now.solution.potentials)


def _information(derivative: Array, variance: Array, used: NDArray[np.bool_], state: Mounting) -> Array:
    """(P, P) of the measurements used, and of the prior."""
    of_measurements = (derivative[used] / variance[used, None]).T @ derivative[used]
    return np.asarray(of_measurements + np.diag(1 / state.prior_sd**2))


def _step(derivative: Array, left: Array, variance: Array, used: NDArray[np.bool_], state: Mounting) -> Array:
    pull = np.append(0.0, state.vector[1:]) / state.prior_sd**2  # the common factor has no likeliest value
    gradient = (derivative[used] / variance[used, None]).T @ left[used] - pull
    return np.asarray(np.linalg.solve(_information(derivative, variance, used, state), gradient))


def _moved(mounting: Mounting, step: Array, shifts: Array) -> Mounting:
    state = mounting.with_vector(mounting.vector + step)
    size = float(np.hypot(*state.anisotropy))
    return replace(
        state,
        contact=np.clip(state.contact, -MOST_CONTACT, MOST_CONTACT),
        shift=np.clip(state.shift, -shifts, shifts),
        field=np.clip(state.field, -MOST_FIELD, MOST_FIELD),
        anisotropy=state.anisotropy * min(1.0, MOST_ANISOTROPY / max(size, 1e-12)),
    )


def _rms(values: Array, used: NDArray[np.bool_]) -> float:
    return float(np.sqrt(np.mean(values[used] ** 2)))
