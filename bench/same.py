"""What every stage makes of fixed scans, field by field: what `skin dev same` compares between two checkouts.

The scans are simulated anew from fixed seeds, in simulated time and one thread; no time that was measured is in what is
written. `python -m bench.same FILE [TEXT]` plays the scenes with TEXT in their names, in an environment as
tests/pinned.py makes it, and writes them: a line for each frame, or file of rows.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any
from unittest import mock

import msgpack
import numpy as np

from bench import ROOT
from bench.trust import plans
from bench.trust.runs import SCANS, skin_of
from bench.trust.session import PlayedSession, SessionPlan
from bench.trust.stages import Today
from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from firmware_stub.worlds import table
from models.bundle import Bundle
from protocol.frames import Frame, JudgementsFrame, RawFrame, pack
from services.calibration.register_command import register_presses
from services.pipeline import ALL, Pipeline
from services.recordings import golden
from services.recordings.npz_file import read_scans
from services.recordings.reconstruction import reconstruct
from services.recordings.replay_session import private_runtime
from services.runtime.config import ScanMode, Skin
from services.runtime.persistence import arrays
from services.runtime.stage import Stage
from simulation.faults import ROWS, FaultRow
from simulation.host import TARED_S, loaded, tared
from simulation.scenes import DiscPress, script, spread

SEED = 7
SHOWN = 160  # characters of a value
MEASURED = ("stamps", "host", "session")  # by clocks of this machine, or drawn anew by each process
BEGIN_S, FAULT_S, PRESSED_S, END_S = 0.5, 0.4, 1.4, 1.8  # of a fault's scene
WORLD_S, START_S = 11.0, 11.5
PRESSES, MOST = 24, 4

Lines = list[dict[str, str]]  # field -> what it holds, with a digest where that is long


def text_of(value: Any) -> str:
    """Short, and another one where a single bit differs."""
    text, bits = repr(value), b""
    if isinstance(value, np.ndarray):
        text, bits = f"{value.dtype} {value.shape}", value.tobytes()
        if value.dtype.kind in "fc":
            text += f" of norm {np.linalg.norm(value[np.isfinite(value)])!r}"
    if not bits and len(text) <= SHOWN:
        return text
    return f"{text[:SHOWN]} #{hashlib.sha256(text.encode() + bits).hexdigest()[:16]}"


def line_of(frame: Frame) -> dict[str, str]:
    """All that would be published of it, but for what was MEASURED."""
    topic, _, packed = pack(frame).partition(b"\0")
    fields = msgpack.unpackb(packed)
    sample = fields["stamps"].get("sample", 0)
    texts = {name: text_of(arrays(value)) for name, value in fields.items() if name not in MEASURED}
    return {"topic": f"{topic.decode()} at {sample} ns"} | texts


def _noted(lines: Lines, stage: Stage, frame: Frame) -> list[Frame]:
    """As Pipeline._passed, whose place it takes."""
    if isinstance(frame, RawFrame):
        lines.append(line_of(frame))
    made = stage.everything(frame, ALL | {"judgements"})
    lines += map(line_of, made)
    return [each for each in made if not isinstance(each, JudgementsFrame)]


# --- the scenes ---


def _fault(lines: Lines, row: FaultRow, scan: ScanMode) -> None:
    """While a touch is held, or slides."""
    host, args = tared(scan, seed=SEED), row.draw(np.random.default_rng(SEED))
    lines.clear()  # which of the scenes is the first to make a host, that says more
    press = DiscPress(-0.015, 0.01, 0.1, PRESSED_S, 2.0, 0.1, to=(0.01, 0.01) if scan == "rolling" else None)
    host.play(script(press, cues=row.cues(args, BEGIN_S, FAULT_S), contact=row.contact(args, BEGIN_S, FAULT_S)))
    host.until(TARED_S + END_S)
    host.close()


def _session(plan: SessionPlan, scan: str, acts: bool) -> None:
    """acts: what is done to the stages; no tare, whose fit of the mounting takes seconds of real time."""
    sheet, skin, bundle = table.sheet(plan.world, plan.seed), skin_of(scan, "square16"), loaded("square16")
    scene = plans.PLANS[plan.plan].scene(plan, sheet)
    played = PlayedSession(plan, scene if acts else replace(scene, acts=()), sheet, skin, bundle)
    for _ in played.contacts({"": Today(skin, bundle)}):
        pass
    played.host.close()


def _read(sheet: Sheet, *touches: Touch) -> Any:
    return np.abs(sheet.model.read(sheet.transfer(World(touches))))


def _rows(lines: Lines, skin: str, registered: bool = False) -> None:
    """Rows of a file: one touch, two, three, and so on; each by itself, and one after the other."""
    sheet, rng = Sheet(skin), np.random.default_rng(SEED)
    touches, free = spread(PRESSES, SEED), _read(sheet)
    touched = [_read(sheet, *touches[k : k + 1 + (not registered) * (k % MOST)]) for k in range(PRESSES)]
    noise = 1 + 1e-4 * rng.standard_normal((2, PRESSES, len(free)))
    made = {"untouched": noise[0] * free, "touched": noise[1] * np.array(touched)}
    with tempfile.TemporaryDirectory() as folder:
        bundle = skin
        if registered:
            xy = np.array([(touch.x, touch.y) for touch in touches])
            made |= {"xy": xy, "force": np.array([touch.force_n for touch in touches])}
            bundle = str(register_presses(made, skin, None, Path(folder))["bundle"])
        given = {"untouched": made["untouched"], "measurements": made["touched"]}
        of, data = Bundle.load(bundle), read_scans(given, Bundle.load(bundle))
        for sequence in (False, True):
            out = reconstruct(data, Skin(port="stub", bundle=bundle), of, sequence)
            lines.append({"topic": "rows"} | {name: text_of(value) for name, value in out.items()})


def scenes(lines: Lines) -> Iterator[tuple[str, Callable[[], object]]]:
    for file in sorted((ROOT / "tests").rglob("*.mcap")):
        yield f"recording {file.stem}", partial(golden.run, file)
    for skin in ("square16", "disc16"):
        yield f"rows of {skin}", partial(_rows, lines, skin)
    yield "rows of a registered skin", partial(_rows, lines, "disc16", True)
    for k, world in enumerate(table.WORLDS):
        scan = SCANS[k % 2]
        yield f"world {world}, {scan}", partial(_session, SessionPlan(world, SEED + k, WORLD_S), scan, False)
    for k, row in enumerate(plans.PLANS["starts"].rows):
        plan = SessionPlan("plain", SEED, START_S, plan="starts", row=row)
        yield f"start {row}", partial(_session, plan, SCANS[k % 2], True)
    for k, fault in enumerate(ROWS):
        yield f"fault {fault.title}, {SCANS[k % 2]}", partial(_fault, lines, fault, SCANS[k % 2])


def record(path: Path, only: str = "") -> None:
    """Play the scenes whose names have `only` in them, and write their lines."""
    lines: Lines = []
    noting = mock.patch.object(Pipeline, "_passed", partial(_noted, lines))
    with gzip.open(path, "wt", compresslevel=1, encoding="utf-8") as file, private_runtime(), noting:
        for name, play in scenes(lines):
            if only in name:
                lines.clear()
                play()
                file.writelines(f"{name}\t{json.dumps(line)}\n" for line in lines)


# --- beside each other ---


def read(path: Path, only: str = "") -> dict[str, list[str]]:
    """The lines of each scene."""
    found: dict[str, list[str]] = {}
    with gzip.open(path, "rt", encoding="utf-8") as file:
        for name, _, line in (row.partition("\t") for row in file):
            if only in name:
                found.setdefault(name, []).append(line)
    return found


def digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:16]


def difference(ours: Sequence[str], theirs: Sequence[str]) -> str:
    """The first line and field that differ, with both values; "": none does."""
    for k, (own, other) in enumerate(zip_longest(ours, theirs, fillvalue="{}"), 1):
        if own == other:
            continue
        here, there = json.loads(own), json.loads(other)
        for field in (field for field in here | there if here.get(field) != there.get(field)):
            where = f"line {k} of {len(ours)} and {len(theirs)}, {(here or there)['topic']}: {field}"
            return f"{where}\n  here   {here.get(field)}\n  there  {there.get(field)}"
    return ""


if __name__ == "__main__":
    record(Path(sys.argv[1]), *sys.argv[2:3])
