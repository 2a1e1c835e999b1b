"""What really touches at any instant, and what of a contact frame is wrong beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_stub.sheet import Sheet
from firmware_stub.timeline import TouchPath
from protocol.frames import Contact, ContactFrame

SCAN_S = 0.0436  # a whole scan of the board: what a frame stands on is at most so old
FAR_M = 0.015  # from every touch: a contact is a phantom; from every contact: a touch is not shown
FULL = 0.9  # of its greatest drop: a touch presses fully
LIGHTEST = 1e-6  # S/m: less is nothing
WAY = 5  # instants at which a way is looked at
GONE_S = 1e-3  # of simulated time by which the board's clock and ours may differ


@dataclass(frozen=True)
class Pressed:
    """One touch at one instant. x, y: of its patch's centroid [m]; full: share of its greatest drop."""

    number: int
    x: float
    y: float
    force_n: float
    full: float

    def far(self, contact: Contact) -> float:
        return float(np.hypot(contact.on_sheet[0] - self.x, contact.on_sheet[1] - self.y))


class TruePath:
    """One touch from its beginning to its end."""

    def __init__(self, number: int, path: TouchPath, sheet: Sheet | None = None) -> None:
        """sheet: that says where a patch has its centroid; None: a disc's is its centre."""
        self.number, self.path = number, path
        self.begin, self.end = path.times[0], path.times[-1]
        self.most = max(pose.drop for pose in path.poses)
        self.up = path.times[1] - path.times[0] if path.poses[0].drop < LIGHTEST else 0.0
        self.down = path.times[-1] - path.times[-2] if path.poses[-1].drop < LIGHTEST else 0.0
        self._off = np.zeros(2)
        if sheet is not None:
            pose = path.poses[min(1, len(path.poses) - 1)]
            self._off = sheet.shape(pose).centroid * sheet.skin.metres_per_unit - np.array([pose.x, pose.y])

    def at(self, t: float) -> Pressed | None:
        pose = self.path.pose(t, t)
        if pose is None or pose.drop < LIGHTEST:
            return None
        x, y = pose.x + self._off[0], pose.y + self._off[1]
        return Pressed(self.number, float(x), float(y), pose.force_n, pose.drop / self.most)

    def fully(self, *instants: float) -> bool:
        """Whether it presses fully at each."""
        return all((there := self.at(t)) is not None and there.full >= FULL for t in instants)

    def phase(self, t: float, span_s: float = SCAN_S) -> str:
        """begin: until a scan after its force has risen; slide: while it moves; end: while its force falls."""
        if t < self.begin + self.up + span_s:
            return "begin"
        if t > self.end - self.down - span_s / 2:
            return "end"
        return "slide" if self._moves(t) else "hold"

    def _moves(self, t: float) -> bool:
        a, b = self.path.pose(t - 1e-3, t), self.path.pose(t + 1e-3, t)
        return a is not None and b is not None and float(np.hypot(a.x - b.x, a.y - b.y)) > 1e-9


class TruePaths:
    """All that touches in a script."""

    def __init__(self, tracks: Sequence[TouchPath], sheet: Sheet | None = None) -> None:
        self.paths = [TruePath(n, path, sheet) for n, path in enumerate(tracks)]

    def around(self, begin: float, end: float) -> list[TruePath]:
        return [path for path in self.paths if path.begin < end and path.end > begin]

    def at(self, t: float) -> list[Pressed]:
        return [there for path in self.around(t - 1e-9, t + 1e-9) if (there := path.at(t)) is not None]

    def way(self, begin: float, end: float) -> list[Pressed]:
        """Where touches were at some instants of a stretch of time."""
        near, instants = self.around(begin, end), np.linspace(begin, end, WAY).tolist()
        return [there for t in instants for path in near if (there := path.at(t)) is not None]


def nearest(contact: Contact, touches: Sequence[Pressed]) -> float:
    """Metres to the nearest of them."""
    return min((there.far(contact) for there in touches), default=np.inf)


def unshown(there: Pressed, contacts: Sequence[Contact]) -> bool:
    return min((there.far(contact) for contact in contacts), default=np.inf) > FAR_M


@dataclass(frozen=True)
class WrongFrame:
    """What one valid frame says that is not so."""

    at_s: float
    what: str
    frame: ContactFrame

    def __str__(self) -> str:
        shown = [(c.id, c.state, np.round(c.position[:2], 3).tolist(), c.force_n) for c in self.frame.contacts]
        return f"{self.at_s:.4f} s, part {self.frame.part}: {self.what}; {self.frame.reasons} {shown}"


def lasting(frame: ContactFrame) -> list[Contact]:
    return [contact for contact in frame.contacts if contact.state != "end"]


def what_is_wrong(at_s: float, frame: ContactFrame, truth: TruePaths, clocks_s: float = GONE_S) -> Iterator[WrongFrame]:
    """What a valid frame shows of what is not there, and hides of what is. It is judged by its own `sample`, with the
    whole scan about it in doubt. clocks_s: by which `sample` may be off.
    """
    middle, shown = frame.stamps["sample"] * 1e-9, lasting(frame)
    first, last = middle - SCAN_S - clocks_s, middle + SCAN_S / 2 + clocks_s
    may = truth.way(first, last)
    for contact in shown:
        if nearest(contact, may) > FAR_M:
            yield WrongFrame(at_s, f"{contact.force_n} N at {contact.position[:2]}, where nothing is", frame)
    for path in truth.around(middle, middle + 1e-9):
        there = path.at(middle)
        if there is not None and path.fully(first, middle, last) and unshown(there, shown):
            yield WrongFrame(at_s, f"nothing at ({there.x:g}, {there.y:g}), where {there.force_n:g} N are", frame)
