"""What is not in a recording, though it should be: counted by the numbers of the messages that are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from protocol.frames import FrameError, read_map

MOST_SPANS = 1000
SHOWN = 5


class MissingScans(NamedTuple):
    """Scans of a topic that are not there, first and last included; None: not known, at an end of the file."""

    topic: str
    first: int | None
    last: int | None

    def __str__(self) -> str:
        if self.first is None or self.last is None:
            return f"after scan {self.first - 1}" if self.first is not None else f"up to scan {self.last}"
        return f"scan {self.first}" if self.first == self.last else f"scans {self.first} to {self.last}"


@dataclass(slots=True)
class Damage:
    """What a reader had to leave out, and what the recorder could not write."""

    recordings: int = 1
    """So many were joined to one file."""
    truncated: bool = False
    places: int = 0
    first_place: int = 0
    lost_bytes: int = 0
    zeros: int = 0
    bad_chunks: int = 0
    too_large: int = 0
    repeated: int = 0
    """Chunks that stood in the file before: part of it was written or copied twice."""
    index: bool = False
    nameless: int = 0
    medium: str = ""
    confirmed: bool = True
    """Whether the file says how many messages it held."""
    missing: Counter[str] = field(default_factory=Counter)
    """Messages by topic."""
    scans: list[MissingScans] = field(default_factory=list)
    unwritten: Counter[str] = field(default_factory=Counter)
    """Messages by topic that there was no room for when it was recorded."""

    def lose(self, begin: int, end: int, zeros: bool = False) -> None:
        """Bytes that belong to no record."""
        self.first_place = self.first_place if self.places else begin
        self.places += 1
        self.lost_bytes += end - begin
        self.zeros += (end - begin) * zeros

    @property
    def whole(self) -> bool:
        """Whether all that was to be recorded is there, and the file is as it was written."""
        chunks = self.bad_chunks, self.too_large, self.repeated
        found = self.truncated, self.places, *chunks, self.index, self.nameless, self.medium
        return not (any(found) or self.missing or self.unwritten)

    def __str__(self) -> str:
        what = "zeros" if self.zeros == self.lost_bytes > 0 else "damaged"
        first = f"the first at byte {self.first_place}"
        unwritten = ", ".join(f"{topic} {n}" for topic, n in self.unwritten.items())
        in_form_alone = not (self.whole or self.missing or self.nameless or self.unwritten or self.truncated)
        remarks = (
            (self.recordings > 1, f"{self.recordings} recordings joined"),
            (self.truncated, "cut short: it has no end"),
            (self.medium, f"reading failed: {self.medium}"),
            (self.places, f"{self.lost_bytes} bytes {what} in {self.places} place(s), {first}"),
            (self.bad_chunks, f"{self.bad_chunks} chunk(s) with a wrong checksum left out"),
            (self.too_large, f"{self.too_large} chunk(s) of more than 16 MB left out"),
            (self.repeated, f"{self.repeated} chunk(s) that stand there twice are read once"),
            (self.index, "its index is damaged"),
            (self.nameless, f"{self.nameless} message(s) of an unknown topic left out"),
            (self.missing, self._missing()),
            (unwritten, f"{self.unwritten.total()} message(s) could not be written when it was recorded ({unwritten})"),
            (
                in_form_alone,
                "no message is missing" if self.confirmed else "how many messages are missing is not known",
            ),
        )
        return "; ".join(text for applies, text in remarks if applies) or "whole"

    def _missing(self) -> str:
        topics = []
        for topic, count in self.missing.items():
            spans = [str(span) for span in self.scans if span.topic == topic]
            more = [f"and {len(spans) - SHOWN} more"] if len(spans) > SHOWN else []
            topics.append(f"{topic} {count}" + (f" ({', '.join(spans[:SHOWN] + more)})" if spans else ""))
        least = "" if self.confirmed else "at least "
        return f"{least}{self.missing.total()} message(s) cannot be read: {', '.join(topics)}"


class MissingMessages:
    """Counts to a Damage what is missing between the messages of one recording, which the recorder numbers from 1."""

    def __init__(self, damage: Damage) -> None:
        self.damage = damage
        self.seen = 0
        self._last: dict[str, tuple[int, bytes]] = {}

    def take(self, topic: str, sequence: int, data: bytes, again: bool = False) -> None:
        """One that is there, perhaps `again`. Files of other makers have no numbers, all 0."""
        self.seen += 1
        before, last = self._last.get(topic, (0, b""))
        if sequence <= before and again:
            return
        if sequence <= before:  # a recording of its own, whose beginning is lost
            before, last = 0, b""
        self._last[topic] = sequence, data
        if sequence > before + 1:
            self._miss(topic, sequence - before - 1, scan_of(topic, last), scan_of(topic, data))

    def end(self, counts: dict[str, int]) -> None:
        """The recording ends; counts: how many messages of each topic it says that it holds."""
        for topic, count in counts.items():
            before, last = self._last.get(topic, (0, b""))
            if count > before and (before or topic not in self._last):
                self._miss(topic, count - before, scan_of(topic, last), None)

    def _miss(self, topic: str, count: int, before: int | None, after: int | None) -> None:
        self.damage.missing[topic] += count
        if len(self.damage.scans) >= MOST_SPANS or before is after is None:
            return
        if before is None or after is None or after > before + 1:
            first, last = None if before is None else before + 1, None if after is None else after - 1
            self.damage.scans.append(MissingScans(topic, first, last))


def scan_of(topic: str, data: bytes) -> int | None:
    """The number of the scan in a message of measurements or contacts; None in others."""
    if not data or topic.partition("/")[0] not in ("raw", "contact"):
        return None
    try:
        scan = read_map(data, topic).get("scan")
    except FrameError:
        return None
    return scan if type(scan) is int else None
