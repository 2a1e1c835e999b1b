"""Test frames for the square skin: solved on a mesh that no training saw, and another solver's as a check.

Noise-free impedances of named groups of scenes, kept in bench/work under the arguments they were made from:

    shapes      one touch of each of the five shapes, sizes, drops and places of models.scenes.TARGETS
    hertz       one soft round touch
    two, three, four  that many touches that begin together, with gaps of at least 0.1 (four: of radius 0.16 to 0.28)
    force       circles of radius 0.2, drops 0.1 to 0.5, anywhere
    ldci-S-D    the paper's 49 positions at spacing S, radius 0.2, drop D (ten solved, 49 by symmetry)
    eidors      the single touches of eidors_reference.npz in $EITSKIN_REFERENCE, where it is there
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from bench import WORK
from models import geometry, metrics, patterns
from models.forward import ForwardModel
from models.scenes import TARGETS, random_scene
from models.shapes import CLASSES, Array, Shape, from_rows, to_rows
from models.symmetries import symmetries as skin_symmetries

DATA = Path(os.environ.get("EITSKIN_REFERENCE", "../shared/data"))
"""The folder of data that nobody here made up."""
EIDORS = DATA / "eidors_reference.npz"
SKIN = "square16"
NOISE_FREE = 1e-6
LDCI = [(spacing, drop) for spacing in (0.2, 0.25) for drop in (0.15, 0.85)]
MOST = 4  # touches of a scene
SEVERAL = {"two": 2, "three": 3, "four": 4}
SINGLE = ("shapes", "hertz", "force")


@dataclass(frozen=True, eq=False)
class Frames:
    """N scenes: group (N,) names, shapes (N, 4, 7), impedances of both patterns with each frame's own untouched ones.

    pairs, pairs0 (N, 120) and adjacent, adjacent0 (N, 208), ohm.
    """

    group: NDArray[np.str_]
    shapes: Array
    pairs: Array
    pairs0: Array
    adjacent: Array
    adjacent0: Array

    def __len__(self) -> int:
        return len(self.group)

    def of(self, *groups: str) -> NDArray[np.int64]:
        """Indices of the frames of these groups."""
        return np.flatnonzero(np.isin(self.group, groups))

    def scene(self, k: int) -> list[Shape]:
        return from_rows(self.shapes[k])

    def part(self, index: NDArray[np.int64] | list[int]) -> Frames:
        return Frames(*(getattr(self, f)[index] for f in self.__dataclass_fields__))

    def __add__(self, other: Frames) -> Frames:
        both = ((getattr(self, f), getattr(other, f)) for f in self.__dataclass_fields__)
        return Frames(*(np.concatenate(pair) for pair in both))


def scenes(seed: int, n: int, singles: int | None = None) -> list[tuple[str, list[Shape]]]:
    """The scenes to solve, with the names of their groups; `singles` touches (default n) of each shape and force,
    other groups in proportion to n.
    """
    singles = n if singles is None else singles
    rng = np.random.default_rng([seed, 77])
    made: list[tuple[str, list[Shape]]] = []
    for kind in CLASSES:
        made += [("shapes", random_scene(rng, replace(TARGETS, kinds=(kind,)), n=1)) for _ in range(singles)]
    made += [("hertz", random_scene(rng, replace(TARGETS, kinds=("hertz",)), n=1)) for _ in range(n // 2)]
    for name in ("two", "three"):
        made += [(name, random_scene(rng, TARGETS, n=SEVERAL[name])) for _ in range(n)]
    force = replace(TARGETS, kinds=("circle",), radius=(0.2, 0.2))
    made += [("force", random_scene(rng, force, n=1)) for _ in range(singles)]
    for spacing, drop in LDCI:
        places = metrics.ldci_positions(spacing)
        octant = places[(places[:, 0] >= -1e-9) & (places[:, 1] >= -1e-9) & (places[:, 0] >= places[:, 1] - 1e-9)]
        made += [(f"ldci-{spacing}-{drop}", [Shape("circle", x, y, 0.2, drop)]) for x, y in octant]
    return made + [("four", random_scene(rng, replace(TARGETS, radius=(0.16, 0.28)), n=4)) for _ in range(n)]


def symmetries() -> list[tuple[Array, NDArray[np.int64]]]:
    """The square's eight, those that mirror last: a matrix (2, 2) of the plane, and where each electrode goes (16,)."""
    skin = geometry.load(SKIN)
    found = [
        (each.turn.points(np.eye(2)).T, np.argsort(each.electrodes))
        for each in skin_symmetries(skin.to_dict(), skin.pattern)
    ]
    return sorted(found, key=_mirrored_and_quarter)


def _mirrored_and_quarter(symmetry: tuple[Array, NDArray[np.int64]]) -> tuple[bool, int]:
    """Which of several ways to the same place is taken: it is solved on a mesh that is not quite symmetric."""
    turn, _ = symmetry
    side = round(np.linalg.det(turn))
    return side < 0, round(np.arctan2(side * turn[1, 0], side * turn[0, 0]) / (np.pi / 2)) % 4


def _solve(wanted: list[tuple[str, list[Shape]]], mesh: str, path: Path) -> Frames:
    """Solve scenes in order, keeping what is done in `path` every few; the LDCI groups spread over the square."""
    model = ForwardModel(SKIN, mesh=mesh)
    pair, adjacent = (patterns.pattern(name, 16) for name in ("pairs", "adjacent"))
    untouched = model.solve(1.0)
    z0, a0 = np.abs(untouched.impedances(pair)), np.abs(untouched.impedances(adjacent))
    rows: list[tuple[str, Array, Array, Array]] = []
    done = 0
    if path.exists():
        with np.load(path) as file:
            rows = list(zip(*(file[k] for k in ("group", "shapes", "pairs", "adjacent")), strict=True))
            done = int(file["done"])
    eight = symmetries()
    for k in track(range(done, len(wanted)), description=f"test frames on the {mesh} mesh"):
        name, scene = wanted[k]
        solution = model.solve(model.touched(scene))
        seen: set[tuple[float, float]] = set()
        for turn, to in eight if name.startswith("ldci") else eight[:1]:
            # current that entered at electrode i enters at to[i]: read the old solution through the inverse
            back = np.argsort(to)
            moved = [replace(s, x=x, y=y) for s in scene for x, y in [turn @ (s.x, s.y)]]
            place = (round(moved[0].x, 6) + 0.0, round(moved[0].y, 6) + 0.0)
            if place in seen:
                continue
            seen.add(place)
            z = [np.abs(solution.impedances(back[pattern])) for pattern in (pair, adjacent)]
            rows.append((name, to_rows(moved, MOST), z[0], z[1]))
        if k % 10 == 9 or k == len(wanted) - 1:
            group, shapes, pairs, adjacents = (np.array([r[i] for r in rows]) for i in range(4))
            partial = path.with_suffix(".part.npz")
            np.savez(partial, group=group, shapes=shapes, pairs=pairs, adjacent=adjacents, done=k + 1)
            os.replace(partial, path)
    group, shapes, pairs, adjacents = (np.array([r[i] for r in rows]) for i in range(4))
    n = len(rows)
    return Frames(group, shapes, pairs, np.tile(z0, (n, 1)), adjacents, np.tile(a0, (n, 1)))


def load(
    seed: int = 5, n: int = 20, mesh: str = "reference", only: tuple[str, ...] = (), singles: int | None = None
) -> Frames:
    """Frames by arguments: read from bench/work, or solved now (about 3.5 n + 6 singles + 40 solutions). EIDORS's come
    last.

    mesh: "reference" (seconds a solution) or "stub" (quick; as far from the training mesh as from the reference).
    only: some groups, without EIDORS's.
    """
    if mesh == "training":
        raise ValueError("test frames on the training mesh would flatter whatever was trained on it")
    WORK.mkdir(exist_ok=True)
    wanted = [s for s in scenes(seed, n, singles) if not only or s[0] in only]
    many = f"-singles{singles}" if singles else ""
    frames = _solve(wanted, mesh, WORK / f"frames4-{'-'.join((mesh, *only))}-seed{seed}-n{n}{many}.npz")
    if only:
        return frames
    frames = _ordered(frames)
    return frames + eidors() if EIDORS.exists() else frames


def _ordered(frames: Frames) -> Frames:
    """The LDCI groups in the paper's order, so that number 25 is the centre."""
    order: list[int] = list(np.flatnonzero(~np.char.startswith(frames.group, "ldci")))
    for spacing, drop in LDCI:
        index = frames.of(f"ldci-{spacing}-{drop}")
        places = frames.shapes[index, 0, 1:3]
        for place in metrics.ldci_positions(spacing):
            order.append(int(index[np.linalg.norm(places - place, axis=1).argmin()]))
    return frames.part(order)


def eidors() -> Frames:
    """The single touches of the EIDORS scenes; their untouched frame is A0."""
    with np.load(EIDORS) as file:
        one = np.flatnonzero(np.isfinite(file["shapes"][:, 0, 0]) & ~np.isfinite(file["shapes"][:, 1, 0]))
        pairs, adjacent, shapes = np.abs(file["impedance_pairs"]), np.abs(file["impedance_adjacent"]), file["shapes"]
    n = len(one)
    rows = np.array([to_rows(from_rows(shapes[k]), MOST) for k in one])
    untouched = np.tile(pairs[0], (n, 1)), np.tile(adjacent[0], (n, 1))
    return Frames(np.full(n, "eidors"), rows, pairs[one], untouched[0], adjacent[one], untouched[1])


@dataclass(frozen=True)
class Level:
    """A noise level by name: "none", "70" (dB: relative to each |Z|) or "70f" (fixed).

    Fixed is the noise of a converter, the same ohm on every measurement of either pattern: so many dB under the root
    mean square |Z| of `pairs`. It matters when patterns are compared: relative noise favours `adjacent`, whose voltages
    are tiny and would, as no converter does, have tiny noise.
    """

    name: str

    @property
    def title(self) -> str:
        if self.name == "none":
            return "noise-free"
        return f"{self.name[:-1]} dB, fixed in ohm" if self.fixed else f"{self.name} dB"

    @property
    def fixed(self) -> bool:
        return self.name.endswith("f")

    @property
    def share(self) -> float:
        return NOISE_FREE if self.name == "none" else float(10 ** (-float(self.name.rstrip("f")) / 20))

    def parts(self, pairs0: Array) -> tuple[float, float]:
        """(relative, floor in ohm)."""
        return (0.0, self.share * float(np.sqrt((pairs0**2).mean()))) if self.fixed else (self.share, 0.0)

    def sigma(self, z: Array, pairs0: Array) -> Array:
        relative, floor = self.parts(pairs0)
        return np.asarray(np.sqrt((relative * z) ** 2 + floor**2))


def noisy(frames: Frames, level: str, seed: int = 0, tare: int = 64) -> tuple[Frames, Array]:
    """Frames with noise on each measurement and on the mean of `tare` untouched frames.

    Also the untouched frames themselves, (tare, 120), of the first frame's skin. "none" leaves what a float32 wire
    does.
    """
    noise, pairs0, adjacent0 = Level(level), frames.pairs0[0], frames.adjacent0[0]
    rng = np.random.default_rng([seed, *level.encode()])
    untouched = pairs0 + noise.sigma(pairs0, pairs0) * rng.standard_normal((tare, len(pairs0)))
    # one tare for all frames of a skin, as on a bench: the mean of the untouched frames just drawn
    gain = untouched.mean(0) / pairs0
    spread = noise.sigma(adjacent0, pairs0) / adjacent0 / np.sqrt(tare)
    gain_adjacent = 1 + spread * rng.standard_normal(len(adjacent0))
    return replace(
        frames,
        pairs=frames.pairs + noise.sigma(frames.pairs, pairs0) * rng.standard_normal(frames.pairs.shape),
        pairs0=frames.pairs0 * gain,
        adjacent=frames.adjacent + noise.sigma(frames.adjacent, pairs0) * rng.standard_normal(frames.adjacent.shape),
        adjacent0=frames.adjacent0 * gain_adjacent,
    ), untouched
