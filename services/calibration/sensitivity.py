"""A bundle fitted to one real skin: its sensitivities corrected by what presses at known places did.

The response of measurement k to a press at x is modelled as gain_k times the bundle's sensitivity, plus a smooth field
with a Gaussian-process prior; its posterior mean replaces the bundle's J. Leaving out one press at a time shows what
the posterior still gets wrong. The reconstruction treats that as model error beside the noise.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, write
from models.prereconstruction import Matrices, PreReconstructor
from services.calibration.registration import Presses, Similarity, half_width, sample, sensitivities
from services.contacts.segmentation import segment

Array = NDArray[np.float64]

# Chosen by five-fold cross-validation within the first 100 presses of the hydrogel skin.
SMOOTHNESS_M = 0.02  # correlation length of what the gains do not explain
GAIN_SHARE, FIELD_SHARE, NOISE_SHARE = 0.4, 0.6, 0.1  # prior shares of a measurement's variance
BLUR = 1.0  # pixels
MODEL_ERROR = 1.0  # lambda: the model error's share beside the mean eigenvalue of the whitened Gram matrix
TYPICAL_DROP = (
    0.3  # S/m that a mean press is shown as: a skin that nobody calibrated in newtons has no scale of its own
)


@dataclasses.dataclass(frozen=True)
class Response:
    """What presses did. K measurements, P = h * w pixels of the bundle's grid."""

    map: Array  # (P, K) relative change by a mean press at each pixel
    error: Array  # (K,) mean square of what is wrong with it for a press not used, noise included


def response(presses: Presses, similarity: Similarity, bundle: Bundle, field_share: float = FIELD_SHARE) -> Response:
    """The posterior mean of each measurement's response over the skin. field_share 0: a gain per measurement alone."""
    h, w = bundle.matrices.inside.shape
    width = half_width(bundle)
    axis = (-1 + 2 * (np.arange(w) + 0.5) / w) * width
    pixels = np.stack([a.ravel() for a in np.meshgrid(axis, (-1 + 2 * (np.arange(h) + 0.5) / h) * width)], 1)
    places = similarity.to_skin(presses.xy)
    fields = sensitivities(bundle, BLUR)
    at_places, at_pixels = sample(fields, places, width), sample(fields, pixels, width)
    length = SMOOTHNESS_M / similarity.scale
    near = np.exp(-_squares(places, places) / (2 * length**2))
    near_pixels = np.exp(-_squares(pixels, places) / (2 * length**2))
    a = presses.strength
    power = (presses.difference**2).mean(axis=0)
    found = np.zeros((len(pixels), presses.difference.shape[1]))
    error = np.zeros(found.shape[1])
    for k, y in enumerate(presses.difference.T):
        f, g = at_places[:, k], at_pixels[:, k]
        norm = max(float((f * f).mean()), 1e-30)
        prior = GAIN_SHARE * np.outer(f, f) / norm + field_share * near
        cross = GAIN_SHARE * np.outer(g, f) / norm + field_share * near_pixels
        noise = NOISE_SHARE + presses.noise[k] ** 2 / max(float(power[k]), 1e-30)
        inverse = np.linalg.inv(prior * np.outer(a, a) + noise * np.eye(len(a)))
        alpha = inverse @ y
        found[:, k] = (cross * a) @ alpha
        error[k] = ((alpha / np.diag(inverse)) ** 2).mean()  # leave-one-out residuals, in closed form
    return Response(found * bundle.matrices.inside.ravel()[:, None], error)


def corrected(presses: Presses, found: Response, bundle: Bundle) -> Matrices:
    """The bundle's matrices with J from the response; images come out with a mean press at TYPICAL_DROP."""
    m = bundle.matrices
    inside = m.inside.ravel()
    j = found.map.T
    noise = presses.noise**2 + found.error
    prior = np.sqrt((j**2 / noise[:, None]).sum(axis=0))  # NOSER, power 1/2, of the whitened J
    prior = np.where(inside, np.maximum(prior / prior[inside].mean(), 0.05), 1.0)
    back = np.where(inside[:, None], j.T / prior[:, None], 0.0)
    gram = j @ back
    mean = float((np.diag(gram) / noise).mean())
    gram = gram + np.diag(noise) * mean * MODEL_ERROR**2
    made = dataclasses.replace(
        m, gram=gram, back=back.astype(np.float32), jacobian=j.astype(np.float32), contact=np.zeros_like(m.contact)
    )
    gain = TYPICAL_DROP / _typical_peak(presses, made)
    return dataclasses.replace(
        made, back=(gain * made.back).astype(np.float32), jacobian=(made.jacobian / gain).astype(np.float32)
    )


def _typical_peak(presses: Presses, matrices: Matrices) -> float:
    operator = PreReconstructor(matrices).condition(presses.noise)
    peaks = [float(operator.one_step(d, len(matrices.inside)).max()) for d in presses.difference]
    return max(float(np.median(peaks)), 1e-12)


def _squares(a: Array, b: Array) -> Array:
    return np.asarray(((a[:, None] - b[None]) ** 2).sum(axis=-1))


def write_corrected(
    folder: Path,
    presses: Presses,
    similarity: Similarity,
    bundle: Bundle,
    notes: dict[str, Any],
    field_share: float = FIELD_SHARE,
) -> Bundle:
    """A bundle folder of this very skin, in its true metres. `notes` goes into the manifest as `registration`."""
    matrices = corrected(presses, response(presses, similarity, bundle, field_share), bundle)
    manifest = {key: value for key, value in bundle.manifest.items() if key not in ("files", "schema")}
    metres = bundle.metres_per_unit * similarity.scale
    manifest["skin"] = {**manifest["skin"], "metres_per_unit": metres}
    manifest["image"] = {**manifest["image"], "metres_per_unit": metres}
    manifest |= {"network": None, "corrected_from": bundle.hash, "registration": notes}
    return write(folder, manifest, matrices)


def out_of_fold(presses: Presses, similarity: Similarity, bundle: Bundle, folds: int = 5) -> Array:
    """(N,) distance [m] of each press from where it is found by a correction that was made without it."""
    fold = np.arange(len(presses)) % folds
    found = np.zeros(len(presses))
    for one in range(folds):
        fitted, left = presses[fold != one], presses[fold == one]
        matrices = corrected(fitted, response(fitted, similarity, bundle), bundle)
        found[fold == one] = np.linalg.norm(locate(left, matrices, bundle, similarity) - left.xy, axis=1)
    return found


def locate(presses: Presses, matrices: Matrices, bundle: Bundle, similarity: Similarity) -> Array:
    """(N, 2) m in the machine's frame: centroid of the one-step image's strongest touch; the skin's centre if none."""
    operator = PreReconstructor(matrices).condition(presses.noise)
    n, no_sigma = bundle.image_size, np.zeros((0, 0), np.float32)
    places = np.zeros((len(presses), 2))
    for row, d in enumerate(presses.difference):
        touches = segment(operator.one_step(d, n).astype(np.float32), no_sigma)
        if touches:
            places[row] = (np.array([touches[0].x, touches[0].y]) + 0.5) / n * 2 - 1
    return similarity.to_machine(places * half_width(bundle))
