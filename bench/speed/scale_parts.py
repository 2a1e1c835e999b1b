"""Many skins whose scans come in parts, on one set of processes: latency, CPU, and whether every part is accounted for.

    skin bench scale_parts [--skins 8] [--touched 0.25] [--seconds 15]

As `skin bench scale`, with recordings of a board that measures with DFTs of 256 points: some 120 parts a second. A
part makes a contact frame only while something touches, so it is counted in preprocessing: each part played is to be
taken by it or counted as dropped. Prints a table, writes scale_parts.json.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.scale import MARGIN_S, START_S, STATUS_S, Traffic, listen, wait_for_touch, written
from bench.speed.service import end_on_sigterm, running
from bench.speed.skip import scripts
from bench.tracking.host import Host
from firmware_stub.rig import Rig
from models.command import real, whole
from protocol.frames import RawFrame
from services.runtime.config import Skin

DFT_POINTS: Literal[256] = 256
SETTINGS = f'scan = "rolling"\ndft_points = {DFT_POINTS}\n'
SNR_DB = 80.0
TARGET_MS = 20.0
TARGET_SKINS = 8
EDGE_S = 0.03  # a status is not made at a part's end: so much of the parts may be on their way


@lru_cache(maxsize=1)
def parts(seconds: float) -> dict[str, list[RawFrame]]:
    """The raw frames of an untouched skin, and of one on which a touch moves from START_S on."""
    found: dict[str, list[RawFrame]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("untouched", "moving"):
            path = Path(folder, f"{name}.toml")
            path.write_text(scripts(seconds, START_S)[name])
            skin = Skin(port="stub", bundle="square16", scan="rolling", dft_points=DFT_POINTS)
            host = Host(Rig("square16", scene=str(path), snr_db=SNR_DB, seed=3), seed=3, skin=skin)
            found[name] = []
            while host.now < START_S + seconds:
                found[name] += [frame for frame, _ in host.step()]
            host.rig.close()
    return found


def measured(n: int, touched: float, seconds: float) -> dict[str, Any]:
    """What a controller sees of n skins, a share `touched` of them with a moving touch, and the fate of the parts."""
    played = parts(seconds + 2 * STATUS_S + MARGIN_S)
    step_ns = float(np.median(np.diff([frame.stamps["sample"] for frame in played["untouched"]])))
    with tempfile.TemporaryDirectory(prefix="eitskin-scale") as folder:
        path, moving = written(Path(folder), n, touched, played, 1e-9 * step_ns, SETTINGS)
        with running("--config", str(path), skin="s00") as service:
            wait_for_touch(service, touched)
            return {
                "skins": n,
                "touched": moving / n,
                "rate_hz": 1e9 / step_ns,
                **accounted(listen(service, seconds), step_ns),
            }


def accounted(traffic: Traffic, step_ns: float) -> dict[str, Any]:
    """What became of the parts, of which one was played each step_ns."""
    played, taken, dropped = 0.0, 0, Counter[str]()
    for (process, _), said in traffic.said.items():
        dropped[process] += said.dropped
        if process == "preprocessing":
            played += (said.seconds - EDGE_S) * 1e9 / step_ns
            taken += said.counted("frames") + said.dropped
        elif process == "acquisition":
            taken += said.dropped + said.counted("overrun")
    uncounted = max(0.0, played - taken) + traffic.missing
    return {**traffic.row(), "parts": taken, "dropped": dict(dropped), "uncounted": round(uncounted)}


def goals(rows: list[dict[str, Any]]) -> list[Goal]:
    found = []
    for row in rows:
        which = f"{row['skins']} skins at {row['rate_hz']:.0f} parts/s, {100 * row['touched']:.0f} % touched"
        target = TARGET_MS if row["skins"] == TARGET_SKINS else None
        found.append(Goal(f"{which}: p99, ms", row["p99_ms"], at_most=target))
        found.append(Goal(f"{which}: skins not seen", row["skins"] - row["skins_seen"], at_most=0, gate=0))
        found.append(Goal(f"{which}: parts that no status accounts for", row["uncounted"], at_most=0, gate=0))
        found.append(Goal(f"{which}: share of parts overtaken", sum(row["dropped"].values()) / max(row["parts"], 1)))
        found.append(Goal(f"{which}: cores", row["cores"]))
    return found


def table(rows: list[dict[str, Any]]) -> Table:
    made = Table(title=f"skins with scans in parts, from recordings, {machine()}", title_justify="left")
    for heading in ("skins", "touched", "parts", "dropped by", "uncounted", "contacts", "p50 ms", "p99 ms", "cores"):
        made.add_column(heading, justify="right")
    for row in rows:
        dropped = ", ".join(f"{name} {count}" for name, count in row["dropped"].items() if count)
        cells = [str(row["parts"]), dropped or "none", str(row["uncounted"]), str(row["frames"])]
        times = [f"{row[key]:.2f}" for key in ("p50_ms", "p99_ms", "cores")]
        made.add_row(str(row["skins"]), f"{100 * row['touched']:.0f} %", *cells, *times)
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench scale_parts", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--skins", type=whole(), nargs="+", default=[1, 4, TARGET_SKINS])
    parser.add_argument("--seconds", type=real(), default=15.0, help="of each measurement")
    parser.add_argument("--touched", type=real(itself=True), default=0.25, help="share of the skins")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    rows = [measured(n, args.touched, args.seconds) for n in args.skins]
    Console(width=130).print(table(rows))
    wanted = goals(rows)
    Console(width=130).print(_goals.table(wanted))
    report = {**provenance("scale_parts", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    write_json(args.out / "scale_parts.json", report)
    print(f"wrote {args.out / 'scale_parts.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
