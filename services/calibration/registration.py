"""Where a real skin's frame lies in that of the machine that presses it: a similarity fitted to known presses.

No reconstruction is needed for it: the bundle's sensitivities say how each measurement should change with the place of
a press, up to a gain per measurement, and the similarity is the one that explains most of how they did change. Presses
lie inside the skin, and seldom far from its edge: that bounds the skin's size where nobody tells it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from models.bundle import Bundle
from services.calibration.fields import electrodes, half_width, sample, sensitivities
from services.calibration.presses import Presses, RegistrationError, evenly, radius_of

Array = NDArray[np.float64]

FEWEST = 10
PRESS_BLUR = 2.0
"""Pixels of the bundle's grid over which sensitivities are averaged: about the width of a press."""
SIZE = (1.0, 1.6)  # radius of the electrodes' circle beside that of the presses, where nobody tells the size
KNOWN_SIZE = 0.02  # relative: how far the known size may be off
KNOWN_ANGLE = np.radians(5.0)
MOST_FOR_POSE = 200  # presses from which the pose is found
STARTS = 4  # the best of those on a grid, each followed to its optimum
PARTS = 10  # of the jackknife that tells the width of the posterior
SHUFFLES = 8
WIDEST_ANGLE = np.radians(30.0)
DECIDED = 2.0  # standard errors by which one numbering must explain more than the other


@dataclass(frozen=True)
class Similarity:
    """machine = offset + scale * R(angle) * M * skin; M mirrors y where `mirrored`."""

    angle: float  # rad
    scale: float  # of the skin's true size to the bundle's metres
    offset: Array  # (2,) m, the skin's centre in the machine's frame
    mirrored: bool  # the electrodes are numbered the other way round than the bundle's

    @property
    def matrix(self) -> Array:
        c, s = np.cos(self.angle), np.sin(self.angle)
        rotation = np.array([[c, -s], [s, c]])
        return rotation @ np.diag([1.0, -1.0]) if self.mirrored else rotation

    def to_machine(self, skin: Array) -> Array:
        """(N, 2) m of the bundle's frame -> (N, 2) m of the machine's."""
        return np.asarray(self.offset + self.scale * skin @ self.matrix.T)

    def to_skin(self, machine: Array) -> Array:
        """(N, 2) m of the machine's frame -> (N, 2) m of the bundle's."""
        return np.asarray((machine - self.offset) @ self.matrix / self.scale)


@dataclass(frozen=True)
class KnownPose:
    """What somebody knows of the skin; None: nobody does."""

    diameter_m: float | None = None  # of the circle through the electrodes
    first_electrode: float | None = None  # rad, seen from the skin's centre, in the machine's frame
    clockwise: bool | None = None  # how the electrodes are numbered, in the machine's frame


@dataclass(frozen=True)
class Registration:
    """A similarity, how much it explains, and how well it is known."""

    similarity: Similarity
    explained: float  # share of the measurements' variance, with one gain per measurement
    sigma: dict[str, float]  # standard uncertainty of angle [rad], scale (relative), offset [m]
    doubts: list[str] = field(default_factory=list)  # for a person: what is not sure, and what would settle it


class _Pose:
    """What each press leaves unexplained, as a function of the pose.

    A pose is a way (numbered as the bundle, or mirrored) and p (4,): angle [rad], logarithm of the scale, offset x and
    y [m].

        fields (K', h, w)    the bundle's sensitivities, of the K' measurements that were measured
        y (N, K')            differences, each measurement with a mean square of 1
        width                half the side of the bundle's image [m]
        circle               radius of the circle through the electrodes, in the bundle's metres
        centre (2,), radius  middle of the presses, and how far the farthest lies from it [m of the machine's frame]
        sizes                least and largest scale that are looked at
    """

    def __init__(self, presses: Presses, bundle: Bundle, known: KnownPose) -> None:
        self.presses = presses[evenly(len(presses), MOST_FOR_POSE)]
        live = presses.measured
        self.fields, self.width = sensitivities(bundle, PRESS_BLUR)[live], half_width(bundle)
        y = self.presses.difference[:, live]
        self.y = y / np.maximum(np.sqrt((y**2).mean(axis=0)), 1e-30)
        xy = presses.xy
        self.centre = 0.5 * (xy.min(axis=0) + xy.max(axis=0))
        self.radius = radius_of(xy)
        at = electrodes(bundle)
        self.circle = float(np.linalg.norm(at, axis=1).max())
        self.first = float(np.arctan2(at[0, 1], at[0, 0]))
        turning = at[:, 0] * np.roll(at[:, 1], -1) - at[:, 1] * np.roll(at[:, 0], -1)
        bundle_clockwise = bool(turning.sum() < 0)
        if known.diameter_m is None:
            self.sizes = (SIZE[0] * self.radius / self.circle, SIZE[1] * self.radius / self.circle)
        else:
            size = 0.5 * known.diameter_m / self.circle
            self.sizes = (size * (1 - KNOWN_SIZE), size * (1 + KNOWN_SIZE))
        self.ways = (False, True) if known.clockwise is None else (known.clockwise != bundle_clockwise,)
        self.known_angle = known.first_electrode

    def angles(self, mirrored: bool) -> Array:
        """Angles [rad] to start at."""
        if self.known_angle is None:
            return np.asarray(np.radians(np.arange(0, 360, 10)), float)
        return np.array([self.known_angle + (self.first if mirrored else -self.first)])

    def of(self, p: Array, mirrored: bool) -> Similarity:
        """The pose p as a similarity."""
        return Similarity(float(p[0]), float(np.exp(p[1])), np.asarray(p[2:]), mirrored)

    def left(self, similarity: Similarity, rows: NDArray[np.intp] | slice = slice(None)) -> Array:
        """(N,) mean square that each press leaves unexplained, with one gain per measurement."""
        xy, y = self.presses.xy[rows], self.y[rows]
        x = sample(self.fields, similarity.to_skin(xy), self.width) * self.presses.strength[rows][:, None]
        gain = (x * y).sum(axis=0) / np.maximum((x * x).sum(axis=0), 1e-30)
        return np.asarray(((y - gain * x) ** 2).mean(axis=1))

    def cost(self, p: Array, mirrored: bool, rows: NDArray[np.intp] | slice = slice(None)) -> float:
        """Mean of `left`, with a wall where the size or the angle cannot be, or presses would lie outside the skin."""
        similarity = self.of(p, mirrored)
        low, high = np.log(self.sizes)
        wall = max(0.0, low - p[1]) + max(0.0, p[1] - high)
        out = np.linalg.norm(similarity.to_skin(self.presses.xy), axis=1) / self.circle - 1.0
        wall += max(0.0, float(out.max()))
        if self.known_angle is not None:
            off = p[0] - self.angles(mirrored)[0]
            wall += max(0.0, abs((off + np.pi) % (2 * np.pi) - np.pi) - KNOWN_ANGLE)
        return float(self.left(similarity, rows).mean() + 10.0 * wall)

    def start(self, angle: float) -> Array:
        """p (4,) at an angle: of middling size, over the middle of the presses."""
        return np.array([angle, np.log(np.sqrt(self.sizes[0] * self.sizes[1])), *self.centre])

    def best(self, start: Array, mirrored: bool, steps: int, rows: NDArray[np.intp] | slice = slice(None)) -> Array:
        """p (4,) of least cost near `start`."""
        reach = 0.06 * self.width * float(np.exp(start[1]))
        simplex = np.vstack([start, start + np.diag([0.1, 0.05, reach, reach])])
        found = optimize.minimize(
            self.cost, start, (mirrored, rows), "Nelder-Mead", options={"initial_simplex": simplex, "maxiter": steps}
        )
        return np.asarray(found.x)


def register(presses: Presses, bundle: Bundle, known: KnownPose | None = None) -> Registration:
    """The pose that explains most. Raises RegistrationError where the presses cannot tell it."""
    if len(presses) < FEWEST:
        without = f" ({presses.left_out} others of the file cannot be used)" if presses.left_out else ""
        raise RegistrationError(f"{len(presses)} presses{without}: at least {FEWEST}, spread over the skin, are needed")
    known = known or KnownPose()
    pose = _Pose(presses, bundle, known)
    _fits(pose, known)
    found = _best_of_each_way(pose)
    way = min(found, key=lambda each: found[each][0])
    p = found[way][1]
    similarity = pose.of(p, way)
    explained = 1 - float(pose.left(similarity).mean())
    sigma = _widths(pose, p, way)
    doubts = _doubts(pose, p, sigma, known)
    if len(found) == 2:
        other = pose.left(pose.of(found[not way][1], not way)) - pose.left(similarity)
        error = float(other.std(ddof=1)) / np.sqrt(len(other))
        if float(other.mean()) < DECIDED * error:
            doubts.append(
                "whether the electrodes are numbered clockwise is not decided by these presses: say --numbering"
            )
    if sigma["angle"] > WIDEST_ANGLE and known.first_electrode is None:
        raise RegistrationError(
            f"these {len(presses)} presses leave the skin's angle open by {np.degrees(sigma['angle']):.0f} degrees: "
            "say where the first electrode is (--first-electrode), or press at more places"
        )
    angle = float((p[0] + np.pi) % (2 * np.pi) - np.pi)
    return Registration(Similarity(angle, similarity.scale, similarity.offset, way), explained, sigma, doubts)


def _best_of_each_way(pose: _Pose) -> dict[bool, tuple[float, Array]]:
    """By whether the numbering is mirrored: the least cost, and its pose. Raises RegistrationError."""
    starts = {way: [(pose.cost(pose.start(a), way), a) for a in pose.angles(way).tolist()] for way in pose.ways}
    _better_than_chance(pose, [(angle, way) for way, each in starts.items() for _, angle in each])
    found = {}
    for way, each in starts.items():
        best = [pose.best(pose.start(angle), way, 250) for _, angle in sorted(each)[:STARTS]]
        found[way] = min(((pose.cost(p, way), p) for p in best), key=lambda pair: pair[0])
    return found


def _fits(pose: _Pose, known: KnownPose) -> None:
    """Presses of a size that a skin has, and inside the known one."""
    if pose.radius < 1e-4:
        raise RegistrationError(
            f"all presses lie within {2e3 * pose.radius:.2g} mm: spread them over the skin (xy is in metres)"
        )
    if known.diameter_m is not None and known.diameter_m < 2 * pose.radius * (1 - KNOWN_SIZE):
        raise RegistrationError(
            f"presses lie up to {2e3 * pose.radius:.0f} mm apart, the skin's diameter is said to be "
            f"{1e3 * known.diameter_m:.0f} mm: presses lie inside the skin; check both (metres)"
        )


def _better_than_chance(pose: _Pose, starts: list[tuple[float, bool]]) -> None:
    """The places must say more of the measurements than the same places in another order do, at the best of the poses
    that are looked at first.
    """
    rng, n = np.random.default_rng(7), len(pose.y)
    orders = [np.arange(n), *(rng.permutation(n) for _ in range(SHUFFLES))]
    explained = np.zeros(len(orders))
    for angle, way in starts:
        x = sample(pose.fields, pose.of(pose.start(angle), way).to_skin(pose.presses.xy), pose.width)
        power = np.maximum((x * x).sum(axis=0), 1e-30)
        each = [float(((x * pose.y[order]).sum(axis=0) ** 2 / power).mean()) / n for order in orders]
        explained = np.maximum(explained, each)
    chance = float(explained[1:].max())
    if explained[0] <= chance:
        raise RegistrationError(
            f"no pose of the skin explains these presses: {100 * explained[0]:.0f} % of how the measurements changed, "
            f"where the same places in another order explain {100 * chance:.0f} %. Check that row n of xy is where row "
            "n was measured, that xy is in metres, that this is the skin that was pressed, and what was told of it "
            "(--diameter, --first-electrode, --numbering)"
        )


def _widths(pose: _Pose, p: Array, way: bool) -> dict[str, float]:
    """Standard uncertainties of angle [rad], scale (relative) and offset [m], by a jackknife over the presses: what the
    model is wrong by is in it.
    """
    n = len(pose.presses)
    parts = np.random.default_rng(6).permutation(n) % min(PARTS, n)
    count = int(parts.max()) + 1
    found = np.array([pose.best(p, way, 60, np.flatnonzero(parts != one)) for one in range(count)])
    spread = np.sqrt((count - 1) / count * ((found - found.mean(axis=0)) ** 2).sum(axis=0))
    return {"angle": float(spread[0]), "scale": float(spread[1]), "offset": float(np.hypot(spread[2], spread[3]))}


def _doubts(pose: _Pose, p: Array, sigma: dict[str, float], known: KnownPose) -> list[str]:
    found = []
    low, high = np.log(pose.sizes)
    if known.diameter_m is None and (p[1] < low + 0.01 or p[1] > high - 0.01):
        end = SIZE[0] if p[1] < low + 0.01 else SIZE[1]
        found.append(
            f"the skin's size is at the end of what is looked at, {end:g} times the circle of the presses: "
            "say --diameter"
        )
    if sigma["scale"] > 0.15 and known.diameter_m is None:
        found.append(f"the skin's size is known to {100 * sigma['scale']:.0f} % only: say --diameter")
    return found
