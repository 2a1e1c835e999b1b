"""Touches, places and scripts of the reliability benchmarks, and the stub's sheet with a memory.

Every impedance comes from the stub's mesh, which neither training nor inverse uses. A solve costs 10 ms; what was
solved is kept in bench/work, by a hash of the code that solves.
"""

from __future__ import annotations

import contextlib
import hashlib
import os

import numpy as np
from numpy.typing import NDArray

from bench import ROOT
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Cue, PiecewiseLinear, Script, TouchPath
from firmware_stub.world import Touch, World, pressed

WORK = ROOT / "bench" / "work" / "reliability"
SOLVED_BY = (
    *(f"firmware_stub/{name}.py" for name in ("sheet", "world")),
    *(f"models/{name}.py" for name in ("elements", "forward", "geometry", "meshing", "shapes")),
    "models/skins/square16.toml",
)
METRES = 0.05  # per model unit of square16
MOST_FILES = 64  # of what was solved; then they are gathered in one
RAMP_S = 0.1  # a finger's
PLACE_M = 0.04  # how far from the centre the matrix presses, along each axis

Matrix = NDArray[np.float64]


class SolvedSheet(Sheet):
    """The stub's sheet; each world is solved once. keep: what was solved survives the process."""

    def __init__(self, keep: bool = True) -> None:
        super().__init__("square16")
        self.solves = 0
        self._keep, self._code = keep, _code()
        self._known: dict[str, Matrix] = {}
        self._fresh: dict[str, Matrix] = {}
        files = sorted(WORK.glob(f"{self._code}-*.npz")) if keep else []
        for path in files:
            with contextlib.suppress(FileNotFoundError), np.load(path) as kept:  # another process may gather them
                self._known |= dict(zip(kept["worlds"].tolist(), kept["transfer"], strict=True))
        if len(files) > MOST_FILES:
            self._write(self._known)
            for path in files:
                path.unlink(missing_ok=True)

    def transfer(self, world: World) -> Matrix:
        touches = tuple(touch for touch in world.touches if touch.drop > 0)
        key = repr(World(touches, world.background, world.contact).rounded())
        if key not in self._known:
            self._known[key] = self._fresh[key] = super().transfer(world)
            self.solves += 1
        return self._known[key]

    def close(self, least: int = 1) -> None:
        """Write what is new, if it is to be kept and at least so many. Solutions of other code are removed."""
        if not self._keep or len(self._fresh) < least:
            return
        for old in WORK.glob("*.npz"):
            if not old.name.startswith(self._code):
                old.unlink(missing_ok=True)
        self._write(self._fresh)
        self._fresh = {}

    def _write(self, solved: dict[str, Matrix]) -> None:
        WORK.mkdir(parents=True, exist_ok=True)
        name = hashlib.sha256("".join(solved).encode()).hexdigest()[:16]
        part = WORK / f"part-{os.getpid()}"
        with part.open("wb") as file:
            np.savez_compressed(file, worlds=np.array(list(solved)), transfer=np.array(list(solved.values())))
        part.replace(WORK / f"{self._code}-{name}.npz")

    def impedances(self, world: World, pattern: NDArray[np.integer]) -> NDArray[np.float64]:
        """(K,) |Z| ohm, free of noise."""
        t = self.transfer(world)
        dp, dm, sp, sm = np.asarray(pattern).T
        return np.asarray(np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm]))


def circle(x: float, y: float, newtons: float, radius: float) -> Touch:
    """x, y in metres, radius in model units."""
    return pressed("circle", x, y, radius * METRES, newtons)


def press(
    touch: Touch, begin: float, end: float, to: tuple[float, float] | None = None, ramp: float = RAMP_S
) -> TouchPath:
    """A press from begin to end, its ramps included; it slides to the point `to` in between."""
    x, y = to or (touch.x, touch.y)
    poses = (
        Touch(touch.kind, touch.x, touch.y, touch.radius, 0.0),
        touch,
        Touch(touch.kind, x, y, touch.radius, touch.drop),
        Touch(touch.kind, x, y, touch.radius, 0.0),
    )
    return TouchPath((begin, begin + ramp, end - ramp, end), poses)


def script(
    tracks: tuple[TouchPath, ...] = (),
    cues: tuple[Cue, ...] = (),
    contact: tuple[tuple[int | None, PiecewiseLinear], ...] = (),
    background: PiecewiseLinear | None = None,
) -> Script:
    return Script("reliability", tracks=tracks, cues=cues, contact=contact, background=background)


def touches_at_random(count: int, seed: int, side_m: float = PLACE_M) -> list[Touch]:
    """Touches of 1 to 5 N and radius 0.1 to 0.3, spread over the skin."""
    rng = np.random.default_rng([seed, 12])
    made = []
    for k in range(count):
        x, y = (2 * _halton(k + 1, base) - 1 for base in (2, 3))
        made.append(circle(side_m * x, side_m * y, float(rng.uniform(1, 5)), float(rng.uniform(0.1, 0.3))))
    return made


def grid(per_side: int, spacing: float = 0.2) -> list[tuple[float, float]]:
    """per_side x per_side places [m], the paper's spacing of 0.2 model units for 7; others cover the same square."""
    half = 3 * spacing * METRES
    line = np.linspace(-half, half, per_side)
    return [(float(x), float(y)) for y in line[::-1] for x in line]


def contacts_at_random(rng: np.random.Generator, spread: float, electrodes: int = 16) -> tuple[float, ...]:
    """Factors on the contact impedances, each within +-spread."""
    return tuple(float(v) for v in rng.uniform(1 - spread, 1 + spread, electrodes))


def _halton(k: int, base: int) -> float:
    """The k-th of a sequence that fills 0 to 1 evenly."""
    value, step = 0.0, 1.0 / base
    while k:
        value, k, step = value + step * (k % base), k // base, step / base
    return value


def _code() -> str:
    digest = hashlib.sha256()
    for name in SOLVED_BY:
        digest.update((ROOT / name).read_bytes())
    return digest.hexdigest()[:16]
