"""Golden recordings: whether a recording's raw frames still give the contacts that somebody accepted.

Beside FILE.mcap lies FILE.golden: a line of JSON for each frame, so that version control shows what changed. The frames
run through the very stages of the service, in this process. Numbers are compared within tolerances, which cover what
another processor rounds otherwise; ids, validity, reasons and shapes must be the same.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from models.bundle import Bundle
from models.files import FileError, read_text
from protocol.frames import ContactFrame
from services.pipeline import Pipeline
from services.recordings import settings
from services.recordings.recording import RecordingError, RecordingReader
from services.recordings.replay import Step, mark, skins_in, steps
from services.recordings.replay_session import configuration_of
from services.runtime.config import BUNDLES, load
from services.runtime.persistence import arrays
from services.runtime.stage import STAGES, Refused

SUFFIX = ".golden"
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
"""All else is compared as it is."""


@dataclass(frozen=True)
class Difference:
    """One field of one frame. by, tolerance: of numbers."""

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
    said = [recorded[name] for name in skins if name in recorded]
    installed = {Bundle.load(one.bundle).hash for one in said if (BUNDLES / one.bundle).is_dir()}
    if not said or all(one.bundle_hash in installed for one in said):
        return None
    return BUNDLES / said[0].bundle if (BUNDLES / said[0].bundle).is_dir() else None


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
                yield _line(contact, (step.at_ns - first_ns) * 1e-9)
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


def _line(frame: ContactFrame, at_s: float) -> dict[str, Any]:
    """A frame as it is kept: what a controller acts on."""
    return {
        "skin": frame.skin,
        "scan": frame.scan,
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
    file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
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


def compare(before: list[dict[str, Any]], now: list[dict[str, Any]]) -> Comparison:
    """All fields of all frames, in order."""
    found = Comparison(len(now))
    old = {(line["skin"], line["scan"]): line for line in before}
    new = {(line["skin"], line["scan"]): line for line in now}
    for key in sorted(old.keys() | new.keys(), key=lambda k: (new.get(k) or old[k])["at_s"]):
        one, other = old.get(key), new.get(key)
        if one is None or other is None:
            there = "there", "not there"
            said = there[::-1] if one is None else there
            found.differences.append(Difference(key[1], (one or other or {})["at_s"], key[0], "frame", *said))
            continue
        found.differences += _differences(one, other)
    return found


def _differences(one: dict[str, Any], other: dict[str, Any]) -> Iterator[Difference]:
    where = other["scan"], other["at_s"], other["skin"]
    a, b = _fields(one), _fields(other)
    for name in [*b, *(name for name in a if name not in b)]:
        was, is_now = a.get(name), b.get(name)
        limit = TOLERANCES.get(name.rpartition(" ")[2])
        if limit is not None and isinstance(was, (int, float)) and isinstance(is_now, (int, float)):
            by = abs(is_now - was)
            if not by <= limit.of(was):
                yield Difference(*where, name, was, is_now, by if math.isfinite(by) else math.inf, limit.of(was))
        elif was != is_now:
            yield Difference(*where, name, was, is_now)


def _fields(line: dict[str, Any]) -> dict[str, Any]:
    """name -> value; of a contact by its id, "contact 3 force_n"."""
    found = {k: v for k, v in line.items() if k not in ("contacts", "scan", "skin", "at_s")}
    found["contacts"] = [c["id"] for c in line["contacts"]]
    for c in line["contacts"]:
        found |= {f"contact {c['id']} {k}": v for k, v in c.items() if k != "id"}
    return found


def _kind(name: str) -> str:
    """A field whatever contact it is of."""
    first, _, rest = name.partition(" ")
    return f"{first} {rest.partition(' ')[2]}" if first == "contact" else name


def _shown(value: Any) -> str:
    return json.dumps(value)
