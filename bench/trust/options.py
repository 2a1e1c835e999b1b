"""Arguments that `skin bench trust` and `skin bench shadow` have in common."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench import REPORTS
from bench.reliability import workers
from bench.trust import runs
from firmware_stub.worlds.table import WORLDS
from models.command import real, whole


def add(parser: argparse.ArgumentParser, minutes: float) -> None:
    """minutes: the default."""
    parser.add_argument("--minutes", type=real(), default=minutes, help="simulated, of each world and kind of scan")
    parser.add_argument("--world", nargs="+", choices=tuple(WORLDS), metavar="WORLD", help="default: every one")
    parser.add_argument("--scan", choices=runs.SCANS, help="whole scans, or scans in parts; default: both")
    parser.add_argument("--seed", help="a text instead of the commit")
    parser.add_argument("--apart-mm", type=real(itself=True), default=28.0, help="least distance of touches (28)")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--cores", type=whole(), default=workers.cores())
    parser.add_argument("--out", type=Path, default=REPORTS)
