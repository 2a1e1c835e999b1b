"""Arguments that `skin bench trust` and `skin bench shadow` have in common."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench import REPORTS
from bench.reliability import workers
from bench.trust import runs
from firmware_stub.worlds.table import WORLDS


def add(parser: argparse.ArgumentParser, minutes: float) -> None:
    """minutes: the default."""
    parser.add_argument("--minutes", type=float, default=minutes, help="simulated, of each world and kind of scan")
    parser.add_argument("--world", nargs="+", choices=tuple(WORLDS), metavar="WORLD", help="default: every one")
    parser.add_argument("--scan", choices=runs.SCANS, help="whole scans, or scans in parts; default: both")
    parser.add_argument("--seed", help="a text instead of the commit")
    parser.add_argument("--apart-mm", type=float, default=28.0, help="least distance of two touches (default: 28)")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--cores", type=int, default=workers.cores())
    parser.add_argument("--out", type=Path, default=REPORTS)
