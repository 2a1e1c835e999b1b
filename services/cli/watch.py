"""Commands that watch a running service: top, echo, compare."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.common import (
    LONGEST_S,
    NOT_RUNNING,
    USAGE,
    JsonOption,
    SkinOption,
    emit,
    fail,
    nobody,
    of_service,
    skin_name,
    use_configured_sockets,
)

if TYPE_CHECKING:
    from services.cli.monitor import Monitor


SHORTEST_S = 0.01  # in less than that no frame comes


def register(app: typer.Typer) -> None:
    for command in (top, echo, compare):
        app.command()(of_service(command))


def top(
    skin: SkinOption = "",
    once: Annotated[bool, typer.Option("--once", help="Watch for a moment, print, leave.")] = False,
    seconds: Annotated[float, typer.Option(min=SHORTEST_S, max=LONGEST_S, help="How long --once watches.")] = 2.0,
    as_json: JsonOption = False,
) -> None:
    """The skin as a heat map, its contacts, and every topic's and process's rates, delays, losses and CPU; q leaves."""
    from services.cli.monitor import Monitor

    if not (once or as_json or sys.stdout.isatty()):
        fail("the output is no terminal, expected one to draw on: give --once for one look, or --json", USAGE)
    use_configured_sockets()
    monitor = Monitor(skin_name(skin))
    if not (once or as_json):
        _live(monitor)
        return
    _look(monitor, seconds, as_json)
    while not once:
        _look(monitor, seconds, as_json)


def _look(monitor: Monitor, seconds: float, as_json: bool) -> None:
    """Watches for so long, and prints what is there."""
    monitor.read(seconds)
    if not monitor.received:
        fail(nobody(monitor.skin, seconds), NOT_RUNNING)
    if as_json:
        emit(monitor.snapshot())
        return
    from rich.console import Console

    from services.cli.screen import screen

    console = Console()
    console.print(screen(monitor, console.width, coloured=console.is_terminal))


def _live(monitor: Monitor) -> None:
    from rich.console import Console
    from rich.live import Live

    from services.cli.keyboard import keys
    from services.cli.screen import screen

    console = Console()
    first = screen(monitor, console.width, live=True)
    with keys() as typed, Live(first, console=console, screen=True, auto_refresh=False) as live:
        while "q" not in typed().lower():
            monitor.read(0.2)
            live.update(screen(monitor, console.width, live=True), refresh=True)


def echo(
    topic: Annotated[
        str,
        typer.Argument(
            help="raw, delta, part, image, contact, force, shape, judgements, status, info, truth or reference."
        ),
    ],
    skin: SkinOption = "",
    count: Annotated[int, typer.Option("--count", "-n", min=0, help="Leave after so many frames; 0: never.")] = 0,
    timeout: Annotated[
        float, typer.Option(min=0, max=LONGEST_S, help="Give up after so many seconds without a frame; 0: never.")
    ] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Print a topic's frames as they come."""
    from protocol.sockets import AllReader
    from protocol.topics import TOPICS

    name, _, named_skin = topic.partition("/")
    if name not in TOPICS:
        fail(f"no topic {name!r}: expected one of {', '.join(TOPICS)}", USAGE)
    wanted = skin_name(skin or named_skin)
    use_configured_sockets()
    reader = AllReader([name], wanted)
    shown = 0
    while not count or shown < count:
        frame = reader.recv(timeout or 1e6)
        if frame is None:
            fail(nobody(wanted, timeout, name), NOT_RUNNING)
        if as_json:
            emit(plain(frame))
        else:
            print(line(name, frame), flush=True)
        shown += 1


def plain(value: Any) -> Any:
    """A frame as maps and lists."""
    from dataclasses import fields, is_dataclass

    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value


def line(name: str, frame: Any) -> str:
    """A frame for a person: what it says first, then where it comes from."""
    number = f"frame {frame.seq:7d}" if name in ("status", "info", "reference") else f"scan {frame.scan:7d}"
    head = f"{name}/{frame.skin} {number} {'valid  ' if frame.valid else 'INVALID'}"
    reasons = f" [{', '.join(frame.reasons)}]" if frame.reasons else ""
    if name == "contact":
        body = "; ".join(
            f"{c.id} {c.state} ({c.position[0] * 1e3:+.1f}, {c.position[1] * 1e3:+.1f}) mm"
            + (f" {c.force_n:.2f} N" if c.force_n is not None else "")
            + f" {c.shape}"
            for c in frame.contacts
        )
        return f"{head} {body or 'no contact'}{' (held)' if frame.held else ''}{reasons}"
    if name == "judgements":
        from services.cli.judged import lines

        return "\n".join([f"{head}{reasons}", *lines(frame)])
    from protocol.frames import Frame

    header = set(Frame.__dataclass_fields__)
    body = " ".join(f"{key}={_short(value)}" for key, value in plain(frame).items() if key not in header)
    return f"{head}{reasons} {body}"


def _short(value: Any) -> str:
    if hasattr(value, "dtype"):
        import numpy as np

        if value.size == 0:
            return "-"
        size = np.abs(value)
        return f"{value.dtype}{list(value.shape)} |{size.min():.4g}..{size.max():.4g}|"
    if isinstance(value, float):
        return f"{value:.5g}"
    text = str(value)
    return text if len(text) < 200 else text[:197] + "..."


def compare(
    skin: SkinOption = "",
    seconds: Annotated[float, typer.Option(min=SHORTEST_S, max=LONGEST_S, help="How long to compare.")] = 10.0,
    count: Annotated[
        int, typer.Option("--count", "-n", min=0, help="Leave after so many frames; 0: after --seconds.")
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Print position and force of every contact beside the stub's truth, scan by scan, and the errors at the end."""
    from services.cli.truth import compare_for

    use_configured_sockets()
    compare_for(skin_name(skin), seconds, count, as_json)
