"""Random contacts on a skin: what training sees, and what benchmarks are drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.geometry import SkinGeometry
from models.shapes import KINDS, Array, Shape, gap

Inside = Callable[[Array], NDArray[np.bool_]]  # points (m, 2) in model units -> which are on the skin


FITS = 0.9  # of the largest circle that a skin has room for: the largest contact that is asked for


@dataclass(frozen=True)
class Prior:
    """How contacts are distributed. Each range is (low, high), drawn from uniformly.

    With probability `tail` a size or drop comes from the wide range: the network must see rare cases, but seldom.
    `touches` are the probabilities of one, two, three contacts; `gap` is the least distance between two outlines.
    """

    radius: tuple[float, float] = (0.12, 0.45)
    radius_wide: tuple[float, float] = (0.08, 0.50)
    drop: tuple[float, float] = (0.10, 0.50)
    drop_wide: tuple[float, float] = (0.05, 0.90)
    tail: float = 0.2
    aspect: tuple[float, float] = (1.4, 2.6)
    touches: tuple[float, float, float] = (0.65, 0.20, 0.15)
    gap: float = 0.05
    kinds: tuple[str, ...] = KINDS

    def on(self, skin: SkinGeometry) -> Prior:
        """The same where the skin is wide enough; on a narrow one contacts no larger than it leaves room for."""
        axis = np.linspace(-1, 1, 81)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        room = FITS * float(skin.curve.distance(grid[skin.inside(grid)]).max())

        def within(sizes: tuple[float, float]) -> tuple[float, float]:
            return min(sizes[0], room / 2), min(sizes[1], room)

        return replace(self, radius=within(self.radius), radius_wide=within(self.radius_wide))


TRAINING = Prior()
TARGETS = Prior(radius=(0.15, 0.45), drop=(0.10, 0.50), tail=0.0, aspect=(1.5, 2.5), gap=0.10)  # the published targets


def inside_square(points: Array) -> NDArray[np.bool_]:
    """The square skin [-1, 1]^2; its edge counts as inside."""
    return np.asarray((np.abs(points) <= 1 + 1e-12).all(-1))


def _pick(rng: np.random.Generator, usual: tuple[float, float], wide: tuple[float, float], tail: float) -> float:
    return float(rng.uniform(*(wide if rng.random() < tail else usual)))


def random_shape(
    rng: np.random.Generator, prior: Prior = TRAINING, inside: Inside = inside_square, tries: int = 200
) -> Shape:
    """A contact that lies wholly on the skin, edge included; position uniform over what its size leaves.

    Raises ValueError where no contact of the prior's sizes fits on the skin.
    """
    for _ in range(5):
        kind = prior.kinds[rng.integers(len(prior.kinds))]
        radius = _pick(rng, prior.radius, prior.radius_wide, prior.tail)
        drop = _pick(rng, prior.drop, prior.drop_wide, prior.tail)
        rotation = 0.0 if kind in ("circle", "hertz") else float(rng.uniform(0, 2 * np.pi))
        aspect = float(rng.uniform(*prior.aspect)) if kind == "rectangle" else 1.0
        outline = Shape(kind, 0.0, 0.0, radius, drop, rotation, aspect).outline(32)
        for _ in range(tries):
            x, y = rng.uniform(-1, 1, 2)
            if inside(outline + (x, y)).all():
                return Shape(kind, float(x), float(y), radius, drop, rotation, aspect)
    raise ValueError(f"no contact of radius {prior.radius} fits on this skin: choose smaller radii")


def random_scene(
    rng: np.random.Generator, prior: Prior = TRAINING, inside: Inside = inside_square, n: int | None = None
) -> list[Shape]:
    """One to three contacts (or just n) no nearer to each other than the prior's gap.

    Where a further contact finds no room the scene is drawn again, with smaller ones the likelier the more often.
    """
    n = int(rng.choice(len(prior.touches), p=prior.touches)) + 1 if n is None else n
    for _ in range(1000):
        scene = [random_shape(rng, prior, inside)]
        for _ in range(20 * (n - 1)):
            if len(scene) == n:
                break
            candidate = random_shape(rng, prior, inside)
            if all(gap(candidate, other) >= prior.gap for other in scene):
                scene.append(candidate)
        if len(scene) == n:
            return scene
    raise ValueError(f"{n} contacts of radius {prior.radius} with a gap of {prior.gap} do not fit on this skin")
