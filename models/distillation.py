"""A trained network as the teacher of a smaller one (Hinton et al. 2015, "Distilling the knowledge in a neural
network").

Noise hides part of a touch, so its true mask is more than any network can say of one frame; the teacher's answer is
what can be said, and has less scatter to be averaged away. The teacher sees each batch turned by one of the skin's
symmetries and its answer is turned back: what the pupil learns is the mean over the symmetries, which is better than
the teacher itself (services/symmetry.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from models.losses import IGNORE, SMALL, Target
from models.network import MMCNN
from models.turns import Turn

Parts = tuple[Tensor, Tensor, Tensor, Tensor]


@dataclass
class Teacher:
    """model: in eval mode, on the pupil's device; said: what a manifest says of it."""

    model: MMCNN
    said: dict[str, Any]

    @torch.no_grad()
    def parts(self, stack: Tensor, context: Tensor, turn: Turn) -> Parts:
        """What MMCNN.parts gives, of the stack seen as `turn` shows it, turned back."""
        mask, amplitude, sigma, classes = self.model.parts(turned(stack, turn), context)
        back = turn.back
        return turned(mask, back), turned(amplitude, back), turned(sigma, back), turned(classes, back)


def turned(images: Tensor, turn: Turn) -> Tensor:
    """Images (..., n, n) as `Turn.image` turns them."""
    if turn.transpose:
        images = images.transpose(-1, -2)
    axes = [axis for axis, flip in ((-2, turn.flip_y), (-1, turn.flip_x)) if flip]
    return images.flip(axes) if axes else images


def taught(pupil: Parts, teacher: Parts, target: Target) -> dict[str, Tensor]:
    """How far the pupil is from the teacher, as batch means relative to the touch: the terms of models/losses.py that
    need a teacher.
    """
    axes = (1, 2, 3)
    area = target.mask.sum(axes)
    shown = torch.sigmoid(teacher[0])
    coarse = F.avg_pool2d(shown, shown.shape[-1] // teacher[1].shape[-1])
    off = F.smooth_l1_loss(pupil[1], teacher[1], reduction="none", beta=0.05)
    known = (target.classes != IGNORE)[:, None]
    apart = F.kl_div(F.log_softmax(pupil[3], 1), F.softmax(teacher[3], 1), reduction="none")
    return {
        "taught mask": (
            F.binary_cross_entropy_with_logits(pupil[0], shown, reduction="none").sum(axes) / (area + SMALL)
        ).mean(),
        "taught amplitude": ((off * coarse).sum(axes) / (coarse.sum(axes) + 0.1)).mean(),
        "taught class": (apart * known).sum() / known.sum().clamp_min(1),
    }
