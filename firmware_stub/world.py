"""What the stub's skin looks like at one instant: touches, background conductivity, contact impedances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.pressure import FOAM
from models.shapes import Shape

MOVING = ("x", "y", "radius", "drop", "rotation", "aspect", "crept")


@dataclass(frozen=True, slots=True)
class Touch:
    """One contact. Metres in the skin's frame, drop in S/m; `radius` is the circumscribed circle's.

    `drop` is what its force makes at once, and what the truth says; the sheet feels what has `crept` in beside.
    """

    kind: str
    x: float
    y: float
    radius: float
    drop: float
    rotation: float = 0.0
    aspect: float = 1.0
    crept: float = 0.0  # S/m

    @property
    def force_n(self) -> float:
        """Newtons: the foam's pressure, summed over the patch, that makes `drop`."""
        return FOAM.force(self.kind, self.drop, _area(self.kind, self.radius, self.aspect))

    @property
    def pressure(self) -> float:
        """Pascals, where it is highest."""
        return float(FOAM.pressure(self.drop))

    @property
    def felt(self) -> float:
        """The drop [S/m] that is there."""
        return self.drop + self.crept


@dataclass(frozen=True, slots=True)
class WarmSpot:
    """The sheet conducts better by `share` at (x, y) [m], and less so around: a Gaussian of standard deviation `radius`
    [m].
    """

    x: float
    y: float
    radius: float
    share: float


def pressed(
    kind: str, x: float, y: float, radius: float, force_n: float, rotation: float = 0.0, aspect: float = 1.0
) -> Touch:
    """The touch of this force [N]: its drop is what the foam answers to the pressure under its patch."""
    drop = FOAM.peak_drop(kind, force_n, _area(kind, radius, aspect))
    return Touch(kind, x, y, radius, drop, rotation, aspect)


def _area(kind: str, radius: float, aspect: float) -> float:
    """Square metres."""
    return Shape(kind, 0.0, 0.0, radius, 0.0, 0.0, aspect).area


@dataclass(frozen=True, slots=True)
class World:
    """Everything the impedances depend on.

    `background` multiplies the sheet's conductivity, `contact` each electrode's contact impedance (empty: all 1).
    What real skins do beside, and no truth tells: `residues`, drops that earlier touches left in the foam; `gradient`,
    how much better the sheet conducts a metre along x and y; `spots` that are warm.
    """

    touches: tuple[Touch, ...] = ()
    background: float = 1.0
    contact: tuple[float, ...] = ()
    residues: tuple[Touch, ...] = ()
    gradient: tuple[float, float] = (0.0, 0.0)
    spots: tuple[WarmSpot, ...] = ()

    def rounded(self) -> World:
        """To a nanometre: the same pose of a later round of a loop is the same world."""
        return World(
            tuple(_rounded(touch) for touch in self.touches),
            round(self.background, 9),
            tuple(round(v, 9) for v in self.contact),
            tuple(_rounded(touch) for touch in self.residues),
            (round(self.gradient[0], 9), round(self.gradient[1], 9)),
            tuple(WarmSpot(s.x, s.y, s.radius, round(s.share, 9)) for s in self.spots),
        )


def _rounded(touch: Touch) -> Touch:
    return Touch(touch.kind, *(round(getattr(touch, f), 9) for f in MOVING))


def blend(a: World, b: World, s: float) -> World:
    """The world a fraction `s` of the way from a to b; both have the same touches, residues and spots, in one order."""
    if s <= 0 or a == b:
        return a
    if s >= 1:
        return b

    def mix(p: float, q: float) -> float:
        return p + s * (q - p)

    def mixed(p: tuple[Touch, ...], q: tuple[Touch, ...]) -> tuple[Touch, ...]:
        return tuple(
            Touch(one.kind, *(mix(getattr(one, f), getattr(other, f)) for f in MOVING))
            for one, other in zip(p, q, strict=True)
        )

    return World(
        mixed(a.touches, b.touches),
        mix(a.background, b.background),
        tuple(mix(p, q) for p, q in zip(*_contacts(a, b), strict=True)),
        mixed(a.residues, b.residues),
        (mix(a.gradient[0], b.gradient[0]), mix(a.gradient[1], b.gradient[1])),
        tuple(WarmSpot(p.x, p.y, p.radius, mix(p.share, q.share)) for p, q in zip(a.spots, b.spots, strict=True)),
    )


def _contacts(a: World, b: World) -> tuple[tuple[float, ...], tuple[float, ...]]:
    n = max(len(a.contact), len(b.contact))
    return a.contact or (1.0,) * n, b.contact or (1.0,) * n


def steps_between(a: World, b: World) -> int:
    """How many solved poses a path from a to b needs so that cubic interpolation stays below the noise of 80 dB.

    A pose may move by a quarter of its radius, turn by a quarter of a radian, change its drop by 0.1 S/m,
    its size by a tenth; the background by 2 %, a contact impedance by 10 %.
    """
    need = [abs(a.background - b.background) / 0.02]
    need += [abs(p - q) / 0.1 for p, q in zip(*_contacts(a, b), strict=True)]
    for p, q in zip(a.touches, b.touches, strict=True):
        radius = max(min(p.radius, q.radius), 1e-4)
        need.append(float(np.hypot(p.x - q.x, p.y - q.y)) / (0.25 * radius))
        need.append(abs(p.rotation - q.rotation) / 0.25)
        need.append(abs(p.felt - q.felt) / 0.1)
        need.append(abs(p.radius - q.radius) / (0.1 * radius))
        need.append(abs(p.aspect - q.aspect) / 0.2)
    return int(np.ceil(max(need) - 1e-9))
