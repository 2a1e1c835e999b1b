"""False touches: an untouched skin that drifts, scanned in parts, for hours of simulated time.

    skin bench untouched_parts [--hours 3] [--chunk-minutes 10] [--seed 1] [--quick]

Board, link and stages in one process. The sheet's background drifts by 1e-5 a second and two contacts by 1e-4, as
those of a drying gel do; each chunk begins with a fresh skin and noise of its own. Every contact in a valid frame is a
false touch. What ran is kept in untouched_parts.json after each chunk, with its commit, and the same command goes on
from there; chunks of another commit are forgotten unless --mixed says that they count too.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.service import end_on_sigterm
from bench.speed.simulated_host import SimulatedHost
from models.command import real, whole

SNR_DB = 80.0
BASELINE_S = 7.0
DRIFT_HZ, CONTACT_HZ = 1e-5, 1e-4  # relative, of the background and of two contacts
AGING = (3, 13)
LEAST_S = 10.0  # of a chunk
QUICK_HOURS = 1 / 6


def scene(seconds: float) -> str:
    """A scene's TOML: nothing touches and everything drifts."""

    def keys(rate: float) -> str:
        return f"[{{ t = 0.0, value = 1.0 }}, {{ t = {seconds!r}, value = {1.0 + rate * seconds!r} }}]"

    contacts = "".join(f"[[drift.contact]]\nelectrode = {k}\nkeys = {keys(CONTACT_HZ)}\n" for k in AGING)
    return f'about = "nothing touches"\nduration = {seconds!r}\n[drift]\nbackground = {keys(DRIFT_HZ)}\n{contacts}'


def chunk(seconds: float, seed: int) -> dict[str, Any]:
    """What an untouched skin's contact frames said in this time."""
    host, cpu = SimulatedHost("rolling", snr_db=SNR_DB, seed=seed), time.process_time()
    host.until(BASELINE_S)
    with tempfile.TemporaryDirectory(prefix="eitskin-untouched") as folder:
        script = Path(folder) / "untouched.toml"
        script.write_text(scene(seconds + 1.0))
        host.rig.play(str(script), host.now)
    first, start = len(host.contacts), host.contacts[-1][1].scan
    host.until(host.now + seconds)
    frames = [frame for _, frame in host.contacts[first:]]
    host.rig.close()
    touches = sum(bool(frame.contacts) for frame in frames if frame.valid)
    return {
        "seed": seed,
        "seconds": seconds,
        "parts": host.contacts[-1][1].scan - start,
        "frames": len(frames),
        "invalid": sum(not frame.valid for frame in frames),
        "false_touches": touches,
        "cpu_s": time.process_time() - cpu,
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench untouched_parts", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--hours", type=real(), default=3.0, help="of simulated time, in all")
    parser.add_argument("--chunk-minutes", type=real(), default=10.0)
    parser.add_argument("--seed", type=whole(0), default=1, help="of the first chunk; each has the next one")
    parser.add_argument("--anew", action="store_true", help="forget what ran before")
    parser.add_argument("--mixed", action="store_true", help="what ran at other commits counts too")
    parser.add_argument("--quick", action="store_true", help="the ten minutes of CI")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    path, seconds = args.out / "untouched_parts.json", max(LEAST_S, 60 * args.chunk_minutes)
    kept = {} if args.anew or not path.exists() else json.loads(path.read_text(encoding="utf-8"))
    own, hours = provenance("untouched_parts", argv), QUICK_HOURS if args.quick else args.hours
    done: list[dict[str, Any]] = [c for c in kept.get("chunks", []) if args.mixed or c.get("commit") == own["commit"]]
    while sum(each["seconds"] for each in done) < 3600 * hours:
        done.append({**chunk(seconds, args.seed + len(done)), "commit": own["commit"]})
        write_json(path, {**own, "targets": [goal(done).to_dict()], "chunks": done, **totals(done)})
        print(f"{totals(done)['hours']:.2f} h, false touches: {totals(done)['false_touches']}", flush=True)
    found = totals(done)
    print(f"{found['hours']:.2f} simulated hours, {found['parts']} parts, {found['cpu_s'] / 60:.0f} minutes of CPU")
    Console(width=120).print(_goals.table([goal(done)]))
    return 0


def goal(chunks: list[dict[str, Any]]) -> Goal:
    found = totals(chunks)
    figure = f"frames with a false touch, of {found['hours']:.2f} h of scans in parts with drift"
    return Goal(figure, found["false_touches"], at_most=0, gate=0)


def totals(chunks: list[dict[str, Any]]) -> dict[str, Any]:
    of = {name: sum(each[name] for each in chunks) for name in ("parts", "frames", "invalid", "false_touches", "cpu_s")}
    return {"hours": sum(each["seconds"] for each in chunks) / 3600, **of}


if __name__ == "__main__":
    raise SystemExit(main())
