"""What `[realtime]` of skin.toml buys: from a press of 2 N to the contact, live, on an idle and on a busy machine.

    skin bench realtime [--presses 60] [--rounds 2] [--quick]

Busy: one program for each core that does nothing but count, at normal priority. Real processes, a controller at normal
priority, scans in parts; the settings one after another in each round, on the same presses. Prints the table and
writes realtime.json.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.reaction import measured
from bench.speed.reaction_events import Reaction
from bench.speed.reaction_report import STEP, waited
from bench.speed.service import end_on_sigterm
from models.command import whole

PRESSES, ROUNDS = 60, 2
QUICK = 4
SETTINGS = {
    "none": "",
    "SCHED_FIFO": "[realtime]\npriority = 20\n",
    "SCHED_FIFO, mlockall": "[realtime]\npriority = 20\nlock_memory = true\n",
}
"""Of [realtime], in skin.toml."""
COUNT = "while True: pass"


@contextmanager
def busy(programs: int) -> Iterator[None]:
    """So many programs count until the block ends."""
    running = [subprocess.Popen([sys.executable, "-c", COUNT]) for _ in range(programs)]
    try:
        yield
    finally:
        for each in running:
            each.kill()
            each.wait()


def run(presses: int, rounds: int, seed: int) -> list[dict[str, Any]]:
    """A row of each machine and setting."""
    cores = len(os.sched_getaffinity(0))
    found: dict[tuple[str, str], list[Reaction]] = {}
    for n in range(rounds):
        for title, programs in (("idle", 0), (f"{cores} cores busy", cores)):
            for setting, more in SETTINGS.items():
                with busy(programs):
                    events, _ = measured("rolling", {STEP: presses}, seed + n, more)
                found.setdefault((title, setting), []).extend(reaction for _, reaction in events)
    return [{"machine": title, "realtime": name, **_figures(of)} for (title, name), of in found.items()]


def _figures(of: list[Reaction]) -> dict[str, Any]:
    return {"presses": len(of), "late_frames": sum(each.late for each in of), **waited(of)}


def table(rows: list[dict[str, Any]]) -> Table:
    made = Table(title=f"2 N begins, to a controller's recv, ms, {machine()}", title_justify="left")
    for heading in ("machine", "realtime", "first near p50", "p99", "in place p50", "p99", "gone p50", "p99", "late"):
        made.add_column(heading, justify="left" if heading in ("machine", "realtime") else "right")
    for row in rows:
        times = [f"{row[f'{what}_p{q}_ms']:.0f}" for what in ("near", "contact", "gone") for q in (50, 99)]
        made.add_row(row["machine"], row["realtime"], *times, str(row["late_frames"]))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench realtime", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--presses", type=whole(1), default=PRESSES, help="of each row, in a round")
    parser.add_argument("--rounds", type=whole(1), default=ROUNDS)
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} presses, one round")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    rows = run(QUICK, 1, args.seed) if args.quick else run(args.presses, args.rounds, args.seed)
    Console(width=150).print(table(rows))
    write_json(args.out / "realtime.json", {**provenance("realtime", argv), "rows": rows})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
