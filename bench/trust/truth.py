"""What really touches at any instant of a session, without what its world hides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.trust.scene import TrustScene
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import TouchPath
from firmware_stub.world import Touch

LIGHTEST = 1e-6  # S/m: less is nothing
WAY = 5  # instants at which a way is looked at


@dataclass(frozen=True)
class Pressed:
    """One touch at one instant. x, y: of its patch's centroid [m]; full: share of its greatest drop."""

    number: int
    x: float
    y: float
    force_n: float
    full: float


class TruePath:
    """One touch from its beginning to its end."""

    def __init__(self, number: int, path: TouchPath, sheet: Sheet) -> None:
        self.number, self.path = number, path
        self.begin, self.end = path.times[0], path.times[-1]
        self.most = max(pose.drop for pose in path.poses)
        self.up = path.times[1] - path.times[0]
        self.down = path.times[-1] - path.times[-2]
        shape, scale = sheet.shape(path.poses[1]), sheet.skin.metres_per_unit
        self._off = shape.centroid * scale - np.array([path.poses[1].x, path.poses[1].y])

    def at(self, t: float) -> Pressed | None:
        pose = self.path.pose(t, t)
        if pose is None or pose.drop < LIGHTEST:
            return None
        x, y = pose.x + self._off[0], pose.y + self._off[1]
        return Pressed(self.number, float(x), float(y), pose.force_n, pose.drop / self.most)

    def phase(self, t: float, span_s: float) -> str:
        """begin: until a scan after its force has risen; slide: while it moves; end: while its force falls."""
        if t < self.begin + self.up + span_s:
            return "begin"
        if t > self.end - self.down - span_s / 2:
            return "end"
        return "slide" if self._moves(t) else "hold"

    def _moves(self, t: float) -> bool:
        a, b = self.path.pose(t - 1e-3, t), self.path.pose(t + 1e-3, t)
        return a is not None and b is not None and float(np.hypot(a.x - b.x, a.y - b.y)) > 1e-9

    @cached_property
    def peak(self) -> Touch:
        return max(self.path.poses, key=lambda pose: pose.drop)


class SceneTruth:
    """Of one session."""

    def __init__(self, scene: TrustScene, sheet: Sheet) -> None:
        self.scene = scene
        self.paths = [TruePath(n, path, sheet) for n, path in enumerate(scene.script.tracks)]

    def around(self, begin: float, end: float) -> list[TruePath]:
        return [path for path in self.paths if path.begin < end and path.end > begin]

    def at(self, t: float) -> list[Pressed]:
        return [there for path in self.around(t - 1e-9, t + 1e-9) if (there := path.at(t)) is not None]

    def way(self, begin: float, end: float) -> list[Pressed]:
        """Where touches were at some instants of a stretch of time."""
        instants = np.linspace(begin, end, WAY).tolist()
        near = self.around(begin, end)
        return [there for t in instants for path in near if (there := path.at(t)) is not None]

    def nothing_wrong(self, t: float, recovers_s: float) -> bool:
        return not any(each.begin <= t <= each.end + recovers_s for each in self.scene.troubles if each.what != "none")
