"""Reaction: from the instant a touch begins, or ends, to the contact frame that says so.

    skin bench reaction [--steps 90] [--modes full rolling] [--quick]      in simulated time
    skin bench reaction --live [--priority 20] [--busy] [--baud 2000000]   real processes and a plain controller

A touch is *in place* with the first valid frame, neither `changing` nor `coarse`, from which every frame until the
release is within 3 % of the side. It is *seen near* with the first valid frame that has a contact so near, `changing`
and `coarse` ones included. In simulated time board and stages are in one process, whose answer comes 2 ms after the
board's last byte, whatever else the machine does. Live, the stub plays a scene that it has solved beforehand and says
when it began, so every onset is known on this host's clock, and the frame's stamps say where its time went; --priority:
of the processes, as [realtime] of skin.toml; --busy: beside one program for each core that does nothing but count.
Prints the tables, writes reaction.json, or reaction_live.json, and draws it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal, titled
from bench.json_file import write_report
from bench.machine import machine
from bench.speed.reaction_events import KINDS, Reaction, SeenFrame, TouchEvent, events, react, scene
from bench.speed.service import end_on_sigterm, heard, running_square, subscribed
from models.command import whole
from protocol.frames import ContactFrame, unpack
from protocol.sockets import ControlClient
from services.runtime.config import ScanMode
from simulation.host import SimulatedHost

MODES: tuple[ScanMode, ...] = ("full", "rolling")
STEP, LIGHT = KINDS[0].name, KINDS[1].name
STEPS, QUICK = 90, 8
SHARES = {STEP: 1.0, LIGHT: 0.2}  # of the steps; of every other kind OTHERS
OTHERS = 0.08
SNR_DB = 80.0
IDLE_S = 0.35
"""Between two touches."""
SOLVE_S = 600.0
BASELINE_S = 7.0
# of scans in parts: key, what, target ms
TARGETS = {
    STEP: (
        ("contact_p50_ms", "to a valid contact, median", 12.0),
        ("contact_p99_ms", "the same, p99", 25.0),
        ("gone_p50_ms", "release, median", 15.0),
        ("gone_p99_ms", "release, p99", 30.0),
    ),
    LIGHT: (("contact_p50_ms", "to a valid contact, median", 18.0), ("contact_p90_ms", "the same, p90", 35.0)),
    **{
        kind.name: (("near_p50_ms", "all near, median", 40.0), ("contact_p50_ms", "all in place, median", 40.0))
        for kind in KINDS
        if kind.touches > 1
    },
}
PIECES = ("to its middle", "line", "preprocessing", "inference", "publisher", "recv")
"""Between an onset, the steps of STEPS_TO_RECV and recv: until the middle of the scan or part that tells of the touch
was measured; the rest of it, the line and acquisition; each stage with the hop to it; the hop to the controller.
"""
Found = list[tuple[TouchEvent, Reaction]]


def live(mode: ScanMode, plan: list[TouchEvent], more: str) -> tuple[Found, int]:
    """What a controller saw of each event, and how often the stub had no pose ready. more: sections of skin.toml."""
    with tempfile.TemporaryDirectory(prefix="eitskin-reaction") as folder:
        script = Path(folder) / "reaction.toml"
        script.write_text(scene(plan))
        with running_square(mode, more) as service:
            stub = ControlClient("stub", SOLVE_S)
            late = int(stub.call("status")["late_poses"])
            socket = subscribed(service.folder, ["publisher"], b"contact/palm\0")
            start_ns = int(stub.call("scene", name=str(script), solved=True)["start_ns"])
            messages = heard(socket, start_ns * 1e-9 + plan[-1].end + 1.0 - time.monotonic())
            late = int(stub.call("status")["late_poses"]) - late
            socket.close(0)
    frames: list[SeenFrame] = []
    for message, at in messages:
        frame = unpack(message)
        assert isinstance(frame, ContactFrame)
        frames.append(SeenFrame((at - start_ns) * 1e-9, (frame.stamps["sample"] - start_ns) * 1e-9, frame))
    return by_event(plan, frames), late


def simulated(mode: ScanMode, plan: list[TouchEvent], seed: int) -> tuple[Found, int]:
    """The same without processes."""
    host = SimulatedHost(mode, snr_db=SNR_DB, seed=seed)
    host.until(BASELINE_S)
    with tempfile.TemporaryDirectory(prefix="eitskin-reaction") as folder:
        script = Path(folder) / "reaction.toml"
        script.write_text(scene(plan))
        host.rig.play(str(script), host.now)
    start, first = host.now, len(host.contacts)
    host.until(start + plan[-1].end + 1.0)
    host.rig.close()
    seen = [SeenFrame(t - start, f.stamps["sample"] * 1e-9 - start, f) for t, f in host.contacts[first:]]
    return by_event(plan, seen), host.rig.field.late


def by_event(plan: list[TouchEvent], frames: list[SeenFrame]) -> Found:
    received = [seen.received for seen in frames]
    ends = [event.onset for event in plan[1:]] + [plan[-1].end + 1.0]
    found = []
    for event, until in zip(plan, ends, strict=True):
        first, last = np.searchsorted(received, (event.onset, until))
        found.append((event, react(event, until, frames[first:last])))
    return found


@contextmanager
def counting(programs: int) -> Iterator[None]:
    """So many programs do nothing but count until the block ends."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(programs)]
    try:
        yield
    finally:
        for each in running:
            each.kill()
            each.wait()


def rows(mode: str, found: Found, is_live: bool) -> list[dict[str, Any]]:
    """is_live: stages stamped their frames by the clock of the scene."""
    made = []
    for kind in KINDS:
        of = [reaction for event, reaction in found if event.kind is kind]
        if not of:
            continue
        row: dict[str, Any] = {"mode": mode, "kind": kind.name, "touches": len(of), **waited(of)}
        row["wrong"] = sum(each.wrong for each in of)
        row["late"] = sum(each.late for each in of)
        for name, key in (("errors_m", "moving_mm"), ("held_m", "held_mm"), ("held_force", "held_force")):
            values = np.array([value for each in of for value in getattr(each, name)])
            row[key] = (1e3 if key.endswith("mm") else 1.0) * _quantile(values, 50)
        if ends := [[0.0, *r.near_after_s, r.near_s] for r in of if r.near_after_s and is_live]:
            pieces = 1e3 * np.median(np.diff(ends, axis=1), axis=0)
            row["pieces_ms"] = dict(zip(PIECES, pieces.tolist(), strict=True))
        made.append(row)
    return made


def waited(of: Sequence[Reaction]) -> dict[str, Any]:
    """How long until each was in place, near and gone [ms]; one that never was counts as after every other."""
    row: dict[str, Any] = {}
    for what in ("contact", "near", "gone"):
        ms = 1e3 * np.array([getattr(each, f"{what}_s") for each in of])
        ms = np.where(np.isnan(ms), np.inf, ms)
        row |= {f"{what}_seen": int(np.isfinite(ms).sum())}
        row |= {f"{what}_p{q}_ms": _quantile(ms, q) for q in (50, 90, 99)}
    return row


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.percentile(values, q, method="higher")) if len(values) else float("nan")


def goals(table: Sequence[dict[str, Any]], late: dict[str, int]) -> list[Goal]:
    found = []
    for row in table:
        name = f"{row['mode']}: {row['kind']}"
        found.append(Goal(f"{name}: share seen in place", row["contact_seen"] / row["touches"], at_least=1.0))
        if row["mode"] == "rolling":  # the other is what it is compared with
            found += [Goal(f"{name}: {w}, ms", row[key], at_most=m) for key, w, m in TARGETS.get(row["kind"], ())]
        found.append(Goal(f"{name}: contacts before it, off by over 3 sigma", row["wrong"], at_most=0))
    for mode, count in late.items():
        found.append(Goal(f"{mode}: poses that the stub had not solved", count, at_most=0))
    return found


def tables(of: Sequence[dict[str, Any]]) -> list[Table]:
    headings = ["scan", "touch", "n", "in place", "p50", "p90", "p99", "first near p50", "p99", "release p50", "p99"]
    headings += ["off > 3 sigma", "late", "mm at recv, moving", "held mm", "force"]
    made = titled(f"force leaves zero (or is back) to a controller's recv, ms, {machine()}", headings, 2)
    pieces = "scan", "touch", *PIECES
    parts = titled("force leaves zero to the first frame near it: medians of the pieces, ms", pieces, 2)
    for row in of:
        times = [row[f"contact_p{q}_ms"] for q in (50, 90, 99)]
        times += [row[f"{what}_p{q}_ms"] for what in ("near", "gone") for q in (50, 99)]
        errors = [f"{row[key]:.2f}" if np.isfinite(row[key]) else "" for key in ("moving_mm", "held_mm", "held_force")]
        cells = [f"{value:.1f}" if np.isfinite(value) else "-" for value in times]
        seen = f"{row['contact_seen']}/{row['touches']}"
        counts = str(row["wrong"]), str(row["late"])
        made.add_row(row["mode"], row["kind"], str(row["touches"]), seen, *cells, *counts, *errors)
        if "pieces_ms" in row:
            parts.add_row(row["mode"], row["kind"], *(f"{ms:.1f}" for ms in row["pieces_ms"].values()))
    return [made, parts] if parts.row_count else [made]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench reaction", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=whole(), default=STEPS, help="of 2 N; the others in proportion")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--live", action="store_true", help="real processes, in real time")
    parser.add_argument("--baud", type=whole(), help="of the live board's line")
    parser.add_argument("--priority", type=whole(1), help="of the live processes (SCHED_FIFO)")
    parser.add_argument("--busy", action="store_true", help="a program that counts on each core, live")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} steps and a few of the others")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    if not args.live and (args.baud or args.priority or args.busy):
        parser.error("--baud, --priority and --busy are of --live")
    end_on_sigterm()
    steps = QUICK if args.quick else args.steps
    plan = events({k.name: max(2, round(steps * SHARES.get(k.name, OTHERS))) for k in KINDS}, IDLE_S, args.seed)
    more = f"baud = {args.baud}\n" if args.baud else ""
    more += f"[realtime]\npriority = {args.priority}\n" if args.priority else ""
    found: dict[str, Found] = {}
    late: dict[str, int] = {}
    for mode in args.modes:  # each on the same touches
        with counting(len(os.sched_getaffinity(0)) if args.busy else 0):
            found[mode], late[mode] = live(mode, plan, more) if args.live else simulated(mode, plan, args.seed)
    result = [row for mode, each in found.items() for row in rows(mode, each, args.live)]
    console = Console(width=190)
    for table in tables(result):
        console.print(table)
    listed = goals(result, late)
    console.print(_goals.table(listed))
    steps_ms = {
        mode: {
            what: [1e3 * getattr(r, f"{what}_s") for e, r in each if e.kind.name == STEP]
            for what in ("contact", "gone")
        }
        for mode, each in found.items()
    }
    report = {"rows": result, "live": args.live, "steps_ms": steps_ms}
    write_report(args.out / f"reaction{'_live' if args.live else ''}.json", argv, listed, report)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
