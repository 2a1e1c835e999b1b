"""Reaction: from the instant a touch begins, or ends, to the contact frame that says so, live on the stub's board.

    skin bench reaction [--steps 500] [--modes full rolling] [--simulated] [--quick]
    skin bench reaction --steps 100 --more    so many other touches, added to those of the last report (in parts alone:
                                              --modes rolling)

Real processes and a plain controller. The stub plays a scene that it has solved beforehand and says when it began, so
every onset is known on this host's clock. A touch is *in place* with the first valid frame, neither `changing` nor
`coarse`, from which every frame until the release is within 3 % of the side. It is *seen near* with the first valid
frame that has a contact so near, `changing` and `coarse` ones included; that frame's stamps say where its time went.
--simulated: board and stages in one process and in simulated time, 2 ms after the board's last byte, whatever else the
machine does. Prints the tables, writes reaction.json and reaction.png, or reaction_simulated.json and
reaction_simulated.png.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zmq
from rich.console import Console

from bench import REPORTS
from bench import goals as _goals
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.reaction_events import SIDE_M, Reaction, SeenFrame, TouchEvent, events, react, scene
from bench.speed.reaction_pieces import Piece, joined, keep, kept, piece_seed
from bench.speed.reaction_report import (
    FAST_RAMP,
    LIGHT,
    SEVERAL,
    SLIDING,
    SLOW_RAMP,
    SNR_DB,
    STEP,
    draw,
    goals,
    rows,
    stated,
    stated_table,
    sums,
    sums_table,
    table,
)
from bench.speed.service import Service, end_on_sigterm, running_square
from bench.speed.simulated_host import SimulatedHost
from models import manifest
from models.command import whole
from protocol.frames import ContactFrame, unpack
from protocol.sockets import ControlClient
from protocol.transport import Context
from services.runtime.config import ScanMode

MODES: tuple[ScanMode, ...] = ("full", "rolling")
STEPS, RAMPS, SLIDES, PAIRS = 500, 40, 40, 40
QUICK = 8
IDLE_S = 0.35
"""Between two touches."""
SOLVE_S = 600.0
BASELINE_S = 7.0


class Ear(threading.Thread):
    """A controller that takes every contact frame as it comes; `heard` holds (monotonic ns, message)."""

    def __init__(self, service: Service) -> None:
        super().__init__(name="ear", daemon=True)
        self.heard: list[tuple[int, bytes]] = []
        self._socket = Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, 100_000)
        self._socket.connect(f"ipc://{service.folder}/publisher.ipc")
        self._socket.subscribe(b"contact/palm\0")
        self._done = threading.Event()
        self.start()

    def run(self) -> None:
        while not self._done.is_set():
            if self._socket.poll(100):
                message = self._socket.recv()
                self.heard.append((time.monotonic_ns(), message))
        self._socket.close(0)

    def end(self) -> list[tuple[int, bytes]]:
        self._done.set()
        self.join()
        return self.heard


def measured(
    mode: ScanMode, counts: dict[str, int], seed: int, more: str = ""
) -> tuple[list[tuple[TouchEvent, Reaction]], int]:
    """What a controller saw of each event, and how often the stub had no pose ready. more: sections of skin.toml."""
    plan = events(counts, IDLE_S, seed)
    with tempfile.TemporaryDirectory(prefix="eitskin-reaction") as folder:
        script = Path(folder) / "reaction.toml"
        script.write_text(scene(plan))
        with running_square(mode, more) as service:
            stub = ControlClient("stub", SOLVE_S)
            late = int(stub.call("status")["late_poses"])
            ear = Ear(service)
            start_ns = int(stub.call("scene", name=str(script), solved=True)["start_ns"])
            last_ns = start_ns + round((plan[-1].end + 1.0) * 1e9)
            while time.monotonic_ns() < last_ns:
                time.sleep(0.2)
            late = int(stub.call("status")["late_poses"]) - late
            heard = ear.end()
    return scored(plan, [(at - start_ns, message) for at, message in heard], start_ns), late


def simulated(mode: ScanMode, counts: dict[str, int], seed: int) -> tuple[list[tuple[TouchEvent, Reaction]], int]:
    """The same without processes: what `SimulatedHost` would have handed to a controller."""
    plan = events(counts, IDLE_S, seed)
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


def scored(plan: list[TouchEvent], heard: list[tuple[int, bytes]], start_ns: int) -> list[tuple[TouchEvent, Reaction]]:
    """heard: (ns of the scene, message), in order."""
    frames: list[SeenFrame] = []
    for at, message in heard:
        frame = unpack(message)
        assert isinstance(frame, ContactFrame)
        frames.append(SeenFrame(at * 1e-9, (frame.stamps["sample"] - start_ns) * 1e-9, frame))
    return by_event(plan, frames)


def by_event(plan: list[TouchEvent], frames: list[SeenFrame]) -> list[tuple[TouchEvent, Reaction]]:
    received = [seen.received for seen in frames]
    ends = [event.onset for event in plan[1:]] + [plan[-1].end + 1.0]
    found = []
    for event, until in zip(plan, ends, strict=True):
        first, last = np.searchsorted(received, (event.onset, until))
        found.append((event, react(event, until, frames[first:last])))
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench reaction", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=whole(), default=STEPS, help="of 2 N; the others in proportion")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--simulated", action="store_true", help="in simulated time, without processes")
    parser.add_argument("--baud", type=whole(), help="of the board's line; default: as skin.toml's")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--more", action="store_true", help="add so many other touches to those of the last report")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} steps and a few of the others")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    if args.simulated and args.baud:
        parser.error("--baud is of the live board's line: without --simulated")
    name, before = "reaction_simulated" if args.simulated else "reaction", list[Piece]()
    if args.more:
        try:
            before = kept(name, args.seed, args.modes)
        except ValueError as why:
            parser.error(str(why))
    pieces = [*before, _piece(args, len(before))]
    if not args.quick:
        keep(pieces, name)
    found, late = joined(pieces)
    result = [row for mode, each in found.items() for row in rows(mode, each)]
    Console(width=190).print(table(result))
    pieces_of = [row for mode, each in found.items() for row in sums(mode, each)]
    if pieces_of:
        Console(width=150).print(sums_table(pieces_of))
    honest = [row for mode, each in found.items() for row in stated(mode, each)]
    Console(width=150).print(stated_table(honest))
    listed = goals(result, late)
    Console(width=150).print(_goals.table(listed))
    report = {**provenance("reaction", argv), "targets": [goal.to_dict() for goal in listed], "rows": result}
    report |= {"stated": honest, "sums": pieces_of, "runs": [piece.row() for piece in pieces]}
    report |= {"side_m": SIDE_M, "simulated": args.simulated}
    report |= {
        "contact_ms": {m: [1e3 * r.contact_s for e, r in each if e.kind.name == STEP] for m, each in found.items()}
    }
    write_json(args.out / f"{name}.json", report)
    draw(found, args.out / f"{name}.png")
    for said in report["runs"]:
        print(
            f"{said['steps']} steps, {' and '.join(said['modes'])}; {sum(said['late_poses'].values())} late poses; "
            f"load of the machine {said['load'][0]:.1f} to {said['load'][1]:.1f}"
        )
    print(f"wrote {args.out / name}.json and {name}.png")
    return 0


def _piece(args: argparse.Namespace, number: int) -> Piece:
    """One run."""
    steps = QUICK if args.quick else args.steps
    wanted = {STEP: STEPS, LIGHT: STEPS // 5, FAST_RAMP: RAMPS, SLOW_RAMP: RAMPS}
    wanted |= dict.fromkeys(SLIDING, SLIDES) | dict.fromkeys(SEVERAL, PAIRS)
    counts = {name: max(2, round(n * steps / STEPS)) for name, n in wanted.items()}
    piece = Piece(piece_seed(args.seed, number), counts[STEP], load=[os.getloadavg()[0]], commit=manifest.commit())
    for mode in args.modes:  # each on the same touches
        if args.simulated:
            piece.found[mode], piece.late[mode] = simulated(mode, counts, piece.seed)
        else:
            baud = f"baud = {args.baud}\n" if args.baud else ""
            piece.found[mode], piece.late[mode] = measured(mode, counts, piece.seed, baud)
        piece.load.append(os.getloadavg()[0])
    return piece


if __name__ == "__main__":
    raise SystemExit(main())
