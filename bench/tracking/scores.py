"""Contacts against true touches: CLEAR-MOT's matching, and what is counted.

Per frame, pairs of the frame before that are still within the gate stay pairs; the others are matched by least total
distance. An invalid frame is not scored: a controller does not act on it, so it only costs availability.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.tracking.scene import Recorded
from models.metrics import of_side
from protocol.frames import ContactFrame, DeltaFrame

GATE_M = 0.010  # a contact further away matches no true touch
LIGHT_N = 0.5  # a lighter touch may be seen or not
GRACE = 2  # scans a contact may outlast its touch before it counts as false
STEADY = 0.01  # relative change of the force from scan to scan
SETTLED = 3  # scans a touch is there before what is said of it counts as steady, or its absence as wrong
WRONG_M = 0.005  # a valid position that is off by more must not be
TINY = 1e-6  # by which sums of tenths are off
METRES_PER_UNIT = 0.05  # of the skin, for models.metrics


@dataclass(frozen=True)
class StageOutput:
    """What the stages said of one frame. contacts: those that last, each id, x, y [m], force, sigma [N]; scans: how
    many were measured since the frame before, of a part a tenth.
    """

    valid: bool
    reasons: tuple[str, ...]
    electrodes: tuple[int, ...]
    contacts: tuple[tuple[int, float, float, float | None, float | None], ...] = ()
    scans: float = 1.0

    @classmethod
    def of(cls, delta: DeltaFrame, contact: ContactFrame, scans: float = 1.0) -> StageOutput:
        lasting = [c for c in contact.contacts if c.state != "end"]
        rows = tuple((c.id, c.position[0], c.position[1], c.force_n, c.force_sigma_n) for c in lasting)
        return cls(contact.valid, tuple(contact.reasons), tuple(delta.electrodes.tolist()), rows, scans)


@dataclass
class Tally:
    """What was counted in one section of the scene; `all_of` adds sections up."""

    frames: int = 0
    valid: int = 0
    rough: int = 0  # valid frames that say that the touch changed while it was scanned: not scored further
    wrong: int = 0  # valid frames that say something wrong for more than a moment
    touches: int = 0
    unseen: int = 0  # touches never matched, although frames were valid
    switches: int = 0
    false_touches: int = 0
    present: int = 0  # true touches in all frames, from LIGHT_N on
    scored: int = 0  # those in valid frames
    missed: int = 0  # those not matched
    extra: int = 0  # contacts in valid frames that are not matched
    position_m: list[float] = field(default_factory=list)
    force: list[float] = field(default_factory=list)  # relative errors
    steady: list[float] = field(default_factory=list)  # those of settled, unchanging forces
    sigmas: list[float] = field(default_factory=list)  # steady errors in standard uncertainties
    begin: list[float] = field(default_factory=list)  # scans of valid frames from LIGHT_N until matched
    end: list[float] = field(default_factory=list)  # scans a contact outlasts its touch

    def row(self) -> dict[str, Any]:
        """Figures for table and report. None: nothing to count."""
        position = of_side(np.array(self.position_m) / METRES_PER_UNIT)
        steady, force = 100 * np.array(self.steady), 100 * np.array(self.force)
        return {
            "frames": self.frames,
            "touches": self.touches,
            "valid_%": _share(self.valid, self.frames),
            "rough_%": _share(self.rough, self.frames),
            "seen_%": _share(self.scored - self.missed, self.scored),
            "available_%": _share(self.scored - self.missed, self.present),
            "position_%": _quantile(position, 50),
            "position_p95_%": _quantile(position, 95),
            "force_%": _quantile(np.abs(steady), 50),
            "force_p95_%": _quantile(np.abs(steady), 95),
            "force_bias_%": _quantile(steady, 50),
            "force_all_%": _quantile(np.abs(force), 50),
            "force_all_p95_%": _quantile(np.abs(force), 95),
            "within_1_sigma_%": _share(int((np.abs(self.sigmas) <= 1).sum()), len(self.sigmas)),
            "switches": self.switches,
            "false_touches": self.false_touches,
            "unseen": self.unseen,
            "extra_contacts": self.extra,
            "wrong_%": _share(self.wrong, self.valid),
            "mota": None if not self.scored else 1 - (self.missed + self.extra + self.switches) / self.scored,
            "begin_frames": _quantile(np.array(self.begin), 50),
            "begin_most": max(self.begin, default=None),
            "end_frames": _quantile(np.array(self.end), 50),
            "end_most": max(self.end, default=None),
        }


def all_of(tallies: dict[str, Tally]) -> Tally:
    total = Tally()
    for tally in tallies.values():
        for name, value in vars(tally).items():
            setattr(total, name, getattr(total, name) + value)
    return total


@dataclass
class _Touch:
    """One true touch, so far."""

    section: str
    first: int  # frame
    loaded: float | None = None  # scans until it weighed LIGHT_N
    last: int = 0  # frame in which it was there
    force: float = 0.0
    id: int | None = None  # contact it was last matched with
    matched: bool = False  # ever
    waited: float = 0.0  # scans of valid frames with LIGHT_N until then
    missing: float = 0.0  # scans of valid frames in a row


class Scorer:
    """Fed with frame after frame. notes: what went wrong, for a person: (frame, section, text)."""

    def __init__(self, recorded: Recorded) -> None:
        self.recorded = recorded
        self.tallies: dict[str, Tally] = defaultdict(Tally)
        self.notes: list[tuple[int, str, str]] = []
        self._touches: dict[int, _Touch] = {}
        self._pairs: dict[int, int] = {}  # track -> contact id, in the last valid frame
        self._alone: dict[int, float] = {}  # contact id -> scans in a row without a touch
        self._scans = 0.0  # so far
        self._real: dict[int, int] = {}  # contact id -> track it last belonged to

    def add(self, k: int, seen: StageOutput) -> None:
        section = str(self.recorded.sections[k])
        tally = self.tallies[section]
        truth = {int(t["track"]): t for t in self.recorded.truth(k)}
        self._scans += seen.scans
        steady = self._begin(k, section, truth, seen.scans)
        loaded = [n for n, t in truth.items() if t["force"] >= LIGHT_N]
        tally.frames += 1
        tally.present += len(loaded)
        if not seen.valid:
            return
        tally.valid += 1
        if "changing" in seen.reasons:  # it says itself that it knows only roughly where
            tally.rough += 1
            return
        tally.scored += len(loaded)
        pairs = match(truth, seen, self._pairs)
        wrong = [self._pair(k, tally, truth[n], seen.contacts[i], n in steady) for n, i in pairs.items()]
        for n in loaded:
            touch = self._touches[n]
            touch.missing = 0.0 if n in pairs else touch.missing + seen.scans
            touch.waited += seen.scans * (not touch.matched)
            tally.missed += n not in pairs
            wrong.append(touch.missing > SETTLED)
        strangers = [c for i, c in enumerate(seen.contacts) if i not in pairs.values()]
        wrong += [self._extra(k, section, tally, c, seen.scans) for c in strangers]
        there = {c[0] for c in seen.contacts}
        self._alone = {n: count for n, count in self._alone.items() if n in there}
        tally.wrong += any(wrong)
        self._pairs = {n: seen.contacts[i][0] for n, i in pairs.items()}

    def finish(self) -> None:
        """After the last frame."""
        for touch in self._touches.values():
            if not touch.matched and touch.waited >= SETTLED:
                self.tallies[touch.section].unseen += 1
                self.notes.append((touch.first, touch.section, "touch never seen"))

    def _begin(self, k: int, section: str, truth: dict[int, dict[str, float]], scans: float) -> set[int]:
        """Keep the book of true touches; those that are settled and press steadily."""
        steady = set()
        for n, t in truth.items():
            if n not in self._touches:
                self._touches[n] = _Touch(section, k)
                self.tallies[section].touches += 1
            touch = self._touches[n]
            if touch.loaded is None and t["force"] >= LIGHT_N:
                touch.loaded = self._scans
            changed = abs(t["force"] - touch.force) > STEADY * scans * t["force"]
            if touch.loaded is not None and self._scans - touch.loaded >= SETTLED - TINY and not changed:
                steady.add(n)
            touch.last, touch.force = k, t["force"]
        return steady

    def _pair(self, k: int, tally: Tally, t: dict[str, float], contact: Any, steady: bool) -> bool:
        """A touch and its contact; whether the contact is wrong."""
        contact_id, x, y, force, sigma = contact
        touch = self._touches[int(t["track"])]
        if not touch.matched:
            touch.matched = True
            tally.begin.append(touch.waited)
        if touch.id is not None and touch.id != contact_id:
            tally.switches += 1
            self.notes.append((k, touch.section, f"id switch: {touch.id} becomes {contact_id}"))
        touch.id = contact_id
        self._alone.pop(contact_id, None)
        self._real[contact_id] = int(t["track"])
        off = float(np.hypot(x - t["x"], y - t["y"]))
        if t["force"] < LIGHT_N:
            return False
        tally.position_m.append(off)
        if force is not None:
            error = force / t["force"] - 1
            tally.force.append(error)
            if steady:
                tally.steady.append(error)
                if sigma:
                    tally.sigmas.append((force - t["force"]) / sigma)
        return steady and off > WRONG_M

    def _extra(self, k: int, section: str, tally: Tally, contact: Any, scans: float) -> bool:
        """A contact where nothing touches; whether that is wrong by now."""
        contact_id = contact[0]
        tally.extra += 1
        before = self._alone.get(contact_id, 0.0)
        count = self._alone[contact_id] = before + scans
        track = self._real.get(contact_id)
        if track is not None and k > self._touches[track].last:
            tally.end.append(count)
        limit = TINY if track is None else GRACE + 1 - TINY  # one that never was a touch's is false at once
        if before < limit <= count:
            tally.false_touches += 1
            force = "no force" if contact[3] is None else f"{contact[3]:.2f} N"
            where = f"({contact[1] * 1e3:+.1f}, {contact[2] * 1e3:+.1f}) mm, {force}"
            what = "false touch" if track is None else "contact goes on where nothing touches"
            self.notes.append((k, section, f"{what}: {contact_id} at {where}"))
        return count >= limit


def match(truth: dict[int, dict[str, float]], seen: StageOutput, before: dict[int, int]) -> dict[int, int]:
    """track -> index of its contact. before: track -> contact id of the last frame."""
    index = {c[0]: i for i, c in enumerate(seen.contacts)}

    def distance(n: int, i: int) -> float:
        return float(np.hypot(seen.contacts[i][1] - truth[n]["x"], seen.contacts[i][2] - truth[n]["y"]))

    kept = {n: index[c] for n, c in before.items() if n in truth and c in index and distance(n, index[c]) <= GATE_M}
    tracks = [n for n in truth if n not in kept]
    free = [i for i in range(len(seen.contacts)) if i not in kept.values()]
    if tracks and free:
        cost = np.array([[distance(n, i) for i in free] for n in tracks])
        barred = np.where(cost > GATE_M, 1e3, cost)
        kept |= {tracks[a]: free[b] for a, b in zip(*linear_sum_assignment(barred), strict=True) if barred[a, b] < 1e3}
    return kept


def _share(part: int, whole: int) -> float | None:
    return 100 * part / whole if whole else None


def _quantile(values: Any, percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None
