"""`skin golden`: do recordings still give the contacts that were accepted?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.common import FAILED, USAGE, fail

ROWS = 20


def register(app: typer.Typer) -> None:
    app.command()(golden)


def golden(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.mcap ...", readable=False)],
    accept: Annotated[bool, typer.Option("--accept", help="Keep what comes out now as what is right.")] = False,
    everything: Annotated[bool, typer.Option("--all", help=f"All differences, not the first {ROWS}.")] = False,
) -> None:
    """Run recordings through the stages and compare the contacts with those accepted before (FILE.golden)."""
    differ = sum([_differs(file, accept, everything) for file in files])
    if differ and not accept:
        fail(f"{differ} of {len(files)} recordings give other contacts: mend it, or accept them with --accept", FAILED)


def _differs(file: Path, accept: bool, everything: bool) -> bool:
    """Whether a recording gives other contacts than those accepted before; says which, and accepts them if told to."""
    from services.recordings import golden as recorded

    if not file.is_file():
        fail(f"no file {file}: expected a recording, FILE.mcap", USAGE)
    if file.suffix != ".mcap":
        fail(f"{file} is no recording: expected FILE.mcap", USAGE)
    before, now = _before(file, accept), recorded.run(file)
    differences = []
    if before is not None:
        found = recorded.compare(before, now)
        differences = found.differences
        rows = len(differences) if everything else ROWS
        verdict = f"{found.differing} differ from {recorded.golden_file(file).name}" if differences else "as accepted"
        print(f"{file}: {found.frames} frames, {verdict}")
        for line in (*map(str, differences[:rows]), *_more(len(differences), rows), *found.summary()):
            print(f"  {line}")
    if accept:
        try:
            print(f"accepted: {recorded.accept(file, now)}")
        except OSError as why:
            fail(f"cannot write {recorded.golden_file(file)}: {why.strerror}")
    return bool(differences)


def _before(file: Path, accept: bool) -> list[dict[str, object]] | None:
    """What was accepted; None where that cannot be read and is to be replaced."""
    from services.recordings import golden as recorded
    from services.recordings.recording import RecordingError

    try:
        return recorded.accepted(file)
    except RecordingError:
        if accept:
            return None
        raise


def _more(count: int, rows: int) -> list[str]:
    return [f"and {count - rows} more: --all"] if count > rows else []
