"""Golden recordings: whether a recording's raw frames still give the contacts that somebody accepted.

Beside FILE.mcap lies FILE.golden: a line of JSON for each frame, so that version control shows what changed. The frames
run through the very stages of the service, in this process. What is compared are events: which contacts there are, when
each begins and ends, where and how strong it is while it is held, when the skin is not valid and for which reasons.
Times may differ by one scan and numbers by their tolerances, which cover what another processor rounds otherwise; so
may a flag of a few frames, and in how many frames an image was held.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from models.bundle import Bundle
from models.files import FileError, read_text
from protocol.frames import ContactFrame
from protocol.whole_file import write_whole
from services.pipeline import Pipeline
from services.recordings import settings
from services.recordings.recording import RecordingError, RecordingReader
from services.recordings.replay import Step, mark, skins_in, steps
from services.recordings.replay_session import configuration_of
from services.runtime.config import BUNDLES, load
from services.runtime.persistence import arrays
from services.runtime.stage import STAGES, Refused

SUFFIX = ".golden"
Line = dict[str, Any]
MOST_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class Tolerance:
    """How far two numbers may be apart: `least`, and `share` of the accepted one."""

    least: float
    share: float = 0.0

    def of(self, accepted: float) -> float:
        return self.least + self.share * abs(accepted)


TOLERANCES = {
    "x_mm": Tolerance(0.1),
    "y_mm": Tolerance(0.1),
    "z_mm": Tolerance(0.1),
    "force_n": Tolerance(0.02, 0.02),
    "force_sigma_n": Tolerance(0.02, 0.1),
    "area_cm2": Tolerance(0.02, 0.03),
    "confidence": Tolerance(0.02),
    "quality": Tolerance(0.02),
}
"""Of a contact while it is held, and of a valid frame."""

FEW, SHARE = 2, 0.01
"""Frames in which a flag may be another one: so many, and this share of all."""


@dataclass(frozen=True)
class Difference:
    """One event, or one field of one frame. by, tolerance: of numbers, and of times in scans."""

    scan: int
    at_s: float
    skin: str
    name: str
    accepted: Any
    found: Any
    by: float | None = None
    tolerance: float | None = None

    def __str__(self) -> str:
        size = "" if self.by is None else f" (by {self.by:.3g}, tolerance {self.tolerance:.3g})"
        where = f"scan {self.scan} at {self.at_s:.2f} s, {self.skin}"
        return f"{where}: {self.name}: accepted {_shown(self.accepted)}, found {_shown(self.found)}{size}"


@dataclass
class Comparison:
    """What `compare` found."""

    frames: int
    differences: list[Difference] = field(default_factory=list)

    @property
    def differing(self) -> int:
        """Frames that differ."""
        return len({(d.skin, d.scan) for d in self.differences})

    def summary(self) -> list[str]:
        """A line for each field that differs: in how many frames, where first, and by how much at most."""
        lines = []
        for name in dict.fromkeys(_kind(d.name) for d in self.differences):
            those = [d for d in self.differences if _kind(d.name) == name]
            sized = [d for d in those if d.by is not None]
            most = max(sized, key=lambda d: d.by or 0.0, default=None)
            by = (
                "" if most is None else f", at most by {most.by:.3g} (tolerance {most.tolerance:.3g}, scan {most.scan})"
            )
            lines.append(f"{name}: {len({d.scan for d in those})} frames, the first is scan {those[0].scan}{by}")
        return lines


def golden_file(recording: Path) -> Path:
    """Where what was accepted of a recording lies."""
    return recording.with_suffix(SUFFIX)


def run(recording: Path) -> list[dict[str, Any]]:
    """A line for each raw frame, in order. Raises RecordingError, ReplayError, BundleError, ConfigError."""
    reader = RecordingReader(recording)
    skins = list(skins_in(reader))
    if not skins:
        raise RecordingError(f"{recording} holds no raw frames: nothing to run")
    if not reader.damage.whole:
        raise RecordingError(f"{recording}: {reader.damage}: a golden recording is whole")
    with tempfile.TemporaryDirectory(prefix="golden-") as folder:
        file, _ = configuration_of(skins, reader, _bundle(reader, skins), Path(folder))
        config = load(file)
        pipelines = {name: Pipeline(config.skins[name], name) for name in skins}
        return list(_lines(steps(reader), pipelines))


def _bundle(reader: RecordingReader, skins: list[str]) -> Path | None:
    """Where a recorded bundle is not installed as it was, the installed one of its name: what it changes is just what
    is asked.
    """
    recorded = settings.read(reader.metadata.get(settings.KEY, ""), reader.path).skins
    listed = [recorded[name] for name in skins if name in recorded]
    installed = {Bundle.load(one.bundle).hash for one in listed if (BUNDLES / one.bundle).is_dir()}
    if not listed or all(one.bundle_hash in installed for one in listed):
        return None
    return BUNDLES / listed[0].bundle if (BUNDLES / listed[0].bundle).is_dir() else None


def _lines(source: Iterator[Step], pipelines: dict[str, Pipeline]) -> Iterator[dict[str, Any]]:
    begun: set[str] = set()
    first_ns: int | None = None
    for step in source:
        pipeline = pipelines.get(step.skin)
        if pipeline is None:
            continue
        first_ns = step.at_ns if first_ns is None else first_ns
        if step.raw is None:
            _load(pipeline, step.states, STAGES if step.skin not in begun else STAGES[:1])
        else:
            mark(step.raw)
            if (contact := pipeline.step(step.raw)) is not None:
                yield _line(contact, (step.at_ns - first_ns) * 1e-9, step.raw.parts)
            pipeline.prepare()
        begun.add(step.skin)


def _load(pipeline: Pipeline, states: dict[str, Any], wanted: tuple[str, ...]) -> None:
    """Go on from a recorded state, as far as it fits: one of another bundle does not."""
    for name, stage in zip(STAGES, (pipeline.pre, pipeline.inference, pipeline.publishing), strict=True):
        if name in wanted and isinstance(state := states.get(name), dict):
            try:
                stage.load(arrays(state))
            except (Refused, KeyError, TypeError, ValueError):
                stage.reset()


def _line(frame: ContactFrame, at_s: float, parts: int) -> dict[str, Any]:
    """A frame as it is kept: what a controller acts on. parts: of a scan, each of which has a number of its own."""
    return {
        "skin": frame.skin,
        "scan": frame.scan,
        **({"parts": parts} if parts > 1 else {}),
        "at_s": round(at_s, 3),
        "valid": frame.valid,
        "reasons": sorted(set(frame.reasons) - {"replay"}),
        "held": frame.held,
        "quality": _rounded(frame.quality),
        "contacts": [
            {
                "id": c.id,
                "state": c.state,
                **{f"{axis}_mm": _rounded(1e3 * v) for axis, v in zip("xyz", c.position, strict=True)},
                "force_n": _rounded(c.force_n),
                "force_sigma_n": _rounded(c.force_sigma_n),
                "area_cm2": _rounded(1e4 * c.area_m2),
                "shape": c.shape,
                "confidence": _rounded(c.confidence),
            }
            for c in sorted(frame.contacts, key=lambda c: c.id)
        ],
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3) + 0.0  # no -0.0


def accept(recording: Path, lines: list[dict[str, Any]]) -> Path:
    """Keep these lines as what is right; the file."""
    file = golden_file(recording)
    write_whole(file, "".join(json.dumps(line) + "\n" for line in lines))
    return file


def accepted(recording: Path) -> list[dict[str, Any]]:
    """What was accepted. Raises RecordingError where there is nothing, or nothing that can be read."""
    file = golden_file(recording)
    if not file.is_file():
        raise RecordingError(f"{file} is not there: accept what {recording.name} gives now with --accept")
    try:
        lines = [json.loads(line) for line in read_text(file, MOST_BYTES).splitlines()]
        if all(isinstance(line, dict) and {"skin", "scan", "at_s", "contacts"} <= line.keys() for line in lines):
            return lines
    except (FileError, ValueError, RecursionError):
        pass
    raise RecordingError(f"{file} holds no lines that `skin golden --accept` has written: accept them anew")


def compare(before: list[Line], now: list[Line]) -> Comparison:
    """The events of two runs, in order."""
    found = Comparison(len(now))
    for skin in dict.fromkeys(line["skin"] for line in (*before, *now)):
        runs = ({line["scan"]: line for line in lines if line["skin"] == skin} for lines in (before, now))
        found.differences += _Runs(*runs).all()
    found.differences.sort(key=lambda d: d.at_s)
    return found


class _Runs:
    """What was accepted of one skin and what is found now: scan -> line."""

    def __init__(self, old: dict[int, Line], new: dict[int, Line]) -> None:
        self.old, self.new, self.lines = old, new, {**old, **new}
        self.scan = max(line.get("parts", 1) for line in self.lines.values())  # numbers that one scan takes
        self.allowed = max(FEW, SHARE * len(self.lines))

    def all(self) -> list[Difference]:
        flags = list(self._flags())
        few = len({d.scan for d in flags}) <= self.allowed
        return [*self._touches(), *self._frames(), *([] if few else flags), *self._counts()]

    def _at(self, scan: int, name: str, accepted: Any, found: Any, limit: float | None = None) -> Difference:
        where = scan, self.lines[scan]["at_s"], self.lines[scan]["skin"], name, accepted, found
        return Difference(*where) if limit is None else Difference(*where, abs(found - accepted), limit)

    def _touches(self) -> Iterator[Difference]:
        """Which contacts there are, and how those of both runs differ."""
        old, new = _touches(self.old), _touches(self.new)
        for key in sorted(old.keys() | new.keys()):
            if key in old and key in new:
                yield from self._touch(f"contact {key}", old[key], new[key])
            else:
                yield self._at(min(old.get(key) or new[key]), f"contact {key}", key in old, key in new)

    def _touch(self, name: str, one: dict[int, Line], other: dict[int, Line]) -> Iterator[Difference]:
        """When a contact begins and ends, its states, and its numbers while both runs hold it."""
        spans = (min(one), max(one)), (min(other), max(other))
        for what, was, found in zip(("begins at scan", "ends at scan"), *spans, strict=True):
            if abs(was - found) > self.scan:
                yield self._at(found, f"{name} {what}", was, found, self.scan)
        before, now = (sorted({contact["state"] for contact in run.values()}) for run in (one, other))
        if before != now:
            yield self._at(max(other), f"{name} states", before, now)
        margin = 0 if spans[0] == spans[1] else self.scan
        both = range(max(min(one), min(other)) + margin, min(max(one), max(other)) - margin + 1)
        for scan in sorted(one.keys() & other.keys()):
            if scan in both and one[scan]["state"] == other[scan]["state"] == "hold":
                yield from self._numbers(scan, f"{name} ", one[scan], other[scan])

    def _frames(self) -> Iterator[Difference]:
        """The numbers of frames that are valid in both runs."""
        for scan in sorted(self.old.keys() & self.new.keys()):
            if self.old[scan].get("valid") and self.new[scan].get("valid"):
                yield from self._numbers(scan, "", self.old[scan], self.new[scan])

    def _numbers(self, scan: int, name: str, one: Line, other: Line) -> Iterator[Difference]:
        for key, tolerance in TOLERANCES.items():
            was, found = one.get(key), other.get(key)
            if was is None or found is None:
                if was is not found:
                    yield self._at(scan, name + key, was, found)
            elif not abs(found - was) <= (limit := tolerance.of(was)):
                yield self._at(scan, name + key, was, found, limit)

    def _flags(self) -> Iterator[Difference]:
        """Frames where something is said that the other run says of no frame within one scan."""
        old, new = _flagged(self.old), _flagged(self.new)
        for name in old.keys() | new.keys():
            there = old.get(name, set()), new.get(name, set())
            for scan in sorted(there[0] ^ there[1]):
                other = there[scan in there[0]]
                if not any(near in other for near in range(scan - self.scan, scan + self.scan + 1)):
                    yield self._at(scan, name, scan in there[0], scan in there[1])

    def _counts(self) -> Iterator[Difference]:
        """In how many frames each thing is said: a span may be longer or shorter by a scan at each of its ends."""
        old, new = _flagged(self.old), _flagged(self.new)
        for runs, flagged in ((self.old, old), (self.new, new)):
            flagged["held"] = {scan for scan, line in runs.items() if line.get("held")}
            flagged["changing"] = {scan for scan, line in runs.items() if "changing" in line.get("reasons", ())}
        for name in old.keys() | new.keys():
            was, found = old.get(name, set()), new.get(name, set())
            spans = sum(not any(near in was for near in range(scan - self.scan, scan)) for scan in was)
            limit = self.allowed + (0 if name in ("held", "changing") else 2 * self.scan * spans)
            if abs(len(found) - len(was)) > limit:
                scan = min(was ^ found)
                yield self._at(scan, f"frames with {name}", len(was), len(found), limit)


def _touches(lines: dict[int, Line]) -> dict[int, dict[int, Line]]:
    """id -> scan -> contact."""
    found: dict[int, dict[int, Line]] = {}
    for scan, line in lines.items():
        for contact in line["contacts"]:
            found.setdefault(contact["id"], {})[scan] = contact
    return found


def _flagged(lines: dict[int, Line]) -> dict[str, set[int]]:
    """What is said of a frame beside numbers -> the scans of those frames."""
    found: dict[str, set[int]] = {}
    for scan, line in lines.items():
        flagged = ["frame", *(reason for reason in line.get("reasons", ()) if reason != "changing")]
        flagged += [] if line.get("valid") else ["not valid"]
        for contact in line["contacts"]:
            shape = [f"contact {contact['id']} {contact['shape']}"] if contact["state"] == "hold" else []
            flagged += [f"contact {contact['id']} is there", *shape]
        for name in flagged:
            found.setdefault(name, set()).add(scan)
    return found


def _kind(name: str) -> str:
    """A field whatever contact it is of."""
    first, _, rest = name.partition(" ")
    return f"{first} {rest.partition(' ')[2]}" if first == "contact" else name


def _shown(value: Any) -> str:
    return json.dumps(value)
