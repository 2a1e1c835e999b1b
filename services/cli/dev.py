"""`skin dev same`: does a change leave every frame as it was? `skin dev numbers`, `skin dev size`: how much there is to
read of the estimator. For whoever works on a checkout.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from services.cli.common import ROOT, USAGE, fail


def register(app: typer.Typer) -> None:
    dev = typer.Typer(help="For whoever changes a checkout.", no_args_is_help=True)
    dev.command()(same)
    dev.command()(numbers)
    dev.command()(size)
    app.add_typer(dev, name="dev")


def same(
    against: Annotated[
        Path | None, typer.Option("--against", metavar="DIR|FILE", help="Another checkout, or what --keep wrote.")
    ] = None,
    keep: Annotated[Path | None, typer.Option("--keep", metavar="FILE", help="Write what came out.")] = None,
    only: Annotated[str, typer.Option("--only", metavar="TEXT", help="Scenes with this in their names.")] = "",
) -> None:
    """Play fixed scenes, and say of each a hash of every field of every frame, and where it first differs."""
    from bench import same as scenes

    if against is not None and not against.exists():
        fail(f"--against: no {against}: expected another checkout, or a file of --keep", USAGE)
    with tempfile.TemporaryDirectory() as folder:
        ours = keep if keep is not None else Path(folder, "ours")
        _play(ROOT, ours.resolve(), only)
        theirs = against
        if against is not None and against.is_dir():
            theirs = Path(folder, "theirs")
            _play(against.resolve(), theirs, only)
        found = scenes.read(ours)
        others = found if theirs is None else scenes.read(theirs, only)
    differing = 0
    for name in found | others:
        lines = found.get(name, [])
        differs = scenes.difference(lines, others.get(name, []))
        print(f"{scenes.digest(lines)} {len(lines):6} {name}" + f": {differs}" * bool(differs))
        differing += bool(differs)
    print(scenes.digest([line for lines in found.values() for line in lines]), "in all")
    if differing:
        fail(f"{differing} of {len(found | others)} scenes differ")


def numbers() -> None:
    """Every number of the estimator that decides something: its tables, and literals elsewhere."""
    from bench import estimator_size

    found = estimator_size.numbers(estimator_size.files())
    for each in found:
        print(f"{each.where:58} {each.name:24} {each.value:<10g} {each.unit:8} {each.meaning}  [{each.origin}]")
    kinds = Counter(each.kind for each in found)
    print(", ".join(f"{count} {kind}" for kind, count in kinds.most_common()))


def size() -> None:
    """Lines, files and numbers of the estimator, and through how many files a scan runs."""
    from bench import estimator_size as of

    own, more = of.files(), of.files(of.HANGS_ON)
    print(f"{of.lines(own)} lines in {len(own)} files of {' and '.join(of.AREAS)}")
    print(f"{of.lines(own + more)} with stages, contacts, mounting, locator and response files")
    print(f"{of.not_derived(of.numbers(own))} numbers that are not derived from others")
    for scan, names in of.files_of_scans().items():
        within = sum(name.startswith(of.AREAS) for name in names)
        print(f"a {scan} whole scan runs through {len(names)} files, {within} of them of the estimator")


def _play(checkout: Path, out: Path, only: str) -> None:
    """In a process of the checkout's own, pinned as its tests are."""
    from tests.pinned import pin

    pin()
    python = checkout / ".venv" / "bin" / "python"
    words = [str(python) if python.exists() else sys.executable, "-P", "-m", "bench.same", str(out), only]
    if subprocess.run(words, cwd=checkout, env=os.environ | {"PYTHONPATH": str(checkout)}).returncode:
        fail(f"{checkout}: the scenes could not be played: what went wrong is above")
