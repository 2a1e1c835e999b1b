"""Reaction: from the instant a touch begins, or ends, to the contact frame that says so, live on the stub's board.

    skin bench reaction [--steps 500] [--modes full adaptive rolling] [--simulated] [--quick]

Real processes and a plain controller. The stub plays a scene that it has solved beforehand and says when it began, so
every onset is known on this host's clock. A touch is seen with the first valid frame, neither `changing` nor `coarse`,
from which every frame until the release is within 3 % of the side. --simulated: board and stages in one process and in
simulated time, 2 ms after the board's last byte, whatever else the machine does. Prints the tables, writes
reaction.json and reaction.png.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.reaction_events import KINDS, SIDE_M, Reaction, SeenFrame, TouchEvent, events, react, scene
from bench.speed.sentinel_host import AdaptiveHost
from bench.speed.service import Service, end_on_sigterm, running
from protocol.frames import ContactFrame, unpack
from protocol.sockets import ControlClient
from protocol.transport import Context
from services.runtime.config import ScanMode

MODES: tuple[ScanMode, ...] = ("full", "adaptive", "rolling")
STEPS, RAMPS, SLIDES = 500, 40, 40
QUICK = 8
IDLE_S: dict[ScanMode, float] = {"full": 0.35, "adaptive": 3.6, "rolling": 0.35}
"""Between two touches: until the board scans as it does while nothing touches."""
OF_FEWER: dict[ScanMode, int] = {"full": 1, "adaptive": 8, "rolling": 1}
"""Long pauses are made so many times less often."""
SOLVE_S = 600.0
SNR_DB = 80.0
BASELINE_S = 7.0
STEP, LIGHT, FAST_RAMP, SLOW_RAMP, *SLIDING = (kind.name for kind in KINDS)
TARGETS_MS = {STEP: (50, 12.0, 99, 25.0), LIGHT: (50, 18.0, 90, 35.0)}  # quantile, target, quantile, target
GONE_MS = (15.0, 30.0)
SLIP = 0.1


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


def measured(mode: ScanMode, counts: dict[str, int], seed: int) -> tuple[list[tuple[TouchEvent, Reaction]], int]:
    """What a controller saw of each event, and how often the stub had no pose ready."""
    plan = events(counts, IDLE_S[mode], seed)
    with tempfile.TemporaryDirectory(prefix="eitskin-reaction") as folder:
        script, config = Path(folder) / "reaction.toml", Path(folder) / "skin.toml"
        script.write_text(scene(plan))
        config.write_text(f'[skins.palm]\nport = "stub"\nbundle = "square16"\nframe_id = "palm"\nscan = "{mode}"\n')
        with running("--config", str(config)) as service:
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
    """The same without processes: what `AdaptiveHost` would have handed to a controller."""
    plan = events(counts, IDLE_S[mode], seed)
    host = AdaptiveHost(mode, snr_db=SNR_DB, seed=seed)
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


def rows(mode: str, found: list[tuple[TouchEvent, Reaction]]) -> list[dict[str, Any]]:
    made = []
    for kind in KINDS:
        of = [reaction for event, reaction in found if event.kind is kind]
        if not of:
            continue
        row: dict[str, Any] = {"mode": mode, "kind": kind.name, "touches": len(of)}
        if kind.speed:
            errors = np.array([e for r in of for e in r.errors_m])
            row |= {"frames": len(errors), "error_at_recv_mm": 1e3 * _quantile(errors, 50)}
            row |= {"velocity_error": _quantile(np.array([v for r in of for v in r.slip]), 50)}
        elif not kind.ramp_s:
            off, force = (np.array([e for r in of for e in getattr(r, name)]) for name in ("held_m", "held_force"))
            row |= {"held_frames": len(off), "held_error_mm": 1e3 * _rms(off), "held_force_error": _rms(force)}
        for what in ("contact", "any", "gone"):
            ms = 1e3 * np.array([getattr(r, f"{what}_s") for r in of])
            # A touch that was never seen counts as one seen after every other.
            ms = np.where(np.isnan(ms), np.inf, ms)
            row |= {f"{what}_seen": int(np.isfinite(ms).sum())}
            row |= {f"{what}_p{q}_ms": _quantile(ms, q) for q in (50, 90, 99)}
        row |= {"wrong": sum(r.wrong for r in of), "unstated": sum(r.unstated for r in of)}
        made.append(row)
    return made


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.percentile(values, q, method="higher")) if len(values) else float("nan")


def _rms(of: NDArray[np.float64]) -> float:
    return float(np.sqrt((of**2).mean())) if len(of) else float("nan")


def goals(table: list[dict[str, Any]], late: dict[str, int]) -> list[Goal]:
    """Gates are counts: of poses that were not solved, of touches that were not seen."""
    found = []
    for row in table:
        name = f"{row['mode']}: {row['kind']}"
        if row["kind"] == STEP:
            share = row["contact_seen"] / row["touches"]
            found.append(Goal(f"{name}: share seen in place", share, at_least=1.0, gate=0.8))
        if row["mode"] == "rolling":  # the others are what it is compared with
            found += _rolling_goals(name, row)
        found.append(Goal(f"{name}: frames before it, off by over 3 sigma", row["wrong"], at_most=0))
    found += _beside_full(table)
    for mode, count in late.items():
        found.append(Goal(f"{mode}: poses that the stub had not solved", count, at_most=0, gate=0))
    return found


def _rolling_goals(name: str, row: dict[str, Any]) -> list[Goal]:
    found = []
    if row["kind"] in TARGETS_MS:
        low, at_low, high, at_high = TARGETS_MS[row["kind"]]
        found.append(Goal(f"{name}: to a valid contact, median, ms", row[f"contact_p{low}_ms"], at_most=at_low))
        found.append(Goal(f"{name}: the same, p{high}, ms", row[f"contact_p{high}_ms"], at_most=at_high))
    if row["kind"] == STEP:
        found.append(Goal(f"{name}: release, median, ms", row["gone_p50_ms"], at_most=GONE_MS[0]))
        found.append(Goal(f"{name}: release, p99, ms", row["gone_p99_ms"], at_most=GONE_MS[1]))
    if row["kind"] in SLIDING:
        found.append(Goal(f"{name}: velocity error, median", row["velocity_error"], at_most=SLIP))
    return found


def _beside_full(table: list[dict[str, Any]]) -> list[Goal]:
    """Rolling scans against full scans of the same touches."""
    by = {(row["mode"], row["kind"]): row for row in table}
    found = []
    for kind in (kind.name for kind in KINDS):
        full, rolling = by.get(("full", kind)), by.get(("rolling", kind))
        if full is None or rolling is None:
            continue
        for key, name, most in (
            ("error_at_recv_mm", "position at recv, error as a share of full scans'", 1 / 3),
            ("held_error_mm", "held, position error as a share of full scans'", 1.0),
            ("held_force_error", "held, force error as a share of full scans'", 1.0),
        ):
            if key in full and key in rolling:
                found.append(Goal(f"rolling: {kind}: {name}", rolling[key] / max(full[key], 1e-9), at_most=most))
    return found


def table(of: list[dict[str, Any]]) -> Table:
    made = Table(title=f"force leaves zero (or is back) to a controller's recv, ms, {machine()}", title_justify="left")
    headings: tuple[str, ...] = ("scan", "touch", "n", "in place", "p50", "p90", "p99", "any p50", "release p50", "p99")
    headings += ("off > 3 sigma", "off > 3 %, no sigma", "mm at recv", "velocity", "held mm", "held force")
    for heading in headings:
        made.add_column(heading, justify="left" if heading in ("scan", "touch") else "right")
    for row in of:
        cells = [row[key] for key in ("contact_p50_ms", "contact_p90_ms", "contact_p99_ms", "any_p50_ms")]
        cells += [row["gone_p50_ms"], row["gone_p99_ms"]]
        slides = [f"{row['error_at_recv_mm']:.2f}", f"{row['velocity_error']:.2f}"] if "frames" in row else ["", ""]
        held = [f"{row['held_error_mm']:.2f}", f"{row['held_force_error']:.2f}"] if "held_frames" in row else ["", ""]
        seen = f"{row['contact_seen']}/{row['touches']}"
        numbers = [f"{v:.1f}" if np.isfinite(v) else "-" for v in cells]
        made.add_row(
            row["mode"],
            row["kind"],
            str(row["touches"]),
            seen,
            *numbers,
            str(row["wrong"]),
            str(row["unstated"]),
            *slides,
            *held,
        )
    return made


def draw(found: dict[str, list[tuple[TouchEvent, Reaction]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(7, 5.4), layout="constrained", sharex=True)
    bins = np.arange(0.0, 205.0, 5.0)
    for axis, name, what in ((axes[0], "contact_s", "to a valid contact in place"), (axes[1], "gone_s", "release")):
        for k, (mode, each) in enumerate(found.items()):
            ms = 1e3 * np.array([getattr(r, name) for event, r in each if event.kind.name == STEP])
            share = np.full(len(ms), 1 / max(len(ms), 1))
            axis.hist(np.where(np.isnan(ms), np.inf, ms).clip(0, 202), bins, weights=share, alpha=0.6, color=f"C{k}")
            axis.plot([], [], color=f"C{k}", lw=6, alpha=0.6, label=f"{mode}, median {np.nanmedian(ms):.0f} ms")
        axis.set(ylabel="share of touches", title=f"{STEP}: {what}")
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    axes[1].set(xlabel="ms (the last bar: later, or never)")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench reaction", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=STEPS, help="of 2 N; the others in proportion")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--simulated", action="store_true", help="in simulated time, without processes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} steps and a few of the others")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    share = (QUICK if args.quick else args.steps) / STEPS
    wanted = {STEP: STEPS, LIGHT: STEPS // 5, FAST_RAMP: RAMPS, SLOW_RAMP: RAMPS, **dict.fromkeys(SLIDING, SLIDES)}
    found, late = {}, {}
    for mode in args.modes:  # each on the same touches
        few = 1 if args.quick else OF_FEWER[mode]
        counts = {name: max(2, round(n * share / few)) for name, n in wanted.items()}
        found[mode], late[mode] = (simulated if args.simulated else measured)(mode, counts, args.seed)
    result = [row for mode, each in found.items() for row in rows(mode, each)]
    Console(width=190).print(table(result))
    listed = goals(result, late)
    Console(width=150).print(_goals.table(listed))
    report = {**provenance("reaction", argv), "targets": [goal.to_dict() for goal in listed], "rows": result}
    report |= {"late_poses": late, "side_m": SIDE_M, "simulated": args.simulated}
    report |= {
        "contact_ms": {m: [1e3 * r.contact_s for e, r in each if e.kind.name == STEP] for m, each in found.items()}
    }
    write_json(args.out / "reaction.json", report)
    draw(found, args.out / "reaction.png")
    print(f"wrote {args.out / 'reaction.json'} and reaction.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
