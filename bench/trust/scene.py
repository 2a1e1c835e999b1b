"""One session, drawn from a seed: what touches the skin when, which faults it meets, when a person tares it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from firmware_stub import scene as scenes
from firmware_stub.faults import MUXES
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Cue, PiecewiseLinear, Script, TouchPath
from firmware_stub.world import Touch, World
from simulation.faults import row_of
from simulation.scenes import JUMP_S, ramp, step

TARE_S = 5.0  # nothing touches and nothing fails before; then a person tares
BEGIN_S = TARE_S + 1.0
APART_M = 0.028  # between the centres of touches that are there at once, at least
GAP_M = 0.003  # between their circles
SHEET_M = 0.0495  # from the centre, along each axis: patches lie within
INSIDE_M = 0.043  # and their centres within that
BESIDE_M = (0.004, 0.01)  # radius of a touch on an electrode
RADIUS_M = (0.004, 0.025)
FORCE_N = (0.3, 8.0)
RAMP_S = (0.005, 0.2)
MOMENTS_S = 0.1  # within which touches of an event begin, and end
SEEN_SIGMA = 15.0  # a touch changes a scan by this many times its noise, or it is drawn anew
NOISE = 1e-4  # relative, of 80 dB
COUNTS = (0.0, 0.6, 0.27, 0.13)  # chances of so many touches in an event
SHAPES = ("triangle", "rectangle", "L", "ellipse")
FAULTS, LINKS, TARES = 0.25, 0.15, 0.1  # shares of events with one
SITUATIONS = ("untouched", "held", "sliding", "begins", "electrode", "two")
RECOVERS_S = 3.0  # after a fault: until then nothing counts as a frame with nothing wrong
TRIES = 200


@dataclass(frozen=True)
class Trouble:
    """A fault, or what happens to messages, from `begin` to `end` [s]. names: reasons of a frame that name it within
    `within_s`; board: what acquisition says of the board does too; neither: nobody needs to. recovers_s: after its end,
    within which frames are to be valid again.
    """

    what: str
    situation: str
    begin: float
    end: float
    names: tuple[str, ...] = ()
    within_s: float = 0.2
    board: bool = False
    recovers_s: float | None = None

    @property
    def nameable(self) -> bool:
        return bool(self.names) or self.board


@dataclass(frozen=True)
class TrustScene:
    """Times are seconds of the session. acts: (when, what is done to the stages), see stages.ACTS. begin: from when on
    frames are judged.
    """

    seconds: float
    script: Script
    troubles: tuple[Trouble, ...] = ()
    acts: tuple[tuple[float, str], ...] = ()
    begin: float = BEGIN_S - 0.5

    def nothing_wrong(self, t: float) -> bool:
        return not any(each.begin <= t <= each.end + RECOVERS_S for each in self.troubles if each.what != "none")


class SceneDrawer:
    """Draws the events of one session one after the other."""

    def __init__(self, sheet: Sheet, seed: int, seconds: float, apart_m: float = APART_M) -> None:
        self.sheet, self.seconds, self.apart_m = sheet, seconds, apart_m
        self.rng = np.random.default_rng([seed, 47])
        self.t = BEGIN_S
        self.tracks: list[TouchPath] = []
        self.cues: list[Cue] = []
        self.contacts: list[tuple[int | None, PiecewiseLinear]] = []
        self.troubles: list[Trouble] = []
        self.tares = [TARE_S]

    def draw(self) -> TrustScene:
        while self.t < self.seconds - 1.5:
            self.t += 0.3 + float(self.rng.exponential(0.8))
            kind = self.rng.random()
            if kind < FAULTS:
                self._with_fault(SITUATIONS[self.rng.integers(len(SITUATIONS))])
            else:
                begin = self.t
                touches = self._touches(int(self.rng.choice(len(COUNTS), p=COUNTS)))
                self.t = self._press(touches, begin, self._lasts(), bool(self.rng.random() < 0.3))
                if kind < FAULTS + LINKS:
                    self._link(begin, self.t)
                elif kind < FAULTS + LINKS + TARES:
                    self.tares.append(float(self.rng.uniform(begin, self.t + 0.5)))
        script = Script("trust", tracks=tuple(self.tracks), cues=tuple(self.cues), contact=tuple(self.contacts))
        tares = tuple((t, "tare") for t in self.tares if t < self.seconds)  # whether something touches or not
        return TrustScene(self.seconds, script, tuple(self.troubles), tares)

    # --- touches ---

    @cached_property
    def _untouched(self) -> np.ndarray:
        return self.sheet.model.read(self.sheet.transfer(World()))

    def _touch(self, others: Sequence[Touch] = (), electrode: int | None = None) -> Touch | None:
        """One that a scan shows, with its patch on the sheet and clear of others. Two thirds are discs. electrode: as
        near to that one as it may be. None where there is no room.
        """
        for _ in range(TRIES):
            values: dict[str, object] = {"rotation": float(self.rng.uniform(0, 2 * np.pi))}
            radius = float(self.rng.uniform(*RADIUS_M) if electrode is None else self.rng.uniform(*BESIDE_M))
            x, y = self._place(radius, electrode)
            values |= {"x": x, "y": y, "radius": radius, "force": float(np.exp(self.rng.uniform(*np.log(FORCE_N))))}
            if self.rng.random() < 1 / 3:
                values["shape"] = SHAPES[self.rng.integers(len(SHAPES))]
                values["aspect"] = 2.0 if values["shape"] in ("rectangle", "ellipse") else 1.0
            if any(np.hypot(x - o.x, y - o.y) < self._apart(radius, o) for o in others):
                continue
            try:
                touch = scenes.touch(values)
            except ValueError:  # a force that this patch cannot bear
                continue
            change = self.sheet.model.read(self.sheet.transfer(World((touch,)))) / self._untouched - 1
            if np.linalg.norm(change) >= SEEN_SIGMA * NOISE:
                return touch
        return None

    def _place(self, radius: float, electrode: int | None) -> tuple[float, float]:
        most = min(INSIDE_M, SHEET_M - radius)
        if electrode is None:
            return float(self.rng.uniform(-most, most)), float(self.rng.uniform(-most, most))
        skin = self.sheet.skin
        x, y = (skin.point(skin.electrodes[[electrode]])[0] * skin.metres_per_unit).clip(-most, most)
        return float(x), float(y)

    def _apart(self, radius: float, other: Touch) -> float:
        return max(self.apart_m, radius + other.radius + GAP_M)

    def _touches(self, count: int) -> list[Touch]:
        found: list[Touch] = []
        for _ in range(count):
            if (touch := self._touch(found)) is not None:
                found.append(touch)
        return found

    def _lasts(self) -> float:
        """Seconds of an event: most are short, one in twelve is held for up to a minute."""
        longest = 60.0 if self.rng.random() < 1 / 12 else 6.0
        lasts = float(np.exp(self.rng.uniform(np.log(0.4), np.log(longest))))
        return min(lasts, max(0.4, self.seconds - self.t - 1.0))

    def _press(self, touches: list[Touch], at: float, lasts: float, slides: bool) -> float:
        """The touches within moments of each other, the first of which may slide; returns when the last has ended."""
        last = at
        for n, touch in enumerate(touches):
            begin = at + float(self.rng.uniform(0, MOMENTS_S)) * (n > 0)
            up, down = (float(np.exp(self.rng.uniform(*np.log(RAMP_S)))) for _ in range(2))
            end = max(begin + up + down + 0.1, at + lasts + float(self.rng.uniform(0, MOMENTS_S)))
            none = replace(touch, drop=0.0)
            keys = [(begin, none), (begin + up, touch)]
            if slides and n == 0:
                keys += self._slide(touch, touches[1:], begin + up, end - down)
            there = keys[-1][1]
            keys += [(end - down, there), (end, replace(there, drop=0.0))]
            self.tracks.append(TouchPath(tuple(t for t, _ in keys), tuple(pose for _, pose in keys)))
            last = max(last, end)
        return last

    def _slide(self, touch: Touch, others: list[Touch], begin: float, end: float) -> list[tuple[float, Touch]]:
        """When it begins to slide and when it arrives, at up to 0.3 m/s; nothing where there is no way."""
        for _ in range(TRIES):
            x, y = self._place(touch.radius, None)
            way = float(np.hypot(x - touch.x, y - touch.y))
            seconds = way / float(self.rng.uniform(0.03, 0.3))
            along = [(touch.x + s * (x - touch.x), touch.y + s * (y - touch.y)) for s in np.linspace(0, 1, 20)]
            clear = all(np.hypot(a - o.x, b - o.y) >= self._apart(touch.radius, o) for a, b in along for o in others)
            if way > 0.01 and clear and seconds < end - begin:
                start = begin + float(self.rng.uniform(0, end - begin - seconds))
                return [(start, touch), (start + seconds, replace(touch, x=x, y=y))]
        return []

    # --- what goes wrong ---

    def _with_fault(self, situation: str) -> None:
        at, lasts = self.t, float(self.rng.uniform(0.5, 3.0))
        electrode = int(self.rng.integers(self.sheet.electrodes))
        if situation == "untouched":
            self.t = at + lasts + RECOVERS_S
        else:
            beside = self._touch(electrode=electrode) if situation == "electrode" else None
            touches = [beside] if beside else self._touches(2 if situation == "two" else 1)
            end = self._press(touches, at, 0.8 + lasts + 1.0, situation == "sliding")
            at, self.t = at + (0.0 if situation == "begins" else 0.8), end + RECOVERS_S
        kind = FAULT_KINDS[self.rng.integers(len(FAULT_KINDS))]
        if kind.startswith("impedance"):
            self._impedance(kind, situation, at, lasts, electrode)
        elif kind == "none":
            self.troubles.append(Trouble("none", situation, at, at + lasts))
        else:
            name, args = CUED[kind]
            self._cue(situation, at, lasts, kind, (name,), **args(self.rng, electrode))

    def _cue(self, situation: str, at: float, lasts: float, fault: str, names: tuple[str, ...], **args: object) -> None:
        self.cues.append(Cue(at, fault, args, lasts))
        self.troubles.append(Trouble(fault, situation, at, at + lasts, names))

    def _impedance(self, kind: str, situation: str, at: float, lasts: float, electrode: int) -> None:
        times = float(1.5 * (8 / 1.5) ** self.rng.random())
        if kind == "impedance steps":
            self.contacts.append(step(electrode, times, at + JUMP_S, at + lasts + JUMP_S))
            self.troubles.append(Trouble(kind, situation, at, at + lasts, CONTACT_NAMES))
            return
        rises_s = float(self.rng.uniform(3.0, 10.0))
        end = at + 2 * rises_s
        self.contacts.append((electrode, ramp((at, 1.0), (at + rises_s, times), (end, 1.0))))
        self.troubles.append(Trouble(kind, situation, at, end, CONTACT_NAMES, within_s=rises_s))
        self.t = max(self.t, end + RECOVERS_S)

    def _link(self, begin: float, end: float) -> None:
        """Messages that are lost, late or repeated, at some time in an event."""
        at = float(self.rng.uniform(begin, end))
        what = int(self.rng.integers(4))
        if what == 0:  # an outage
            lasts = float(np.exp(self.rng.uniform(np.log(0.005), np.log(3.0))))
            self._cue("", at, lasts, "sequence_gaps", (), fraction=1.0)
        elif what == 1:
            self._cue("", at, 2.0, "sequence_gaps", (), fraction=float(self.rng.uniform(0.05, 0.5)))
        elif what == 2:
            late = {"fraction": float(self.rng.uniform(0.05, 0.5)), "by": float(self.rng.uniform(0.003, 0.1))}
            self._cue("", at, 2.0, "late_frames", (), **late)
        else:
            self._cue("", at, 2.0, "repeated_frames", (), fraction=float(self.rng.uniform(0.05, 0.5)))


def _stuck_bit(rng: np.random.Generator, electrode: int) -> dict[str, object]:
    bit, value = int(rng.integers(4)), int(rng.integers(2))
    return {"mux": MUXES[rng.integers(4)], "bit": bit, "value": value}


def _another(rng: np.random.Generator, electrode: int) -> dict[str, object]:
    return {"electrodes": [electrode, int((electrode + rng.integers(1, 16)) % 16)]}


CONTACT_NAMES = ("electrode_drift", "electrode_open")
Arguments = Callable[[np.random.Generator, int], dict[str, object]]
CUED: dict[str, tuple[str, Arguments]] = {
    "gain": ("gain", lambda rng, electrode: row_of("gain").draw(rng)),
    "stale_rtia": ("gain", lambda rng, electrode: row_of("stale_rtia").draw(rng)),
    "mux_stuck": ("multiplexer", _stuck_bit),
    "electrode_open": ("electrode_open", lambda rng, electrode: {"electrode": electrode}),
    "electrodes_shorted": ("electrode_short", _another),
    "electrodes_swapped": ("electrode_swapped", _another),
}
FAULT_KINDS = ("impedance steps", "impedance drifts", *CUED, "none")
