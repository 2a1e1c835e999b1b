"""Memory over many frames through the stages in one process, half of them touched: it must not grow.

    skin bench memory [--frames 1000000]

Prints resident memory after a tenth of the frames and at the end, writes memory.json.
"""

from __future__ import annotations

import argparse
import gc
import os
from pathlib import Path

from bench import REPORTS
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.skip import run_once, scenes
from models.bundle import Bundle
from models.command import whole
from services.pipeline import build_stages
from services.runtime.config import Skin

GROWTH = 0.01  # of the memory after a tenth of the frames
GATE = 0.05  # of a short run, whose tenth is still warming up
SCENE_S = 20.0


def memory(frames: int) -> dict[str, float]:
    """Resident memory [MB] of the stages after a tenth of the frames and after all of them, half of them touched."""
    recorded, bundle = scenes(SCENE_S), Bundle.load("square16")
    stages = build_stages("palm", Skin(port="stub", bundle="square16", frame_id="palm"), bundle)
    turns = [recorded["untouched"], recorded["moving"]]
    found: dict[str, float] = {}
    done = 0
    while done < frames:
        for scene in turns:
            for k in range(len(scene)):
                run_once(stages, scene.frame(k))
                done += 1
                if done == frames // 10:
                    found["first_mb"] = _resident_mb()
    found["last_mb"] = _resident_mb()
    found["growth"] = found["last_mb"] / found["first_mb"] - 1
    found["frames"] = done
    return found


def _resident_mb() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench memory", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--frames", type=whole(), default=1_000_000)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    found = memory(args.frames)
    print("{frames:.0f} frames: {first_mb:.1f} MB after a tenth, {last_mb:.1f} MB at the end".format(**found))
    goals = [
        Goal("growth of resident memory", found["growth"], at_most=GROWTH, gate=GATE),
        Goal("frames", found["frames"]),
    ]
    write_json(args.out / "memory.json", provenance("memory", argv) | {"targets": [g.to_dict() for g in goals]} | found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
