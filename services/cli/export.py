"""`skin export FILE.mcap`: a recording in the formats of others."""

from __future__ import annotations

import contextlib
import importlib.util
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.whole_file import whole_file
from services.cli.common import USAGE, JsonOption, check_whole, emit, fail

if TYPE_CHECKING:
    from bridges.export.entries import Logged
    from services.recordings.recording import RecordingReader

SUFFIXES = {"foxglove": ".foxglove.mcap", "ros2": ".ros2.mcap", "csv": ".csv", "rerun": ".rrd"}
NEEDS = {
    "foxglove": ("foxglove", "make venv EXTRAS=foxglove"),
    "ros2": ("rosbags", "make venv EXTRAS=ros2"),
    "rerun": ("rerun", ".venv/bin/pip install rerun-sdk"),
}


def register(app: typer.Typer) -> None:
    app.command()(export)


def export(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", readable=False)],
    foxglove: Annotated[bool, typer.Option("--foxglove", help="MCAP with Foxglove's schemas.")] = False,
    ros2: Annotated[bool, typer.Option("--ros2", help="MCAP as rosbag2 writes it, topics of docs/ros.md.")] = False,
    table: Annotated[bool, typer.Option("--csv", help="CSV, and an npz beside it: a row per contact.")] = False,
    rerun: Annotated[bool, typer.Option("--rerun", help="An .rrd file, where rerun-sdk is installed.")] = False,
    out: Annotated[Path | None, typer.Option(help="Default: beside FILE, by its name.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    skin: Annotated[str, typer.Option("--skin", help="Only this skin.", metavar="NAME")] = "",
    as_json: JsonOption = False,
) -> None:
    """Write a recording in another format. What a recording does not hold (images, say) is not in it either."""
    chosen = {"foxglove": foxglove, "ros2": ros2, "csv": table, "rerun": rerun}
    kinds = [kind for kind, wanted in chosen.items() if wanted]
    if len(kinds) != 1:
        fail(f"found {len(kinds)} formats, expected one of --{', --'.join(SUFFIXES)}", USAGE)
    (kind,) = kinds
    if not file.is_file():
        fail(f"no file {file}: expected a recording, FILE.mcap", USAGE)
    if kind in NEEDS and importlib.util.find_spec(NEEDS[kind][0]) is None:
        fail(f"--{kind} needs the package {NEEDS[kind][0]}, which is not installed: {NEEDS[kind][1]}", USAGE)
    target = out or file.with_suffix(SUFFIXES[kind])
    made = [target, target.with_suffix(".npz")] if kind == "csv" else [target]
    for path in made:
        if path.exists() and not overwrite:
            fail(f"{path} is there already: choose another name with --out, or say --overwrite", USAGE)
        if path.resolve() == file.resolve():
            fail(f"{path} is the recording itself: choose another name with --out", USAGE)
    _written(kind, file, skin, made, as_json)


def _written(kind: str, file: Path, skin: str, made: list[Path], as_json: bool) -> None:
    """What is there already stays until the new one is whole."""
    from services.recordings.recording import RecordingReader

    reader = RecordingReader(file)
    try:
        with contextlib.ExitStack() as places:
            parts = [places.enter_context(whole_file(path)) for path in made]
            counts = _write(kind, reader, skin, parts)
            if not counts:
                fail(f"{file}: found no frame{f' of {skin}' if skin else ''} that --{kind} could write", USAGE)
    except OSError as error:
        fail(f"cannot write {made[0]}: {error.strerror}")
    if as_json:
        emit({"files": [str(path) for path in made], "messages": dict(counts)})
    else:
        said = ", ".join(f"{topic} {n}" for topic, n in counts.items())
        print(f"{', '.join(map(str, made))}: {said}")
    check_whole(file, reader.damage)


def _write(kind: str, reader: RecordingReader, skin: str, parts: list[Path]) -> Counter[str]:
    from bridges.export.entries import timed

    entries = timed(lambda: _frames(reader, skin))
    if kind == "csv":
        from bridges.export.to_table import write_table

        return +Counter({"rows": write_table(entries, *parts)})
    if kind == "ros2":
        from bridges.export.to_ros2 import write_ros2

        return write_ros2(entries, parts[0])
    if kind == "foxglove":
        from bridges.export.to_foxglove import write_foxglove

        return write_foxglove(entries, parts[0])
    from bridges.export.to_rerun import write_rerun

    return write_rerun(entries, parts[0])


def _frames(reader: RecordingReader, skin: str) -> Iterator[Logged]:
    """The frames of a recording, of one skin or all; what is none is left out."""
    from protocol.frames import FrameError, unpack

    for message in reader.messages({"contact", "image", "shape", "status", "info"}):
        try:
            frame = unpack(message.wire)
        except FrameError:
            continue
        if not skin or frame.skin == skin:
            yield message.log_time_ns, frame
