"""Commands about recordings: record, replay, import."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.common import (
    USAGE,
    JsonOption,
    emit,
    fail,
    load_npz,
    of_service,
    skin_name,
    use_configured_sockets,
)

RecordedSkin = Annotated[str, typer.Option("--skin", help="Which skin; default: all.", metavar="NAME")]

if TYPE_CHECKING:
    from protocol.frames import ContactFrame


def register(app: typer.Typer) -> None:
    app.command()(of_service(record))
    app.command()(of_service(replay, starts=True))
    app.command("import")(import_file)


def record(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap")],
    seconds: Annotated[float, typer.Option(help="Stop after so long; 0: at Ctrl-C.")] = 0.0,
    topics: Annotated[str, typer.Option(help="Which topics; naming a lazy one wakes it.")] = "raw,contact,status,info",
    skin: RecordedSkin = "",
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    as_json: JsonOption = False,
) -> None:
    """Record a running service. A file cut short by a kill or a full disk still replays."""
    import signal
    import threading
    import time

    from rich.console import Console

    from services.recorder import Recorder

    use_configured_sockets()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    console = Console(stderr=True)
    end = time.monotonic() + seconds if seconds > 0 else float("inf")
    with Recorder(file, topics.split(","), skin or None, overwrite) as recorder:
        with console.status(f"recording to {file}") as status:
            while not stop.is_set() and time.monotonic() < end:
                recorder.step(0.1)
                counts = ", ".join(f"{topic} {n}" for topic, n in recorder.writer.counts.items())
                said = f"  {recorder.problem}" if recorder.problem else ""
                status.update(f"recording to {file}: {counts or 'nothing yet'}{said}  (Ctrl-C ends it)")
    size = file.stat().st_size
    result = {"file": str(file), "messages": recorder.writer.counts, "gaps": recorder.gaps, "bytes": size}
    if recorder.problem:
        print(f"skin: {file}: {recorder.problem}", file=sys.stderr)
    if as_json:
        emit(result)
    else:
        counts = ", ".join(f"{topic} {n}" for topic, n in recorder.writer.counts.items())
        print(f"{file}: {counts or 'nothing'}; {size / 1e6:.1f} MB; {recorder.gaps} messages missed")
    if not recorder.writer.counts:
        fail("nothing was recorded: is the service running (`skin up`)?", 3)


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap")],
    speed: Annotated[float, typer.Option(help="So many times the recorded speed.")] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as the stages can.")] = False,
    start: Annotated[float, typer.Option("--from", help="Begin so many seconds into the file.")] = 0.0,
    out: Annotated[Path | None, typer.Option(help="Write the contacts that come out to this recording.")] = None,
    private: Annotated[bool, typer.Option("--private", help="Use a runtime folder of its own.")] = False,
    bundle: Annotated[Path | None, typer.Option(help="Use this one, not the recorded one (found by its hash).")] = None,
    skin: RecordedSkin = "",
    as_json: JsonOption = False,
) -> None:
    """Feed a recording's raw frames through the stages, losslessly; contacts come out as usual, marked `replay`.

    With `skin up --no-board` running it feeds those stages; with nothing running it brings up its own.
    """
    if speed <= 0:
        fail(f"found --speed {speed:g}, expected a number above 0 (or --fast)", USAGE)
    from services.recordings.replay_session import replay_file

    report = replay_file(file, None if fast else speed, start, skin, out, private, progress=_bar, bundle=bundle)
    for warning in report["warnings"]:
        print(f"skin: {warning}", file=sys.stderr)
    if as_json:
        emit(report)
    else:
        said = "{frames} frames in {seconds:.1f} s, {contacts} contact frames, {valid} of them valid, {touched} touched"
        print(said.format(**report))
        if report["damage"] != "whole":
            print(f"the file is {report['damage']}")


def _bar(contacts: Iterator[ContactFrame], total: int) -> Iterator[ContactFrame]:
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(
        contacts, "replaying", total=total, console=console, transient=True, disable=not console.is_terminal
    )


def import_file(
    source: Annotated[Path, typer.Argument(metavar="FILE.npz")],
    target: Annotated[Path, typer.Argument(metavar="OUT.mcap")],
    skin: Annotated[
        str,
        typer.Option("--skin", help="A configured skin, or a bundle; default: the first of skin.toml.", metavar="NAME"),
    ] = "",
    rate: Annotated[float, typer.Option(help="Frames per second to give the recording.")] = 10.0,
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    as_json: JsonOption = False,
) -> None:
    """Turn an npz of measurements into a recording that replays like any other.

    Either measurements (n, k) with untouched (m, k), which then are one scan after the other, or with reference (n, k);
    or presses as published with the hydrogel skin: untouched (n, k), touched (n, k). These and references are separate
    scans, of which none follows another in time. pattern (k, 4), where the file has it, says their order.
    """
    from services.recordings.importing import import_arrays

    report = import_arrays(load_npz(source), source, target, skin or skin_name(""), rate, overwrite)
    if as_json:
        emit(report)
    else:
        print("{file}: {frames} frames of {measurements} measurements, {seconds:.1f} s".format(**report))
