"""Many frames of random faults and presses; counts the errors that no frame may have. Counted are frames that are valid
and do not say `changing`; touches press with 1 N or more, radius 0.1 or more.

A phantom: a contact further than FAR_M from every touch, while every touch has one near it or nothing touches. Off:
the same while a touch has none near it. Unseen: a touch without a contact near it in such frames in a row, for UNSEEN
scans.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from bench.reliability.counts import Counts
from bench.reliability.random_scene import SCAN_S, TARE_S, RandomScene, random_scene
from bench.reliability.scenes import SolvedSheet
from bench.reliability.session import Moment, Session
from services.pipeline import Pipeline

FAR_M = 0.020
UNSEEN = 2.5  # scans: the third frame in a row, of whole scans
NEWTON = 1.0  # a touch presses from here on
CHUNK = 2500  # frames from one start to the next
LEAST, MOST = 200, 10**8  # frames of a run
KEPT = 40  # notes of a report


@dataclass
class SoakTally(Counts):
    chunks: int = 0  # starts
    frames: int = 0
    counted: int = 0  # valid, and not `changing`
    invalid: int = 0
    phantoms: int = 0
    off: int = 0
    unseen: int = 0  # touches
    touches: int = 0
    faults: int = 0
    blamed: Counter[str] = field(default_factory=Counter)  # what failed last before a frame that was wrong
    notes: list[str] = field(default_factory=list)

    def add(self, other: Self) -> None:
        super().add(other)
        self.notes = self.notes[:KEPT]

    def row(self) -> dict[str, Any]:
        return {
            "chunks": self.chunks,
            "frames": self.frames,
            "counted": self.counted,
            "invalid": self.invalid,
            "touches": self.touches,
            "faults": self.faults,
            "phantoms": self.phantoms,
            "off": self.off,
            "unseen": self.unseen,
            "invalid_%": 100 * self.invalid / max(self.frames, 1),
            "blamed": dict(self.blamed.most_common(12)),
            "notes": self.notes,
        }

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> SoakTally:
        """From the row of a report. Raises KeyError where it is of another version."""
        counts = {name: row[name] for name in vars(cls())}
        return cls(**{**counts, "blamed": Counter(row["blamed"]), "notes": list(row["notes"])})


def chunk(sheet: SolvedSheet, pipeline: Pipeline, frames: int, seed: int) -> SoakTally:
    """Score this many frames after a fresh start, tare included."""
    seconds = frames * SCAN_S
    scene = random_scene(seconds, seed)
    session = Session(sheet, scene.script, seed, pipeline)
    tally = tallied(session.run(seconds), scene, seed)
    session.close()
    return tally


def tallied(moments: Iterable[Moment], scene: RandomScene, seed: int) -> SoakTally:
    tally = SoakTally(chunks=1, touches=len(scene.presses), faults=len(scene.faults))
    run: list[float] = []  # scans in a row in which the n-th touch had no contact
    before = 0.0
    for m in moments:
        tally.frames += 1
        scans, before = min(1.0, (m.read_s - before) / SCAN_S), m.read_s  # a frame of a part adds a tenth
        if m.middle_s < TARE_S:
            continue
        tally.invalid += not m.valid
        pressed = tuple(t for t in m.pressed if (t.newtons or 0.0) >= 0.999 * NEWTON)
        if len(pressed) != len(run):
            run = [0.0] * len(pressed)
        if not m.valid or m.changing:
            continue
        tally.counted += 1
        unseen = m.unseen(FAR_M)
        wrong = []
        if strangers := m.phantoms(FAR_M):
            off = any(t in pressed for t in unseen)
            tally.off += off
            tally.phantoms += not off
            wrong.append(
                ("off" if off else "phantom") + f" at ({strangers[0].x * 1e3:+.0f}, {strangers[0].y * 1e3:+.0f}) mm"
            )
        for n, touch in enumerate(pressed):
            longer = run[n] + scans if touch in unseen else 0.0
            late, run[n] = run[n] <= UNSEEN < longer, longer
            if late:
                tally.unseen += 1
                wrong.append(f"unseen {touch.newtons:.1f} N at ({touch.x * 1e3:+.0f}, {touch.y * 1e3:+.0f}) mm")
        if wrong:
            at, what = max(((t, f) for t, f in scene.faults if t <= m.read_s), default=(0.0, "no fault"))
            tally.blamed[what.split(" {")[0]] += 1
            tally.notes.append(f"seed {seed}, {m.read_s:.2f} s: {'; '.join(wrong)}; {what} since {at:.2f} s")
    return tally
