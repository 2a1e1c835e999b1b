"""What the reaction benchmark does to the skin, as a scene of known times, and the score of the frames that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from protocol.frames import Contact, ContactFrame

SIDE_M = 0.1  # of the square skin
UNIT_M = SIDE_M / 2  # metres of a model unit
NEAR = 0.03  # of the side: a contact so near is in its place
SIGMAS = 3.0
DOUBTFUL = ("changing", "coarse")
FIRST_S = 1.0
STEPS_TO_RECV = ("sample", "read", "preprocess", "infer", "publish")
"""Stamps of a frame, in the order in which they are set; `sample` is the middle of what was measured. A part goes to
the publisher without inference, which takes no time of it.
"""


@dataclass(frozen=True)
class Kind:
    """A sort of event. radius: in model units, from and to; ramp_s: of force, at both ends; touches: that begin and end
    at once, APART_M or more from middle to middle.
    """

    name: str
    force: float
    radius: tuple[float, float]
    ramp_s: float = 0.0
    speed: float = 0.0  # m/s
    touches: int = 1


KINDS = (
    Kind("2 N, radius 0.1 to 0.2", 2.0, (0.1, 0.2)),
    Kind("1 N, radius 0.1", 1.0, (0.1, 0.1)),
    Kind("2 N over 20 ms", 2.0, (0.1, 0.2), ramp_s=0.02),
    Kind("2 N over 50 ms", 2.0, (0.1, 0.2), ramp_s=0.05),
    Kind("sliding at 0.1 m/s", 2.0, (0.2, 0.2), speed=0.1),
    Kind("sliding at 0.3 m/s", 2.0, (0.2, 0.2), speed=0.3),
    Kind("two of 2 N at once", 2.0, (0.1, 0.2), touches=2),
    Kind("three of 2 N at once", 2.0, (0.1, 0.2), touches=3),
)
SLIDE_M = 0.05
APART_M = 0.03  # at least, from middle to middle of touches that begin at once
HELD_S = 0.15  # from its onset on, after which a step is held
SETTLED_S = 0.2  # a sliding touch stays still for so long before it moves


@dataclass(frozen=True)
class TouchEvent:
    """One touch, or several at once: from `onset` s of the scene, when force leaves zero, to `end`, when it is back at
    zero. It moves from `moves` on, along `velocity` [m/s], until it ends. others: x, y of those beside it, which hold
    still.
    """

    kind: Kind
    onset: float
    end: float
    x: float
    y: float
    radius_m: float
    moves: float
    velocity: tuple[float, float] = (0.0, 0.0)
    others: tuple[tuple[float, float], ...] = ()

    def places(self, t: float) -> list[tuple[float, float]]:
        """Of all of its touches."""
        return [self.at(t), *self.others]

    def at(self, t: float) -> tuple[float, float]:
        since = max(0.0, min(t, self.end) - self.moves)
        return self.x + since * self.velocity[0], self.y + since * self.velocity[1]

    @property
    def released(self) -> float:
        """When force begins to fall."""
        return self.end - self.kind.ramp_s

    @property
    def keys(self) -> list[tuple[float, float, float, float]]:
        """(t, x, y, force), as in a scene."""
        ramp, times = self.kind.ramp_s, [(self.onset, self.kind.force), (self.end, self.kind.force)]
        if ramp:
            times = [
                (self.onset, 0.0),
                (self.onset + ramp, self.kind.force),
                (self.end - ramp, self.kind.force),
                (self.end, 0.0),
            ]
        if self.kind.speed:
            times.insert(1, (self.moves, self.kind.force))
        return [(t, *self.at(t), force) for t, force in times]


def events(counts: dict[str, int], pause_s: float, seed: int) -> list[TouchEvent]:
    """So many of each kind of KINDS, in random order, places and phases of the scan; pause_s: between two of them."""
    rng = np.random.default_rng([seed, 15])
    kinds = [kind for kind in KINDS for _ in range(counts.get(kind.name, 0))]
    t, made = FIRST_S, []
    for k in rng.permutation(len(kinds)):
        kind = kinds[k]
        radius = float(rng.uniform(*kind.radius)) * UNIT_M
        t = round(t + pause_s + float(rng.uniform(0.0, 0.2)), 6)
        half = SIDE_M / 2 - radius
        x, y = rng.uniform(-half, half, 2).tolist()
        held, velocity, moves = 0.3 + float(rng.uniform(0.0, 0.1)) + 2 * kind.ramp_s, (0.0, 0.0), np.inf
        if kind.speed:
            angle = float(rng.uniform(-np.pi, np.pi))
            along = np.array([np.cos(angle), np.sin(angle)])
            middle = rng.uniform(-1, 1, 2) * np.maximum(half - np.abs(along) * SLIDE_M / 2, 0.0)
            x, y = (middle - along * SLIDE_M / 2).tolist()
            velocity = (float(along[0]) * kind.speed, float(along[1]) * kind.speed)
            held, moves = SETTLED_S + SLIDE_M / kind.speed, round(t + SETTLED_S, 6)
        others = _beside((x, y), kind.touches - 1, half, rng)
        made.append(TouchEvent(kind, t, round(t + held, 6), x, y, radius, moves, velocity, others))
        t = made[-1].end
    return made


def _beside(
    first: tuple[float, float], count: int, half: float, rng: np.random.Generator
) -> tuple[tuple[float, float], ...]:
    """So many places more, each APART_M from the others."""
    places = [first]
    while len(places) <= count:
        x, y = rng.uniform(-half, half, 2).tolist()
        if all(np.hypot(x - px, y - py) >= APART_M for px, py in places):
            places.append((x, y))
    return tuple(places[1:])


def scene(of: Sequence[TouchEvent]) -> str:
    """The events as a scene's TOML."""
    parts = [f'about = "the reaction benchmark\'s touches"\nduration = {of[-1].end + 1.0}']
    for event in of:
        beside = [[(t, x, y, force) for t, _, _, force in event.keys] for x, y in event.others]
        for track in (event.keys, *beside):
            keys = ", ".join(f"{{ t = {t!r}, x = {x!r}, y = {y!r}, force = {f!r} }}" for t, x, y, f in track)
            parts.append(f"[[touch]]\nradius = {event.radius_m!r}\nkeys = [{keys}]")
    return "\n".join(parts) + "\n"


@dataclass
class Reaction:
    """What a controller saw of one event; times in s after force left zero, or came back to it. NaN: never."""

    contact_s: float = np.nan  # the first of the valid frames that are all in place until the release
    near_s: float = np.nan  # the first valid frame with a contact in its place, changing and coarse ones included
    gone_s: float = np.nan  # the first of the valid frames without it, after the release
    wrong: int = 0  # valid frames before `contact_s` that are off by more than 3 of their own standard deviations
    late: int = 0  # frames that say so, from the onset until the next touch
    errors_m: list[float] = field(default_factory=list)  # of valid frames in place, while moving: against recv
    held_m: list[float] = field(default_factory=list)  # while the touch holds still: how far off valid contacts are
    held_force: list[float] = field(default_factory=list)  # relative error of their force
    near_after_s: list[float] = field(default_factory=list)  # of `near_s`, to each of STEPS_TO_RECV


@dataclass(frozen=True)
class SeenFrame:
    """A contact frame: when it was received, and the time that it stands for; s of the scene."""

    received: float
    sampled: float
    frame: ContactFrame

    @property
    def present(self) -> list[Contact]:
        """The contacts of a valid frame; none of another."""
        return [contact for contact in self.frame.contacts if contact.state != "end" and self.frame.valid]

    @property
    def doubtful(self) -> bool:
        return bool(set(DOUBTFUL) & set(self.frame.reasons))

    def after(self, onset: float) -> list[float]:
        """[s] from an onset to each of STEPS_TO_RECV; empty where no stage set its stamp."""
        stamps = self.frame.stamps
        if "publish" not in stamps:
            return []
        stamps = {"infer": stamps["preprocess"], **stamps}
        scene_s = self.sampled - stamps["sample"] * 1e-9  # from the stamps' clock to the scene's
        return [stamps[step] * 1e-9 + scene_s - onset for step in STEPS_TO_RECV]

    def off(self, contact: Contact, event: TouchEvent) -> float:
        """Metres from where the nearest touch was at the time that the frame stands for."""
        return min(self._distances(contact, event))

    def _distances(self, contact: Contact, event: TouchEvent) -> list[float]:
        places = event.places(max(self.sampled, event.onset))
        return [float(np.hypot(*np.subtract(contact.on_sheet, place))) for place in places]

    def near(self, event: TouchEvent) -> bool:
        """Valid, and a contact where each touch is."""
        distances = [self._distances(contact, event) for contact in self.present]
        return bool(distances) and all(min(of_place) <= NEAR * SIDE_M for of_place in zip(*distances, strict=True))

    def in_place(self, event: TouchEvent) -> bool:
        """Valid, not doubtful, and one contact where each touch is."""
        return self.near(event) and len(self.present) == event.kind.touches and not self.doubtful


def react(event: TouchEvent, until: float, frames: Sequence[SeenFrame]) -> Reaction:
    """frames: in order, from the event's onset to `until`, when the next touch begins or the scene ends."""
    found = Reaction(late=sum("late" in seen.frame.reasons for seen in frames))
    during = [seen for seen in frames if event.onset <= seen.received < event.released]
    first = _last_run([seen.in_place(event) for seen in during])
    if first < len(during):
        found.contact_s = during[first].received - event.onset
    if near := next((seen for seen in during if seen.near(event)), None):
        found.near_s = near.received - event.onset
        found.near_after_s = near.after(event.onset)
    for seen in during[:first]:
        for contact in seen.present:
            off = seen.off(contact, event)
            if contact.position_sigma is not None:
                found.wrong += off > SIGMAS * max(contact.position_sigma[:2])
    after = [seen for seen in frames if event.released <= seen.received < until]
    free = _last_run([seen.frame.valid and not seen.present for seen in after])
    if free < len(after):
        found.gone_s = max(0.0, after[free].received - event.end)  # of a force that fades, the end may show before
    for seen in during:
        if event.others or len(seen.present) != 1:
            continue
        if seen.received > event.moves:
            (contact,) = seen.present
            found.errors_m.append(float(np.hypot(*np.subtract(contact.on_sheet, event.at(seen.received)))))
        elif seen.received > event.onset + HELD_S and not event.kind.ramp_s:
            (contact,) = seen.present
            found.held_m.append(seen.off(contact, event))
            found.held_force.append(abs((contact.force_n or 0.0) / event.kind.force - 1.0))
    return found


def _last_run(good: Sequence[bool]) -> int:
    """Where the run of True that lasts to the end begins; the length where there is none."""
    first = len(good)
    while first and good[first - 1]:
        first -= 1
    return first
