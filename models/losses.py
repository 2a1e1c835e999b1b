"""The training losses: image, outline, amplitude, integral, class, and a calibrated sigma."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from models.network import UPSCALE, compose

SMALL = 100.0  # pixels of 96 x 96 added to a touch's area where a sum over pixels is made relative to it
IGNORE = 255


@dataclass
class Target:
    """drop (N, 1, 96, 96) in units of the frame's scale, mask (N, 1, 96, 96) area fraction, classes (N, 24, 24),
    255 = none.
    """

    drop: Tensor
    mask: Tensor
    classes: Tensor


WEIGHTS = {
    "image": 1.0,
    "mask": 1.0,
    "jaccard": 1.0,
    "amplitude": 0.5,
    "peak": 0.3,
    "integral": 0.3,
    "class": 0.8,
    "sigma": 0.02,
    # Where a larger network teaches (distillation.py).
    "taught mask": 1.0,
    "taught amplitude": 0.5,
    "taught class": 0.8,
}


def losses(parts: tuple[Tensor, Tensor, Tensor, Tensor], target: Target) -> dict[str, Tensor]:
    """WEIGHTS' terms that need no teacher, as batch means; all are relative to the touch, so a light touch counts as
    much as a heavy one.
    """
    logits, amplitude, sigma, classes = parts
    drop, log_sigma = compose(logits, amplitude, sigma)
    axes = (1, 2, 3)
    area = target.mask.sum(axes)
    peak = target.drop.amax(axes, keepdim=True).clamp_min(1e-6)
    error = (drop - target.drop) / peak
    inside = torch.sigmoid(logits)
    # Jaccard's index of two soft masks by their distance (Wang et al., "Jaccard metric losses", 2023): with products,
    # as for hard masks, a soft edge would be best answered by a hard one.
    apart = (inside - target.mask).abs().sum(axes)
    both = (inside.sum(axes) + area - apart) / 2
    # Amplitude where the touch covers the pixel whole, at one of every 4 x 4: at edges the target is amplitude times
    # mask.
    coarse = (..., slice(1, None, UPSCALE), slice(1, None, UPSCALE))
    whole = (target.mask[coarse] > 0.9).float()
    off = F.smooth_l1_loss(amplitude, torch.log(target.drop[coarse].clamp_min(1e-6)), reduction="none", beta=0.05)
    some = slice(0, max(1, len(drop) // 4))  # sigma takes little learning and much arithmetic: a quarter of the batch
    over = (drop[some].detach() - target.drop[some]) * torch.exp(-log_sigma[some])
    normal = 0.5 * over.clamp(-30, 30) ** 2 + log_sigma[some] - torch.log(peak[some])
    return {
        "image": ((error**2 + 0.5 * error.abs()).sum(axes) / (area + SMALL)).mean(),
        "mask": (
            F.binary_cross_entropy_with_logits(logits, target.mask, reduction="none").sum(axes) / (area + SMALL)
        ).mean(),
        "jaccard": (1 - (both + 1) / (both + apart + 1)).mean(),
        "amplitude": ((off * whole).sum(axes) / (whole.sum(axes) + 0.1)).mean(),
        # Force is read off the peak, and a largest of many values is too large unless it is asked not to be.
        "peak": F.smooth_l1_loss(torch.log(drop.amax(axes) + 1e-6), torch.log(peak[:, 0, 0, 0]), beta=0.05),
        "integral": (error.sum(axes).abs() / (target.drop / peak).sum(axes).clamp_min(1.0)).mean(),
        "class": F.cross_entropy(classes, target.classes, ignore_index=IGNORE),
        "sigma": normal.mean(),
    }


def total(terms: dict[str, Tensor]) -> Tensor:
    return sum((WEIGHTS[name] * value for name, value in terms.items()), torch.zeros(()))
