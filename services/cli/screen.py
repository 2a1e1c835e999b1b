"""The picture of `skin top`: tables of topics and processes beside the skin's heat map."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from services.cli.heatmap import draw
from services.cli.monitor import Monitor

WIDE = 130
"""Columns from which the skin is drawn beside the tables instead of below them."""
LEVELS = {"OK": "green", "WARN": "yellow", "ERROR": "bold red", "STALE": "bold red"}


def screen(monitor: Monitor, width: int, coloured: bool = True) -> RenderableType:
    """The whole page for a terminal of so many columns."""
    now = monitor.snapshot()
    if not monitor.heard:
        return Text(f"waiting for frames of skin {monitor.skin!r}; is the service running (`skin up`)?", style="yellow")
    tables = Group(_topics(now), _processes(now), _sayings(now))
    if width < WIDE:
        return Group(tables, _skin(monitor, coloured), _contacts(now))
    page = Table.grid(padding=(0, 2))
    page.add_row(tables, Group(_skin(monitor, coloured), _contacts(now)))
    return page


def _table(title: str, *heads: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(title, no_wrap=True)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    return table


def _topics(now: dict[str, Any]) -> Table:
    """Latencies in ms: since the middle of the scan, and since acquisition read it (as `skin bench latency` has it)."""
    table = _table("topic", "Hz", "age ms", "p50 ms", "p99 ms", "read p50", "p99", "lost")
    table.add_column("is")
    for name, row in now["topics"].items():
        says = Text("valid", style="green") if row["valid"] else Text("invalid", style="bold red")
        if row["reasons"]:
            says.append(": " + ", ".join(row["reasons"]), style="yellow")
        table.add_row(
            f"{name}/{now['skin']}",
            _number(row["rate_hz"]),
            _number(row["age_ms"], 0),
            _number(row["latency_ms"]["p50"]),
            _number(row["latency_ms"]["p99"]),
            _number(row["since_read_ms"]["p50"]),
            _number(row["since_read_ms"]["p99"]),
            str(row["lost"]),
            says,
        )
    return table


def _processes(now: dict[str, Any]) -> Table:
    table = _table("process", "level", "CPU %", "work p50 ms", "p99")
    table.add_column("dropped")
    table.add_column("spared")
    for name, row in now["processes"].items():
        latency = row["latency_ms"]
        table.add_row(
            name,
            Text(row["level"], style=LEVELS[row["level"]]),
            _number(row["cpu"] * 100),
            _number(latency.get("work_p50"), 2),
            _number(latency.get("work_p99"), 2),
            ", ".join(f"{n} {cause}" for cause, n in row["drops"].items() if n) or "0",
            ", ".join(f"{100 * share:.0f} % {rule}" for rule, share in row["skipped"].items()),
        )
    return table


def _sayings(now: dict[str, Any]) -> Text:
    """What the processes have to say, one line each."""
    text = Text()
    for name, row in now["processes"].items():
        for message in row["messages"]:
            text.append(f"{name}: ", style=LEVELS[row["level"]])
            text.append(message + "\n")
    return text


def _skin(monitor: Monitor, coloured: bool) -> RenderableType:
    image, contact = monitor.image, monitor.contact
    geometry = monitor.info.get("geometry") or {}
    outline = np.asarray(geometry.get("outline", np.zeros((0, 2)))).tolist() or None
    half = max((abs(v) for point in outline for v in point), default=0.05) if outline else 0.05
    if image is not None and image.image.size:
        half = max(half, -min(image.origin))
    marks = [(c.position[0], c.position[1]) for c in contact.contacts] if contact else []
    return draw(image.image if image is not None else None, half, marks, outline, coloured=coloured)


def _contacts(now: dict[str, Any]) -> Text:
    text = Text()
    for c in now["contacts"]:
        force = f"{c['force_n']:.2f} N" if c["force_n"] is not None else "force unknown"
        x, y = c["position"][0] * 1e3, c["position"][1] * 1e3
        text.append(f"{c['id']:4d} ({x:+6.1f}, {y:+6.1f}) mm  {force}  {c['shape']}\n")
    return text if now["contacts"] else Text("nothing touches", style="dim")


def _number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"
