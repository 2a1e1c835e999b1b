"""Whether a training was enough, in words: held-out figures against the one-step image, the noise's floor, and what
more time would bring.

What more brings: the shipped square's networks have a held-out contact IoU, without noise, of 0.763 after 4258 batches
of 64 scenes (fast) and 0.826 after 44 195 (full): what they lack of 1 falls as batches^-0.13. A disc of 12 electrodes
that had 60 batches, 0.589, fits that too. Another skin has another constant, and this exponent until it is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from models.augmentation import OwnSkin
from models.evaluation import LEVELS, Predict, evaluate
from models.fisher import floors
from models.prereconstruction import Array, PreReconstructor
from models.samples import Samples
from models.shapes import from_rows

EXPONENT = 0.13
TIMES = 10  # batches: what is foretold
WORTH = 0.05  # of contact IoU: what ten times the batches must bring to be worth their time
NEAR_FLOOR = 1.6  # times the floor: a position that is as good as it gets
FAR_FROM_FLOOR = 3.0
BETTER = 0.05  # of contact IoU, than the one-step image: less is not worth a network
FARTHER = 1.25  # times the one-step image's distance from where a touch is: such an image misleads
FLOORS = 24  # held-out touches that floors are computed for
MEAN_OF_RMS = float(np.sqrt(np.pi) / 2)  # mean distance of a two-dimensional normal error, of its root mean square


@dataclass(frozen=True)
class TrainingVerdict:
    """grade: "good", "usable" or "too little"; text: a few sentences, for whoever started the training."""

    grade: str
    text: str
    figures: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        return {"grade": self.grade, "text": self.text, **{k: round(v, 4) for k, v in self.figures.items()}}


def one_step(held_out: Samples, pre: PreReconstructor, own: OwnSkin | None = None) -> dict[str, float]:
    """Figures (models.evaluation) of the stack's one-step image with the best contact IoU, without noise: what there is
    without a network.
    """

    def image(rung: int) -> Predict:
        def predict(stack: Array, context: Array) -> tuple[Array, Array, Array]:
            low = stack[:, rung]
            drop = ndimage.zoom(low, (1, 96 / low.shape[1], 96 / low.shape[2]), order=1, grid_mode=True, mode="nearest")
            shape = (len(drop), 1, *drop.shape[1:])
            return drop.reshape(shape), np.zeros(shape), np.zeros((len(drop), 5, 24, 24))

        return predict

    rungs = range(len(pre.m.ladder))
    level = LEVELS["noise-free"]
    found = [evaluate(image(rung), held_out, pre, level, limit=128, own=own) for rung in rungs]
    return max(found, key=lambda figures: figures["contact IoU"])


def position_floor(skin: str, held_out: Samples, decibel: float = 70.0) -> float:
    """Mean position error [% of the square's side] that no estimator beats, over some held-out single touches.

    skin: a shipped skin's name or a .toml path.
    """
    single = np.flatnonzero(~(held_out.shapes[:, 1, 0] > 0))[:FLOORS]
    touches = [from_rows(held_out.shapes[k].astype(float))[0] for k in single]
    return MEAN_OF_RMS * float(np.mean([floors(skin, t, decibel)["bayes"].position_percent for t in touches]))


def judge(
    held_out: Mapping[str, Mapping[str, float]], batches: int, minutes: float, single_step: float, floor: float
) -> TrainingVerdict:
    """held_out: level -> figures of models.evaluation; single_step: see `one_step`; floor: see `position_floor`."""
    clean, noisy = held_out["noise-free"], held_out["70 dB"]
    iou, place = clean["contact IoU"], noisy["position % of side"]
    ratio = place / max(floor, 1e-9)
    gain = (1 - iou) * (1 - TIMES**-EXPONENT)
    if iou < single_step + BETTER or ratio > FAR_FROM_FLOOR:
        grade = "too little"
    elif gain > WORTH or ratio > NEAR_FLOOR:
        grade = "usable"
    else:
        grade = "good"
    first = {
        "good": "good: what more time brings is hardly seen",
        "usable": "usable: positions are right, shapes and forces would gain from more time",
        "too little": "too little: far from what this skin can do",
    }[grade]
    text = (
        f"{first}. Held-out touches: contact IoU {iou:.2f} without noise (the one-step image, without any network: "
        f"{single_step:.2f}); position at 70 dB off by {place:.2f} % of the side, {ratio:.1f} times what the noise "
        f"allows ({floor:.2f} %); shape class right in {100 * clean['class']:.0f} %. "
    )
    if grade == "good":
        text += f"{TIMES} times its {batches} batches would bring {gain:.2f} of contact IoU at most."
    else:
        text += (
            f"It has seen {batches} batches in {minutes:.0f} minutes; {TIMES} times as many ({TIMES * minutes:.0f} "
            f"minutes at this pace) would bring a contact IoU of about {iou + gain:.2f}: make train with "
            f"MINUTES={_round(TIMES * minutes / 0.58)}, which adds to the scenes that are there."
        )
    figures = {"contact_iou": iou, "one_step_contact_iou": single_step, "position_percent": place}
    figures |= {"position_floor_percent": floor, "expected_contact_iou": iou + gain, "batches": float(batches)}
    return TrainingVerdict(grade, text, figures)


def judge_registered(
    held_out: Mapping[str, Mapping[str, float]], batches: int, minutes: float, single_step: Mapping[str, float]
) -> TrainingVerdict:
    """Of a registered skin: what its presses leave unexplained is in the held-out scenes, and no floor is known.

    held_out: as for `judge`; single_step: see `one_step`. A network that is "too little" is not to be shipped.
    """
    clean = held_out["noise-free"]
    iou, place = clean["contact IoU"], clean["position % of side"]
    iou_before, place_before = single_step["contact IoU"], single_step["position % of side"]
    gain = (1 - iou) * (1 - TIMES**-EXPONENT)
    worse = iou < iou_before + BETTER or place > FARTHER * place_before
    first = (
        "too little: the image without a network is about as good or better, and stays"
        if worse
        else "usable: it shows more than the image without a network"
    )
    text = (
        f"{first}. Held-out touches, simulated and warped to this skin, with what its presses leave unexplained: "
        f"contact IoU {iou:.2f} (the one-step image: {iou_before:.2f}), position off by {place:.2f} % of the side "
        f"({place_before:.2f} %). It has seen {batches} batches in {minutes:.0f} minutes; more presses bring more than "
        "more time does. Positions of contacts remain those of the presses' own likelihood."
    )
    figures = {"contact_iou": iou, "one_step_contact_iou": iou_before, "position_percent": place}
    figures |= {"one_step_position_percent": place_before, "expected_contact_iou": iou + gain}
    return TrainingVerdict("too little" if worse else "usable", text, figures | {"batches": float(batches)})


def _round(minutes: float) -> int:
    """To what one types."""
    return int(np.ceil(minutes / 10) * 10)
