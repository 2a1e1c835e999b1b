"""Quick figures on held-out scenes, while training and for the manifest; bench/accuracy/ has the full table."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnxruntime
import torch

from models import samples
from models.augmentation import OwnSkin, condition
from models.network import MMCNN
from models.prereconstruction import Array, Drift, PreReconstructor

LEVELS = {"noise-free": 120.0, "70 dB": 70.0}
Predict = Callable[[Array, Array], tuple[Array, Array, Array]]  # stack, context -> drop, log_sigma, classes


def predict(model: MMCNN | onnxruntime.InferenceSession) -> Predict:
    """A network, or an ONNX session, as a function of arrays."""
    if not isinstance(model, MMCNN):
        return lambda stack, context: tuple(model.run(None, {"stack": stack, "context": context}))

    @torch.no_grad()
    def run(stack: Array, context: Array) -> tuple[Array, Array, Array]:
        device = next(model.parameters()).device
        model.eval()
        found = model(torch.from_numpy(stack).to(device), torch.from_numpy(context).to(device))
        return tuple(t.float().cpu().numpy() for t in found)

    return run


def evaluate(
    network: Predict,
    held_out: samples.Samples,
    pre: PreReconstructor,
    decibel: float,
    limit: int = 256,
    exact: bool = False,
    own: OwnSkin | None = None,
) -> dict[str, float]:
    """Mean figures on at most `limit` single touches, no drift; a touch is what exceeds half its peak.

    exact: for scenes solved on another mesh, which need no model error made up.
    """
    single = np.flatnonzero(~(held_out.shapes[:, 1, 0] > 0))[:limit]
    rng = np.random.default_rng(0)
    sigma = np.full(pre.measurements, 10 ** (-decibel / 20))
    batch = samples.make(held_out, single, None, condition(pre, rng, sigma, Drift(), exact=exact, own=own), rng)
    stack, context = batch.stack.numpy(), batch.context.numpy()
    parts = [network(stack[k : k + 64], context[k : k + 64]) for k in range(0, len(single), 64)]
    drop, log_sigma, classes = (np.concatenate([p[i] for p in parts]) for i in range(3))
    truth, mask = batch.target.drop.numpy()[:, 0], batch.target.mask.numpy()[:, 0]
    rows = _figures(drop[:, 0], log_sigma[:, 0], classes, truth, mask, batch.target.classes.numpy())
    return {k: float(np.nanmean(v)) for k, v in rows.items()}


def _figures(
    drop: Array, log_sigma: Array, classes: Array, truth: Array, mask: Array, kinds: Array
) -> dict[str, Array]:
    axes = (1, 2)
    peak, true_peak = drop.max(axes), truth.max(axes)
    seen = drop > 0.5 * peak[:, None, None]
    real = mask > 0.5 * mask.max(axes)[:, None, None]  # of a soft touch too small to be covered anywhere: where most is
    contact = (seen & real).sum(axes) / (seen | real).sum(axes)
    background = (~seen & ~real).sum(axes) / (~seen | ~real).sum(axes)
    axis = -1 + 2 * (np.arange(drop.shape[-1]) + 0.5) / drop.shape[-1]
    where = [np.stack([(m * a).sum(axes) / m.sum(axes) for a in (axis, axis[:, None])], 1) for m in (seen, real)]
    known = kinds < classes.shape[1]
    shifted = np.exp(classes - classes.max(1, keepdims=True))
    share = (shifted / shifted.sum(1, keepdims=True) * known[:, None]).sum((2, 3))
    kind = np.where(known, kinds, -1).max(axes)
    z = (drop - truth) * np.exp(-log_sigma)
    return {
        "mean IoU": (contact + background) / 2,
        "contact IoU": contact,
        "position % of side": 50 * np.linalg.norm(where[0] - where[1], axis=1),
        "peak error": np.abs(peak / true_peak - 1),
        "integral error": np.abs(drop.sum(axes) / truth.sum(axes) - 1),
        "class": np.where(kind >= 0, share.argmax(1) == kind, np.nan),
        "sigma ratio": np.sqrt((z**2 * real).sum(axes) / real.sum(axes)),
    }
