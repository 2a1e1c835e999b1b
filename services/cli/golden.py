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
    from services.recordings import golden as recorded

    differ = 0
    for file in files:
        if not file.is_file():
            fail(f"no file {file}: expected a recording, FILE.mcap", USAGE)
        if file.suffix != ".mcap":
            fail(f"{file} is no recording: expected FILE.mcap", USAGE)
        before = _before(file, accept)
        now = recorded.run(file)
        found = recorded.compare(before, now) if before is not None else None
        if found is not None:
            rows = len(found.differences) if everything else ROWS
            same = not found.differences
            said = "as accepted" if same else f"{found.differing} differ from {recorded.golden_file(file).name}"
            print(f"{file}: {found.frames} frames, {said}")
            for line in (*map(str, found.differences[:rows]), *_more(len(found.differences), rows), *found.summary()):
                print(f"  {line}")
            differ += not same
        if accept:
            try:
                print(f"accepted: {recorded.accept(file, now)}")
            except OSError as why:
                fail(f"cannot write {recorded.golden_file(file)}: {why.strerror}")
    if differ and not accept:
        fail(f"{differ} of {len(files)} recordings give other contacts: mend it, or accept them with --accept", FAILED)


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
