"""Training batches: clean differences and pictures of the scenes in memory; symmetry, noise and pre-
reconstruction as they are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from models import data, geometry
from models.augmentation import Condition, OwnSkin, random_condition
from models.device_batches import ConditionTensors, SceneTensors, measured, stacks
from models.losses import IGNORE, Target
from models.prereconstruction import Array, PreReconstructor
from models.shapes import from_rows
from models.symmetries import Symmetry, symmetries
from models.turns import Pixel

N = 96
GRID = 24
KIND_WEIGHT = np.array([0.0, 0.85, 1.2, 1.2, 1.2, 1.6, 0.8])  # none, circle, triangle, rectangle, square, L, Hertz
SMALL_RADIUS, SMALL_WEIGHT = 0.22, 1.4  # touches of a smaller circle are hard, and few


@dataclass(frozen=True, eq=False)
class Samples:
    """M scenes in memory. d (M, K) float32, drop (M, 96, 96) float16 [S/m], mask (M, 96, 96) uint8 (255 =
    covered), classes (M, 24, 24) uint8.
    """

    d: npt.NDArray[np.float32]
    drop: npt.NDArray[np.float16]
    mask: npt.NDArray[np.uint8]
    classes: npt.NDArray[np.uint8]
    shapes: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.d)


def load(folder: Path, split: str, pre: PreReconstructor, limit: int | None = None, skip: int = 0) -> Samples:
    """Reads a split, but for its first `skip` chunks, and puts its differences in the bundle's normalisation. Raises
    NoScenes, OtherScenes.
    """
    raw = data.load(folder, split, limit, skip)
    if raw.difference.shape[1] != pre.measurements:
        raise data.OtherScenes(
            f"{folder} holds scenes with {raw.difference.shape[1]} measurements, expected {pre.measurements} as the "
            "bundle's matrices have them: name the folder, or the bundle, of the same skin"
        )
    z0 = raw.z0[raw.variant]
    d = raw.difference.astype(np.float64)
    if pre.m.normalisation == "model":
        gain = np.median(z0 / pre.m.z0, axis=1, keepdims=True)
        d = d * z0 / (gain * pre.m.z0)
    drop, mask, classes = picture(raw.shapes, raw.blur)
    return Samples(d.astype(np.float32), drop, mask, classes, raw.shapes)


def picture(
    shapes: npt.NDArray[np.floating], blur: npt.NDArray[np.floating] | None = None
) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Drop, mask and class pictures of (M, 3, 7) shape rows; see Samples.

    blur (M,): of their edges, model units. A soft touch's mask is its blurred coverage, so that drop is amplitude times
    mask for it too.
    """
    m = len(shapes)
    drop = np.zeros((m, N, N), np.float16)
    mask = np.zeros((m, N, N), np.uint8)
    classes = np.full((m, GRID, GRID), IGNORE, np.uint8)
    for k in range(m):
        image, covered = np.zeros((N, N)), np.zeros((N, N))
        for shape in from_rows(shapes[k].astype(float)):
            part = shape.fraction(N, covered=True)
            covered += part
            image += shape.drop * (shape.fraction(N) if shape.kind == "hertz" else part)
            coarse = part.reshape(GRID, N // GRID, GRID, N // GRID).mean(axis=(1, 3))
            classes[k][coarse > 0.3] = shape.shape_class
        if blur is not None and blur[k] > 0:
            image, covered = (gaussian_filter(p, blur[k] * N / 2, mode="constant") for p in (image, covered))
        drop[k], mask[k] = image, np.round(255 * covered.clip(0, 1))
    return drop, mask, classes


@dataclass
class Batch:
    stack: Tensor
    context: Tensor
    target: Target


class Batches:
    """Endless random batches on a device. Operators depend on the noise, so a bank of conditions is kept and one is
    renewed at every batch.
    """

    def __init__(
        self,
        samples: Samples,
        pre: PreReconstructor,
        skin: geometry.SkinGeometry,
        seed: int,
        size: int = 64,
        groups: int = 4,
        bank: int = 96,
        device: torch.device | str = "cpu",
        own: OwnSkin | None = None,
    ) -> None:
        self.samples, self.pre, self.size, self.groups, self.limit = samples, pre, size, groups, bank
        self.rng, self.device = np.random.default_rng(seed), torch.device(device)
        self._noise = torch.Generator(self.device).manual_seed(seed)
        self.own = own
        every = symmetries(skin.to_dict(), skin.pattern)
        self.symmetries = every if own is None else every[:1]
        self._weigh()
        self.bank = [self._fresh() for _ in range(groups)]

    def _fresh(self) -> ConditionTensors:
        return ConditionTensors(random_condition(self.pre, self.rng, self.own), self.device)

    def add(self, more: Samples) -> None:
        """Takes further scenes in."""
        mine = vars(self.samples)
        self.samples = Samples(**{k: np.concatenate([v, getattr(more, k)]) for k, v in mine.items()})
        self._weigh()

    def _weigh(self) -> None:
        """Scenes are drawn by what touches in them: round contacts teach least, and Hertz contacts are circles too;
        the L and small touches are hardest.
        """
        kind = np.nan_to_num(self.samples.shapes[:, :, 0]).astype(int)
        small = np.nan_to_num(self.samples.shapes[:, :, 3]) < SMALL_RADIUS
        touches = np.maximum((kind > 0).sum(axis=1), 1)
        self.cumulated = np.cumsum((KIND_WEIGHT[kind] * np.where(small, SMALL_WEIGHT, 1.0)).sum(axis=1) / touches)
        s = self.samples
        self._scenes = SceneTensors(s.d, s.drop, s.mask, s.classes, self.symmetries, self.device)

    def draw(self) -> Batch:
        fresh = self._fresh()
        if len(self.bank) < self.limit:
            self.bank.append(fresh)
        else:
            self.bank[self.rng.integers(self.limit)] = fresh
        chosen = [self.bank[c] for c in self.rng.choice(len(self.bank), self.groups, replace=False)]
        n = self.size // self.groups
        place = self.rng.random(self.groups * n) * self.cumulated[-1]
        index = torch.from_numpy(np.searchsorted(self.cumulated, place)).to(self.device)
        turn = torch.from_numpy(self.rng.integers(len(self.symmetries), size=len(place))).to(self.device)
        clean, target = self._scenes.pick(index, turn)
        seen = measured(chosen, clean.reshape(self.groups, n, -1), self._noise)
        stack, context, scale = stacks(chosen, seen)
        target.drop /= scale[:, None, None, None]
        return Batch(stack.contiguous(memory_format=torch.channels_last), context, target)


def make(
    samples: Samples,
    index: npt.NDArray[np.integer],
    turned: list[Symmetry] | None,
    condition: Condition,
    rng: np.random.Generator,
) -> Batch:
    """The samples of `index` under one condition, each turned by its symmetry."""
    s, same = samples, [None] * len(index)
    d = np.stack([s.d[i] if t is None else s.d[i][t.measurements] for i, t in zip(index, turned or same, strict=True)])

    def pictures(images: npt.NDArray[Pixel]) -> npt.NDArray[Pixel]:
        return np.stack(
            [images[i] if t is None else t.turn.image(images[i]) for i, t in zip(index, turned or same, strict=True)]
        )

    stack, context, scale = condition.operator.stacks(condition.spoil(d, rng))
    drop = pictures(s.drop).astype(np.float32)[:, None] / scale[:, None, None, None]
    mask = pictures(s.mask).astype(np.float32)[:, None] / 255
    target = Target(torch.from_numpy(drop), torch.from_numpy(mask), torch.from_numpy(pictures(s.classes)).long())
    return Batch(torch.from_numpy(stack), torch.from_numpy(context), target)


def join(parts: list[Batch]) -> Batch:
    return Batch(
        torch.cat([p.stack for p in parts]),
        torch.cat([p.context for p in parts]),
        Target(
            torch.cat([p.target.drop for p in parts]),
            torch.cat([p.target.mask for p in parts]),
            torch.cat([p.target.classes for p in parts]),
        ),
    )


def levels(samples: Samples, pre: PreReconstructor) -> Array:
    """(C,) rms of each rung's images without noise, of the frame's scale: `Matrices.level`. Brings every rung to
    unit size.
    """
    operator = pre.condition(np.full(pre.measurements, 1e-9))
    images = operator.images(samples.d)
    scale = images[:, operator.scale_index].max(axis=1)
    inside = (images / scale[:, None, None])[:, :, operator.inside.ravel()]
    return np.asarray(np.sqrt((inside**2).mean(axis=(0, 2))))
