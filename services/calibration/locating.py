"""From presses at known places to what finds touches: see models/locator.py.

Everything that is said of accuracy here, the correction that is kept or not, the ellipses and the thresholds for second
touches come from presses that were left out of the map that found them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from models.bundle import Bundle
from models.locator import LEAST_LOUD, NINETY, Likely, Locator, WhitenedMap, one_more, second_of, share, unit
from models.locator_arrays import FEWEST_LIVE, QUANTITIES, LocatorArrays
from services.calibration.fields import half_width, sample
from services.calibration.kernel_machine import Machine, named, nothing_known, search
from services.calibration.presses import Presses, RegistrationError, evenly, folds_of, radius_of
from services.calibration.registration import Similarity
from services.calibration.response import ResponseFit, fit, fit_amplitudes

Array = NDArray[np.float64]

STEPS = 24  # of the grid, from the middle of the presses to the farthest
FOLDS, FOLDS_OF_MANY, MANY = 10, 5, 400
FEWEST_FOR_CORRECTION = 60
DIRECTIONS = (12, 24, 48)  # of the whitened differences that the kernel machines read
REACHES = (2.0, 4.0, 8.0)  # weight of the place beside them: features per presses' radius, half
LOUDNESS = (1.0, 3.0, 10.0)
BETTER = 0.92  # of the error: what is left out is found by less than all presses, so a small gain is none
MOST_ERROR = 0.8  # of the spread: depths or forces that are not told better than that are not told at all
MOST_FOR_SECOND = 100  # presses from which the thresholds of further touches are found
SINGLE = 0.99  # share of single presses that are to count as one touch
MARGIN = 1.3  # on that threshold
GAP = 0.15  # variance by which a press that is not explained is off, of the skin's area for each press
POSE_FREEDOM = 2.5  # presses' worth of places that the pose was fitted to: five numbers of two coordinates each


@dataclass(frozen=True)
class Crossed:
    """How well presses are found that were left out."""

    distance: Array  # (N,) m
    inside: float  # share of them within their 90 % ellipse
    value_error: Array | None  # (N,) of depth or force, in its unit
    corrected: bool  # whether a kernel machine corrects the likelihood
    before: float  # m, median distance by the likelihood alone

    def report(self, quantity: str) -> dict[str, Any]:
        found: dict[str, Any] = {
            "median_m": float(np.median(self.distance)),
            "mean_m": float(self.distance.mean()),
            "likelihood_alone_median_m": self.before,
            "corrected": self.corrected,
            "within_90_percent_ellipse": self.inside,
        }
        if self.value_error is not None:
            found[f"mean_error_of_{quantity}"] = float(np.abs(self.value_error).mean())
        return found


def build(presses: Presses, similarity: Similarity, bundle: Bundle) -> tuple[LocatorArrays, ResponseFit, Crossed]:
    """What the bundle ships of these presses, the map itself, and how well presses that were left out are found.

    In turn: the map, and with it each press found by a map made without it; the correction of what that is off by,
    kept where it gains; the ellipses of what is still left; depth or force. Raises RegistrationError.
    """
    if presses.measured.sum() < FEWEST_LIVE:
        raise RegistrationError(f"{int(presses.measured.sum())} measurements: at least {FEWEST_LIVE} are needed")
    whole, presses = fit_amplitudes(presses, similarity, bundle)
    plain = _plain(presses, whole, similarity, bundle)
    places = true_places(presses.xy, similarity)
    seen, form, more = _left_out(presses, whole, plain)
    stage = np.array([s.place for s in seen])
    amplitude = np.array([s.amplitude for s in seen])
    plain = replace(plain, misfit=np.array(np.mean([s.misfit / max(1.0, s.amplitude**2) for s in seen])), more=more)
    middle = places.mean(axis=0)
    reach = radius_of(places)
    left = places - stage
    machine, rotation, per_metre = _correction(form, stage - middle, reach, left)
    spread = np.sqrt((left**2).mean(axis=0))
    corrected = len(presses) >= FEWEST_FOR_CORRECTION and _better(machine.left, left)
    near = np.hstack([(form - form.mean(axis=0)) @ rotation, (stage - middle) * per_metre])
    left = machine.left if corrected else left
    covariance = np.array([s.covariance for s in seen])
    factor, floor, inside = ellipses(left, covariance)
    factor, floor = (each * len(left) / (len(left) - POSE_FREEDOM) for each in (factor, floor))
    gap = GAP * np.pi * reach**2 / len(presses)
    found = replace(
        plain,
        rotation=rotation,
        middle=form.mean(axis=0),
        reach=np.array([per_metre, *middle]),
        spread=np.array([factor, floor, gap]),
        **(named("place", machine, near, spread) if corrected else {}),
    )
    error = None
    if presses.value is not None and np.ptp(presses.value) > 0:
        size = np.sqrt(rotation.shape[1])
        found, error = _value_machine(presses.value, presses.quantity, near, amplitude, found, size)
    distance = np.linalg.norm(left, axis=1)
    before = float(np.median(np.linalg.norm(places - stage, axis=1)))
    return found, whole, Crossed(distance, inside, error, corrected, before)


def true_places(machine: Array, similarity: Similarity) -> Array:
    """(N, 2) m of the machine's frame -> the skin's frame, in its true metres."""
    return similarity.to_skin(machine) * similarity.scale


def _plain(presses: Presses, whole: ResponseFit, similarity: Similarity, bundle: Bundle) -> LocatorArrays:
    """The map and its error alone."""
    places = true_places(presses.xy, similarity)
    spacing = radius_of(places) / STEPS
    margin = spacing * STEPS * 0.5 * np.sqrt(np.pi / len(places))  # half of how far presses are apart
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    columns, rows = (np.ceil((high - low) / spacing).astype(int) + 1).tolist()
    iy, ix = np.divmod(np.arange(rows * columns), columns)
    grid = low + spacing * np.stack([ix, iy], axis=1)
    allowed = _near(grid, places, margin) & _on_skin(grid, similarity, bundle)
    machine = similarity.to_machine(grid[allowed] / similarity.scale)
    k = int(presses.measured.sum())
    return LocatorArrays(
        shape=np.array([rows, columns]),
        corner=low,
        spacing=np.array(spacing),
        allowed=allowed,
        map=np.where(presses.measured, whole.at(machine), 0.0).astype(np.float32),
        error=_with_ones(whole.error, presses.measured),
        noise=np.where(presses.measured, presses.noise, 0.0),
        measured=presses.measured,
        misfit=np.array(1.0),
        spread=np.array([1.0, 1e-12, 0.0]),
        more=np.array([np.finfo(float).max, np.finfo(float).max]),
        rotation=np.zeros((k, 0)),
        middle=np.zeros(k),
        reach=np.array([1.0, 0.0, 0.0]),
        loudness=np.array(1.0),
        quantity=np.array(0),
        **nothing_known("place", 2),
        **nothing_known("press", 1),
    )


def _near(grid: Array, places: Array, margin: float) -> NDArray[np.bool_]:
    """Inside the hull of the presses, or at most `margin` from it."""
    try:
        planes = ConvexHull(places).equations
    except (QhullError, ValueError):  # on a line
        return np.ones(len(grid), bool)
    return np.asarray((grid @ planes[:, :2].T + planes[:, 2]).max(axis=1) <= margin)


def _on_skin(grid: Array, similarity: Similarity, bundle: Bundle) -> NDArray[np.bool_]:
    inside = bundle.matrices.inside.astype(float)[None]
    on = sample(inside, grid / similarity.scale, half_width(bundle))[:, 0] > 0.25
    return on if on.any() else np.ones(len(grid), bool)


def _left_out(presses: Presses, whole: ResponseFit, plain: LocatorArrays) -> tuple[list[Likely], Array, Array]:
    """What the likelihood says of each press by a map that was made without it, the forms (N, K') that it whitens them
    to, and what a second and a third touch must explain to count, found from presses that were none.
    """
    n = len(presses)
    fold = folds_of(presses.xy, FOLDS if n < MANY else FOLDS_OF_MANY)
    machine = whole.similarity.to_machine(Locator(plain).places / whole.similarity.scale)
    found: dict[int, Likely] = {}
    forms = np.zeros((n, int(presses.measured.sum())))
    further: list[tuple[float, float]] = []
    middle = plain.corner + 0.5 * float(plain.spacing) * (plain.shape[::-1] - 1)
    some = set(evenly(n, MOST_FOR_SECOND).tolist())
    for one in np.unique(fold):
        rest = fold != one
        if rest.sum() < 3:
            raise RegistrationError("the presses lie at fewer than three places: spread them over the skin")
        part = fit(presses[rest], whole.similarity, whole.bundle, whole.assumed)
        map_ = np.where(presses.measured, part.at(machine), 0.0).astype(np.float32)
        locator = Locator(replace(plain, map=map_, error=_with_ones(part.error, presses.measured)))
        now = locator._trained
        for row in np.flatnonzero(~rest).tolist():
            z = now.whiten @ presses.difference[row, presses.measured]
            seen, forms[row] = locator.seen(now, z), unit(z)
            found[row] = seen or Likely(middle, np.eye(2) * radius_of(presses.xy) ** 2, 0, LEAST_LOUD, 1.0)
            if seen is not None and row in some:
                further += _further(now, z)
    more = MARGIN * np.quantile(further, SINGLE, axis=0) if further else np.array([1e30, 1e30])
    return [found[row] for row in range(n)], forms, more


def _further(now: WhitenedMap, z: Array) -> list[tuple[float, float]]:
    """What a second and a third touch explain of a press that was one; nothing where no second one is possible."""
    total, b = float(z @ z), now.r @ z
    single = float(np.max(np.where(b > 0, b * b, 0.0) / now.q))
    pair, double = second_of(now, b)
    if not len(pair):
        return []
    triple, three = one_more(now, z, pair)
    third = share(total, double, three, len(z)) if len(triple) else 0.0
    return [(share(total, single, double, len(z)), third)]


def _with_ones(error: Array, measured: NDArray[np.bool_]) -> Array:
    """A covariance in which nothing but itself tells of what was not measured."""
    return np.asarray(np.where(np.outer(measured, measured), error, np.eye(len(error))))


def _correction(form: Array, stage: Array, reach: float, left: Array) -> tuple[Machine, Array, float]:
    """The kernel machine that foretells best what the likelihood is off by, the directions of the forms that it reads
    (K', F), and the weight of the place beside them [features per m].

    form (N, K'): whitened differences of length 1; stage (N, 2) m: what the likelihood said, from the middle of the
    presses; reach [m]: their radius; left (N, 2) m: what it was off by.
    """
    best: tuple[float, Machine, Array, float] | None = None
    for directions in DIRECTIONS if len(form) >= FEWEST_FOR_CORRECTION else DIRECTIONS[:1]:
        rotation = _rotation(form, directions)
        shown = (form - form.mean(axis=0)) @ rotation
        for weight in REACHES:
            features = np.hstack([shown, stage * weight / reach])
            machine = search(features, left, np.zeros(2), np.sqrt(directions))
            if best is None or machine.error < best[0]:
                best = machine.error, machine, rotation, weight / reach
    assert best is not None
    return best[1:]


def _rotation(form: NDArray[Any], directions: int) -> Array:
    """(K, F): the directions in which the forms of these presses differ most, so scaled that they spread by 1."""
    apart = form - form.mean(axis=0)
    axes = np.linalg.svd(apart, full_matrices=False)[2][:directions].T
    return np.asarray(axes / max(float((apart @ axes).std()), 1e-30))


def _better(left: Array, before: Array) -> bool:
    """Whether a correction is worth having: both the typical and the mean square distance must fall."""
    distances = [np.linalg.norm(each, axis=1) for each in (left, before)]
    mean = np.sqrt((distances[0] ** 2).mean()) < BETTER * np.sqrt((distances[1] ** 2).mean())
    return bool(mean and np.median(distances[0]) < BETTER * np.median(distances[1]))


def ellipses(left: Array, covariance: Array) -> tuple[float, float, float]:
    """factor and floor [m^2] of the covariances factor * (N, 2, 2) + floor that hold 90 % of these distances (N, 2) in
    their 90 % ellipses, and the share that they hold.

    The floor beside the factor is that of the greatest likelihood; both are then scaled to the 90 %, of few presses to
    more: those still to come scatter more than those that this was found from.
    """
    n, level = len(left), float((left**2).mean())
    typical = float(np.trace(covariance.mean(axis=0)) / 2)
    held = min(1.0, 0.9 * (n + 1) / n)
    best: tuple[float, float, float] | None = None
    for part in (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0):
        shape = covariance + (part * typical + 1e-6 * level) * np.eye(2)
        square = _squares(left, shape)
        scale = float(np.quantile(square, held, method="inverted_cdf")) / NINETY
        cost = float((np.log(np.linalg.det(scale * shape)) + square / scale).mean())
        if best is None or cost < best[0]:
            best = cost, scale, scale * (part * typical + 1e-6 * level)
    assert best is not None
    _, factor, floor = best
    square = _squares(left, factor * covariance + floor * np.eye(2))
    return factor, floor, float((square <= NINETY * (1 + 1e-9)).mean())


def _squares(left: Array, covariance: Array) -> Array:
    """(N,) of distances (N, 2), in standard deviations."""
    return np.asarray(np.einsum("ni,nij,nj->n", left, np.linalg.inv(covariance), left))


def _value_machine(
    value: Array, quantity: str, near: Array, amplitude: Array, found: LocatorArrays, size: float
) -> tuple[LocatorArrays, Array | None]:
    """`found` with what says how deep [m] or hard [N] a press is, and what it is off by (N,) for presses that were left
    out; unchanged and None where that cannot be told from the measurements.

    value (N,): what the file says; near (N, F): features of the correction; amplitude (N,): by the likelihood; size:
    see kernel_machine.search.
    """
    loud = np.log(np.maximum(amplitude, LEAST_LOUD))[:, None]
    offset = np.array([value.mean()])
    each = [(search(np.hstack([near, w * loud]), value[:, None], offset, size), w) for w in LOUDNESS]
    machine, weight = min(each, key=lambda pair: pair[0].error)
    spread = float(value.std())
    if machine.error > MOST_ERROR * spread:
        return found, None
    centres = np.hstack([near, weight * loud])
    machine_arrays = named("press", machine, centres, np.array([spread]))
    machine_arrays |= {"loudness": np.array(weight), "quantity": np.array(QUANTITIES.index(quantity))}
    return replace(found, **machine_arrays), machine.left[:, 0]
