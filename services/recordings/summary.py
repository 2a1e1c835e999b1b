"""What is in a recording, read once through: topics, gaps, faults, contacts, the course of force and validity."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from protocol.frames import Contact, ContactFrame, Frame, FrameError, StatusFrame, unpack
from services.recordings.damage import Damage
from services.recordings.recording import STATE_TOPIC, RecordedMessage, RecordingReader
from services.recordings.triggers import NO_FAULTS

FLOWING = ("raw", "contact")
"""Topics whose silence is a gap."""
GAP_S, GAP_SCANS = 0.25, 4
"""A gap is longer than both."""
BRIDGED_S = 0.5
"""A fault that is away for less than that goes on."""
MOST_LISTED = 10_000
BACK_S = 1.0


@dataclass
class TopicCount:
    """One topic of one skin. times_s: from the beginning, of each message."""

    messages: int = 0
    bytes: int = 0
    malformed: int = 0
    missing: int = 0  # by the numbers of those that are there
    times_s: list[float] = field(default_factory=list)
    _last: tuple[str, int] = ("", 0)

    def count(self, at_s: float, message: RecordedMessage, frame: Frame | None) -> None:
        """One more."""
        self.messages += 1
        self.bytes += len(message.data)
        self.times_s.append(at_s)
        if frame is None:
            return
        session, seq = self._last
        if session == frame.session and frame.seq > seq:
            self.missing += frame.seq - seq - 1
        self._last = frame.session, frame.seq

    @property
    def rate_hz(self) -> float | None:
        """Median; None for fewer than three."""
        between = self.between_s
        return None if len(between) < 2 or not between[0] > 0 else float(1 / np.median(between))

    @property
    def between_s(self) -> np.ndarray:
        """From each to the next, only those after another time."""
        between = np.diff(np.array(self.times_s))
        return between[between > 0]

    def gaps(self) -> list[tuple[float, float]]:
        """(begin, length) [s] of each silence that is no scan's."""
        between = np.diff(np.array(self.times_s))
        if len(between) < 2:
            return []
        longest = max(GAP_S, GAP_SCANS * float(np.median(between)))
        return [(self.times_s[k], float(between[k])) for k in np.flatnonzero(between > longest)[:MOST_LISTED]]


@dataclass
class Span:
    """Something that lasted."""

    skin: str
    what: str
    begin_s: float
    end_s: float


@dataclass
class ContactSpan(Span):
    """A contact. Forces are None where the skin has no force law. place: x, y, z [m] where it pressed hardest."""

    most_n: float | None = None
    place: tuple[float, ...] = ()


@dataclass
class Course:
    """One skin over time: seconds, sum of forces [N] (NaN: not known), valid."""

    times_s: list[float] = field(default_factory=list)
    force_n: list[float] = field(default_factory=list)
    valid: list[bool] = field(default_factory=list)


@dataclass
class SessionSummary:
    """All of it. Times count from the first message."""

    path: Path
    bytes: int
    metadata: dict[str, str]
    start_ns: int = 0
    duration_s: float = 0.0
    damage: Damage = field(default_factory=Damage)
    topics: dict[str, TopicCount] = field(default_factory=dict)
    faults: list[Span] = field(default_factory=list)
    contacts: list[ContactSpan] = field(default_factory=list)
    courses: dict[str, Course] = field(default_factory=dict)
    left_out: Counter[str] = field(default_factory=Counter)
    """Faults and contacts beyond MOST_LISTED."""


class _Reading:
    """The state of one read through."""

    def __init__(self, into: SessionSummary) -> None:
        self.into = into
        self._zero_ns = 0
        self._faults: dict[tuple[str, str], Span] = {}
        self._contacts: dict[tuple[str, str, int], ContactSpan] = {}

    def take(self, message: RecordedMessage) -> None:
        into = self.into
        if not into.topics:
            into.start_ns = self._zero_ns = message.log_time_ns
        if message.log_time_ns < self._zero_ns:  # a recording that was joined to a later one: it goes on from there
            self._zero_ns = message.log_time_ns - int(into.duration_s * 1e9)
        at_s = (message.log_time_ns - self._zero_ns) * 1e-9
        into.duration_s = max(into.duration_s, at_s)
        of = into.topics.setdefault(message.topic, TopicCount())
        frame: Frame | None = None
        if not message.topic.startswith(f"{STATE_TOPIC}/"):
            try:
                frame = unpack(message.wire)
            except FrameError:
                of.malformed += 1
        # Several processes send status; their numbers are their own.
        of.count(at_s, message, None if isinstance(frame, StatusFrame) else frame)
        if isinstance(frame, ContactFrame):
            self._contact(frame, at_s)
        elif isinstance(frame, StatusFrame) and frame.level in ("ERROR", "STALE") and frame.process != "recorder":
            text = "; ".join(frame.messages)
            self._fault(frame.skin, f"{frame.process} {frame.level}{': ' if text else ''}{text:.120}", at_s, BACK_S)

    def _contact(self, frame: ContactFrame, at_s: float) -> None:
        present = [c for c in frame.contacts if c.state != "end"] if frame.valid else []
        known = frame.valid and all(c.force_n is not None for c in present)
        course = self.into.courses.setdefault(frame.skin, Course())
        course.times_s.append(at_s)
        course.force_n.append(sum(c.force_n or 0.0 for c in present) if known else float("nan"))
        course.valid.append(frame.valid)
        reasons = [reason for reason in frame.reasons if reason not in NO_FAULTS]
        for reason in reasons or ([] if frame.valid else ["not valid"]):
            self._fault(frame.skin, reason, at_s)
        for c in present:
            self._present(frame, c, at_s)

    def _present(self, frame: ContactFrame, contact: Contact, at_s: float) -> None:
        """A contact is there, for the first time or still."""
        key = frame.skin, frame.session, contact.id
        span = self._contacts.get(key)
        if span is None:
            span = self._contacts[key] = ContactSpan(frame.skin, str(contact.id), at_s, at_s)
            self._listed("contacts", self.into.contacts, span)
        span.end_s = at_s
        if not span.place or (contact.force_n is not None and contact.force_n > (span.most_n or 0.0)):
            span.most_n, span.place = contact.force_n, tuple(contact.position)

    def _fault(self, skin: str, what: str, at_s: float, lasts_s: float = 0.0) -> None:
        kind = "".join(c for c in what if not c.isdigit())  # a count that goes up is the same fault
        span = self._faults.get((skin, kind))
        if span is None or at_s - span.end_s > BRIDGED_S + lasts_s:
            span = self._faults[skin, kind] = Span(skin, what, at_s, at_s)
            self._listed("faults", self.into.faults, span)
        span.end_s = at_s

    def _listed(self, name: str, into: list[Span] | list[ContactSpan], span: Span) -> None:
        if len(into) < MOST_LISTED:
            into.append(span)  # type: ignore[arg-type]
        else:
            self.into.left_out[name] += 1


def summarise(path: Path) -> SessionSummary:
    """Raises RecordingError where it is no recording."""
    reader = RecordingReader(path)
    found = SessionSummary(path, path.stat().st_size, dict(reader.metadata))
    reading = _Reading(found)
    for message in reader.messages():
        reading.take(message)
    found.damage = reader.damage
    return found


BLOCKS = "▁▂▃▄▅▆▇█"


def strip(course: Course, duration_s: float, columns: int) -> tuple[str, str, float]:
    """A course in two lines of text: the most force in each column, whether all of it was valid; and the most force."""
    force, valid = np.full(columns, np.nan), np.full(columns, -1)
    column = np.minimum((np.array(course.times_s) / max(duration_s, 1e-9) * columns).astype(int), columns - 1)
    for k, newton, ok in zip(column, course.force_n, course.valid, strict=True):
        force[k] = np.fmax(force[k], newton)
        valid[k] = ok if valid[k] < 0 else min(valid[k], ok)
    most = float(np.nanmax(force)) if np.isfinite(force).any() else 0.0

    def block(newton: float) -> str:
        if not np.isfinite(newton) or newton <= 0:
            return " "
        return BLOCKS[min(int(newton / most * len(BLOCKS)), len(BLOCKS) - 1)]

    return "".join(map(block, force)), "".join({-1: " ", 0: "✕", 1: "─"}[int(v)] for v in valid), most
