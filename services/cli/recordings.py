"""Commands about recordings: record, snapshot, replay, import."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.errors import INCOMPLETE
from protocol.pause import pause
from services.cli.common import (
    USAGE,
    JsonOption,
    config_file,
    control,
    emit,
    fail,
    of_service,
    skin_name,
    use_configured_sockets,
)
from services.cli.rows import ColumnsOption, PatternOption, UntouchedOption, say_understood

DAYS_S = 1e7  # of a recording, at most

RecordedSkin = Annotated[str, typer.Option("--skin", help="Which skin; default: all.", metavar="NAME")]

if TYPE_CHECKING:
    from protocol.frames import ContactFrame
    from services.recordings.recorder import Recorder
    from services.recordings.triggers import Trigger


def register(app: typer.Typer) -> None:
    app.command()(of_service(record))
    app.command()(of_service(snapshot))
    app.command()(of_service(replay, starts=True))
    app.command("import")(import_file)


def record(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="With --trigger: a folder, a file for each event.")],
    seconds: Annotated[float, typer.Option(min=0, max=DAYS_S, help="Stop after so long; 0: at Ctrl-C.")] = 0.0,
    topics: Annotated[
        str, typer.Option(help="Which topics; naming a lazy one wakes it.")
    ] = "raw,contact,status,info,reference",
    skin: RecordedSkin = "",
    file_mb: Annotated[float, typer.Option(min=0, help="Go on in FILE-2.mcap when FILE is so large; 0: never.")] = 0.0,
    file_minutes: Annotated[float, typer.Option(min=0, help="Likewise, when it is so long.")] = 0.0,
    keep: Annotated[int, typer.Option(min=0, help="Keep so many files, delete the oldest; 0: keep all.")] = 0,
    trigger: Annotated[
        list[str] | None, typer.Option(help="contact or fault: write only the time round each, to a folder.")
    ] = None,
    before: Annotated[float, typer.Option(min=0, help="With --trigger: so many seconds before it.")] = 10.0,
    after: Annotated[float, typer.Option(min=0, help="With --trigger: so many seconds after it.")] = 5.0,
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    as_json: JsonOption = False,
) -> None:
    """Record a running service. A file cut short by a kill or a full disk still replays."""
    import signal
    import threading
    import time

    from rich.console import Console

    from services.recordings.recorder import Recorder
    from services.recordings.rotation import Rotation
    from services.recordings.snapshots import Keeping

    wanted = _triggers(trigger or [], file, before, after)
    use_configured_sockets()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    console = Console(stderr=True)
    end = time.monotonic() + seconds if seconds > 0 else float("inf")
    rotation = Rotation(int(file_mb * 1e6), file_minutes * 60, keep)
    keeping = Keeping(file, before, after, triggers=wanted, keep=keep) if wanted else None
    what = f"waiting for a {' or a '.join(wanted)}, to {file}" if wanted else f"recording to {file}"
    with Recorder(
        None if wanted else file, topics.split(","), skin or None, overwrite, rotation, keeping, config_file()
    ) as recorder:
        with console.status(what) as status:
            while not stop.is_set() and time.monotonic() < end:
                recorder.step(0.1)
                problem = f"  {recorder.problem}" if recorder.problem else ""
                status.update(f"{what}: {_counted(recorder) or 'nothing yet'}{problem}  (Ctrl-C ends it)")
    _print_recorded(file, recorder, as_json)
    if recorder.problem:
        fail(f"{file}: {recorder.problem}", INCOMPLETE)
    if not recorder.received:
        fail("nothing was recorded: is the service running (`skin up`)?", 3)


def _triggers(wanted: list[str], folder: Path, before: float, after: float) -> tuple[Trigger, ...]:
    """The triggers that are wanted, in the order of TRIGGERS; refuses what is none, and what does not go with them."""
    from services.recordings.snapshots import LONGEST_S
    from services.recordings.triggers import TRIGGERS

    if set(wanted) - set(TRIGGERS):
        fail(f"found --trigger {' '.join(wanted)}, expected some of {', '.join(TRIGGERS)}", USAGE)
    if wanted and (folder.suffix == ".mcap" or folder.is_file()):
        fail(f"found the file {folder}, but --trigger writes a file for each event: name a folder", USAGE)
    if not 0 < before <= 600 or after > LONGEST_S:
        fail(f"found --before {before:g} --after {after:g}, expected above 0 to 600 and 0 to {LONGEST_S:g} s", USAGE)
    return tuple(name for name in TRIGGERS if name in wanted)


def _print_recorded(file: Path, recorder: Recorder, as_json: bool) -> None:
    result: dict[str, Any] = {"file": str(file), "messages": _counts(recorder), "gaps": recorder.gaps}
    if (writer := recorder.writer) is not None:
        result |= {"bytes": writer.bytes, "files": writer.files, "deleted": writer.deleted, "unwritten": writer.lost}
    if (taken := recorder.snapshots) is not None:
        result |= {"snapshots": taken.taken, "missed": taken.missed, "deleted": taken.deleted, "unwritten": taken.lost}
    if as_json:
        emit(result)
    elif taken is not None:
        print(f"{file}: {taken.taken} snapshots, {taken.missed} could not be taken, {taken.deleted} old ones deleted")
    else:
        files = f" in {result['files']} files" if result["files"] > 1 else ""
        size = f"{result['bytes'] / 1e6:.1f} MB{files}"
        missed = f"{recorder.gaps} messages missed, {result['unwritten']} not written"
        print(f"{file}: {_counted(recorder) or 'nothing'}; {size}; {missed}")


def _counts(recorder: Recorder) -> dict[str, int]:
    """Messages by topic: those recorded, or where snapshots alone are taken, those that came."""
    if recorder.writer is not None:
        return recorder.writer.counts
    return {f"{topic}/{name}": n for (topic, name), n in recorder.received.items()}


def _counted(recorder: Recorder) -> str:
    return ", ".join(f"{topic} {n}" for topic, n in _counts(recorder).items())


def snapshot(
    before: Annotated[float | None, typer.Option(min=0, help="So many of the last seconds; default: all kept.")] = None,
    after: Annotated[float | None, typer.Option(min=0, help="And so many from now on; default: as configured.")] = None,
    why: Annotated[str, typer.Option(help="A word on it, kept in the file.")] = "",
    as_json: JsonOption = False,
) -> None:
    """Write the last seconds and the next ones to a file that replays. The service's recorder does."""
    import time

    wanted = {name: value for name, value in (("before_s", before), ("after_s", after)) if value is not None}
    made = control("recorder", "snapshot", timeout_s=10.0, why=why, **wanted)
    end = time.monotonic() + float(made["after_s"]) + 330
    while (now := control("recorder", "status", timeout_s=10.0)).get("writing") and now.get("snapshot") == made["file"]:
        if time.monotonic() > end:
            fail(f"{made['file']} is still being written: `skin top` shows how the recorder does")
        pause(0.1)
    if as_json:
        emit(made)
    else:
        print(made["file"])
    if problems := now.get("problems", []):
        fail("\n".join(problems), INCOMPLETE)


def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", readable=False)],
    speed: Annotated[float, typer.Option(help="So many times the recorded speed.")] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as the stages can.")] = False,
    start: Annotated[float, typer.Option("--from", min=0, help="Begin so many seconds into the file.")] = 0.0,
    out: Annotated[
        Path | None, typer.Option(help="Write the contacts that come out to this recording, at the recorded times.")
    ] = None,
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
    if report["unwritten"]:
        fail("{}: {why}: {unwritten} contact frames are not in it".format(out, **report), INCOMPLETE)
    if not report["whole"]:
        fail(f"{file}: {report['damage']}", INCOMPLETE)


def _bar(contacts: Iterator[ContactFrame], total: int) -> Iterator[ContactFrame]:
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(
        contacts, "replaying", total=total, console=console, transient=True, disable=not console.is_terminal
    )


def import_file(
    source: Annotated[Path, typer.Argument(metavar="FILE", readable=False)],
    target: Annotated[Path, typer.Argument(metavar="OUT.mcap")],
    skin: Annotated[
        str,
        typer.Option("--skin", help="A configured skin, or a bundle; default: the first of skin.toml.", metavar="NAME"),
    ] = "",
    rate: Annotated[float, typer.Option(min=1e-3, help="Frames per second to give the recording.")] = 10.0,
    columns: ColumnsOption = "",
    pattern: PatternOption = "",
    untouched: UntouchedOption = "",
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    as_json: JsonOption = False,
) -> None:
    """Turn a file of measurements (npz, npy, mat, csv) into a recording that replays like any other.

    Either measurements (n, k) with untouched (m, k), which then are one scan after the other, or with reference (n, k);
    or presses as published with the hydrogel skin: untouched (n, k), touched (n, k). These and references are separate
    scans, of which none follows another in time. pattern (k, 4), where the file has it, says their order.
    """
    from services.recordings.importing import import_arrays
    from services.recordings.npz_file import load_npz, reading_options

    options = reading_options(columns, pattern, untouched)
    report = import_arrays(load_npz(source), source, target, skin or skin_name(""), rate, overwrite, options)
    say_understood(report["understood"])
    if as_json:
        emit(report)
    else:
        print("{file}: {frames} frames of {measurements} measurements, {seconds:.1f} s".format(**report))
