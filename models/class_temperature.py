"""How sure a network may be of a touch's shape: one temperature that its class logits are divided by.

    python -m models.class_temperature --skin square16    what a bundle's networks state beside what is right

The class of a touch is the mean over its pixels of their probabilities, as services take it. Trained with cross
entropy on single pixels, that mean is too sure or too modest; the temperature that makes the presses of
models/solved_presses.py likeliest mends it (Guo et al. 2017, "On calibration of modern neural networks"). It is divided
into the last layer's weights, so whoever runs the network need not know of it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from models.bundle import NETWORKS, Bundle
from models.evaluation import Predict, predict
from models.export import session
from models.geometry import load
from models.network import MMCNN
from models.prereconstruction import Array, PreReconstructor
from models.solved_presses import SolvedPresses, scans, solve

TEMPERATURES = np.geomspace(0.4, 3.0, 27)
BINS = 10  # of the probability, for the expected calibration error
SEED, CONDITIONS = 14, 16  # of noise: 2400 sightings give the calibration error to about 0.01


@dataclass(frozen=True, eq=False)
class SeenClasses:
    """M sightings: probabilities (T, M, 5) at each of T temperatures, the true class (M,), decibel (M,)."""

    temperatures: Array
    probabilities: Array
    truth: NDArray[np.int64]
    decibel: Array

    def weights(self) -> Array:
        """(M,) so that each class counts alike: presses are half circles."""
        counts = np.bincount(self.truth, minlength=self.probabilities.shape[2])
        return np.asarray(1.0 / counts[self.truth])

    def best(self, rows: NDArray[np.bool_] | None = None) -> int:
        """The temperature's index that makes the truth likeliest."""
        weight = self.weights() * (1.0 if rows is None else rows)
        told = np.log(np.maximum(self.probabilities[:, np.arange(len(self.truth)), self.truth], 1e-6))
        return int((told * weight).sum(axis=1).argmax())

    def said(self) -> dict[str, float]:
        """For the manifest. The error is of presses that the temperature was not chosen by."""
        odd = np.arange(len(self.truth)) % 2 == 1
        found = {"temperature": round(float(self.temperatures[self.best()]), 3)}
        return found | self.errors(np.where(odd, self.best(~odd), self.best(odd)))

    def as_it_is(self) -> dict[str, float]:
        """The same without any temperature."""
        return self.errors(np.full(len(self.truth), int(np.argmin(np.abs(self.temperatures - 1)))))

    def errors(self, chosen: NDArray[np.intp]) -> dict[str, float]:
        """Share of right answers and expected calibration error, each sighting at the temperature of this index."""
        found: dict[str, float] = {}
        shown = self.probabilities[chosen, np.arange(len(self.truth))]
        for name, rows in (("all", self.decibel > 0), ("noise-free", np.isinf(self.decibel))):
            right, error = calibration_error(shown[rows], self.truth[rows], self.weights()[rows])
            found |= {f"right, {name}": round(right, 3), f"calibration error, {name}": round(error, 3)}
        return found


def calibration_error(shown: Array, truth: NDArray[np.int64], weight: Array) -> tuple[float, float]:
    """(share of right answers, expected calibration error) of forced choices."""
    sure, right = shown.max(axis=1), shown.argmax(axis=1) == truth
    weight = weight / weight.sum()
    place = np.minimum((sure * BINS).astype(int), BINS - 1)
    gaps = np.bincount(place, weight * (right - sure), minlength=BINS)
    return float((weight * right).sum()), float(np.abs(gaps).sum())


def seen_classes(
    presses: SolvedPresses, pre: PreReconstructor, network: Predict, conditions: int = CONDITIONS
) -> SeenClasses:
    """The class probabilities of the presses' touches under the conditions of `solved_presses.scans`."""
    kinds = np.array([t.shape_class for t in presses.touches()])
    shown, truth, decibels = [], [], []
    for decibel, operator, chosen, d in scans(presses, pre, SEED, conditions):
        stack, context, _ = operator.stacks(d)
        drop, _, logits = network(stack, context)
        for k, image, one in zip(chosen, drop[:, 0], logits, strict=True):
            shown.append(pooled(image, one))
            truth.append(kinds[k])
            decibels.append(decibel)
    return SeenClasses(TEMPERATURES, np.stack(shown, axis=1), np.array(truth), np.array(decibels))


def pooled(image: Array, logits: Array) -> Array:
    """(T, 5) mean class probabilities over the strongest touch of an image (n, n), logits (5, h, w)."""
    smooth = ndimage.gaussian_filter(image, 1.0)
    h, w = logits.shape[1:]
    touched = (smooth > 0.5 * smooth.max()).reshape(h, len(image) // h, w, len(image) // w).sum(axis=(1, 3))
    there = touched > 0
    scaled = logits[:, there][None] / TEMPERATURES[:, None, None]
    share = np.exp(scaled - scaled.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    return np.asarray((share * touched[there]).sum(axis=2) / touched.sum())


def cooled(model: MMCNN, temperature: float) -> None:
    """Divides the class logits by a temperature."""
    assert model.classes.bias is not None
    with torch.no_grad():
        model.classes.weight /= temperature
        model.classes.bias /= temperature


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m models.class_temperature", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--skin", default="square16")
    args = parser.parse_args(argv)
    bundle = Bundle.load(args.skin)
    presses, pre = solve(load(args.skin)), bundle.prereconstructor()
    for variant in NETWORKS:
        if (path := bundle.network_path(variant)) is not None:
            found = seen_classes(presses, pre, predict(session(path.read_bytes()))).as_it_is()
            print(f"{variant}: " + ", ".join(f"{name} {value:.3f}" for name, value in found.items()))


if __name__ == "__main__":
    main()
