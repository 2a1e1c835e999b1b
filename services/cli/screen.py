"""The picture of `skin top`: the skin as a heat map, its contacts, and how topics and processes do."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from services.cli.heatmap import draw, framed, top_of_scale
from services.cli.monitor import Monitor

WIDE = 130
"""Columns from which every latency and counter is shown."""
NARROW = 76
"""Columns from which the tables stand beside the skin instead of below it."""
MOST_CONTACTS, MOST_SAYINGS = 4, 2  # rows of them that 24 lines have room for
LEVELS = {"OK": "green", "WARN": "yellow", "ERROR": "bold red", "STALE": "bold red"}


def screen(monitor: Monitor, width: int, coloured: bool = True, live: bool = False) -> RenderableType:
    """The whole page for a terminal of so many columns: 24 lines where it is narrower than WIDE."""
    now = monitor.snapshot()
    leaves = Text("\nq leaves", style="dim") if live else Text()
    if not monitor.received:
        waiting = f"waiting for frames of skin {monitor.skin!r}: start the service with `skin up`"
        return Group(Text(waiting, style="yellow"), leaves)
    wide = width >= WIDE
    tables = Group(_contacts(now, 16 if wide else MOST_CONTACTS), *(_detailed(now) if wide else _short(now)))
    page: RenderableType = Group(_skin(monitor, coloured), tables)
    if width >= NARROW:
        page = Table.grid(padding=(0, 2))
        page.add_row(_skin(monitor, coloured), tables)
    return Group(_verdict(now, live), page, _sayings(now, 8 if wide else MOST_SAYINGS, width))


def _verdict(now: dict[str, Any], live: bool) -> Text:
    """The first line: may the contacts be acted on?"""
    text = Text(f"skin {now['skin']}: ", style="bold", no_wrap=True, overflow="ellipsis")
    if "contact" not in now["topics"]:
        text.append("no contact frames come", style="bold red")
    elif now["valid"]:
        text.append("contacts valid", style="green")
    else:
        text.append("contacts NOT VALID, do not act on them", style="bold red")
    if now["reasons"]:
        text.append(f" ({', '.join(now['reasons'])})", style="yellow")
    return text.append("   q leaves", style="dim") if live else text


def _table(title: str, *heads: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column(title, no_wrap=True)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    return table


def _contacts(now: dict[str, Any], most: int) -> RenderableType:
    table = _table("contact", "x mm", "y mm", "force", "shape")
    for c in now["contacts"][:most]:
        force = f"{c['force_n']:.2f} N" if c["force_n"] is not None else "unknown"
        x, y = c["position"][0] * 1e3, c["position"][1] * 1e3
        table.add_row(str(c["id"]), f"{x:+.1f}", f"{y:+.1f}", force, c["shape"])
    if not now["contacts"]:
        return Text("no contact: nothing touches\n" if now["valid"] else "no contact\n", style="dim")
    more = len(now["contacts"]) - most
    return Group(table, Text(f"and {more} more\n" if more > 0 else ""))


def _short(now: dict[str, Any]) -> list[RenderableType]:
    """Topics and processes in 38 columns."""
    topics = _table("topic", "frames/s", "delay ms", "lost")
    for name, row in now["topics"].items():
        median = _number(row["latency_ms"]["p50"], 0)
        topics.add_row(name, _number(row["rate_hz"]), median, str(row["lost"]))
    processes = _table("process", "is", "CPU %")
    for name, row in now["processes"].items():
        processes.add_row(name, Text(row["level"], style=LEVELS[row["level"]]), _number(row["cpu"] * 100))
    return [topics, Text("delay: from mid-scan to here, median\n", style="dim"), processes]


def _detailed(now: dict[str, Any]) -> list[RenderableType]:
    topics = _table("topic", "frames/s", "last ms ago", "delay ms", "p99", "since read ms", "p99", "lost")
    topics.add_column("is")
    for name, row in now["topics"].items():
        says = Text("valid", style="green") if row["valid"] else Text("not valid", style="bold red")
        if row["reasons"]:
            says.append(": " + ", ".join(row["reasons"]), style="yellow")
        latency, read = row["latency_ms"], row["since_read_ms"]
        times = (row["rate_hz"], 1), (row["age_ms"], 0), (latency["p50"], 1), (latency["p99"], 1), (read["p50"], 1)
        cells = [_number(value, digits) for value, digits in (*times, (read["p99"], 1))]
        topics.add_row(f"{name}/{now['skin']}", *cells, str(row["lost"]), says)
    said = (
        "delay: from the middle of the scan to here; since read: from the board's last byte. Median, 99th percentile.\n"
    )
    processes = _table("process", "is", "CPU %", "ms a frame", "p99")
    processes.add_column("frames dropped")
    processes.add_column("network not run")
    for name, row in now["processes"].items():
        latency = row["latency_ms"]
        processes.add_row(
            name,
            Text(row["level"], style=LEVELS[row["level"]]),
            _number(row["cpu"] * 100),
            _number(latency.get("work_p50"), 2),
            _number(latency.get("work_p99"), 2),
            ", ".join(f"{n} {cause}" for cause, n in row["drops"].items() if n) or "0",
            ", ".join(f"{100 * share:.0f} % {rule}" for rule, share in row["skipped"].items()),
        )
    return [topics, Text(said, style="dim"), processes]


def _sayings(now: dict[str, Any], most: int, width: int) -> Text:
    """What the processes have to say, one line each, the worst first."""
    worst = sorted(now["processes"].items(), key=lambda item: -list(LEVELS).index(item[1]["level"]))
    said = [(name, row["level"], message) for name, row in worst for message in row["messages"]]
    text = Text()
    for name, level, message in said[:most]:
        room = max(20, width - len(name) - 2)
        text.append(f"\n{name}: ", style=LEVELS[level])
        text.append(message if len(message) <= room else message[: room - 3] + "...")
    if len(said) > most:
        text.append(f"  (and {len(said) - most} more: `skin echo status`)", style="dim")
    return text


def _skin(monitor: Monitor, coloured: bool) -> RenderableType:
    image, contact = monitor.image, monitor.contact
    drop = image.image if image is not None else None
    geometry = monitor.info.get("geometry") or {}
    outline = np.asarray(geometry.get("outline", np.zeros((0, 2)))).tolist() or None
    half = max((abs(v) for point in outline or () for v in point), default=0.05)
    if image is not None:
        half = max(half, -min(image.origin))
    marks = [c.on_sheet for c in contact.contacts if c.state != "end"] if contact else []
    skin = framed(draw(drop, half, marks, outline, coloured=coloured), half, top_of_scale(drop), coloured)
    if monitor.image_held:
        skin.append("\nimage held: unchanged" if drop is not None else "\nimage held: shown when it changes", "dim")
    return skin


def _number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"
