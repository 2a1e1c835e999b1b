"""`skin info`: what is in a recording."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.common import USAGE, JsonOption, check_whole, emit, fail

if TYPE_CHECKING:
    from services.recordings.summary import SessionSummary, Span

COLUMNS = 72
ROWS = 20


def register(app: typer.Typer) -> None:
    app.command()(info)


def info(
    file: Annotated[Path, typer.Argument(metavar="FILE.mcap", readable=False)],
    png: Annotated[Path | None, typer.Option(help="Draw the session: force, contacts, faults, gaps.")] = None,
    everything: Annotated[bool, typer.Option("--all", help=f"All contacts and faults, not the first {ROWS}.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Say what is in a recording: topics, rates, gaps, faults, contacts, and how the force went."""
    from services.recordings.summary import summarise

    found = summarise(file)
    if png is not None:
        from models import not_installed
        from protocol.whole_file import whole_file

        try:
            from services.recordings.session_picture import draw
        except ImportError as missing:
            fail(f"--png: {not_installed(missing) or missing}", USAGE)
        try:
            with whole_file(png) as part:
                draw(found, part)
        except OSError as why:
            fail(f"cannot write {png}: {why.strerror}")
    if as_json:
        emit(_plain(found))
    else:
        for line in _told(found, 10**6 if everything else ROWS):
            print(line)
    check_whole(file, found.damage)


def _plain(found: SessionSummary) -> dict[str, Any]:
    return {
        "file": str(found.path),
        "bytes": found.bytes,
        "start": found.start_ns * 1e-9,
        "seconds": found.duration_s,
        "damage": str(found.damage),
        "cannot_be_read": dict(found.damage.missing),
        "scans": [span._asdict() for span in found.damage.scans],
        "could_not_be_written": dict(found.damage.unwritten),
        "event": found.metadata.get("event", ""),
        "topics": {
            name: {
                "messages": t.messages,
                "bytes": t.bytes,
                "rate_hz": t.rate_hz,
                "missing": t.missing,
                "malformed": t.malformed,
            }
            for name, t in found.topics.items()
        },
        "gaps": [{"topic": name, "at_s": at, "seconds": s} for name, at, s in _gaps(found)],
        "faults": [{"skin": f.skin, "what": f.what, "begin_s": f.begin_s, "end_s": f.end_s} for f in found.faults],
        "contacts": [
            {
                "skin": c.skin,
                "id": int(c.what),
                "begin_s": c.begin_s,
                "end_s": c.end_s,
                "most_n": c.most_n,
                "position_m": list(c.place),
            }
            for c in found.contacts
        ],
        "not_listed": dict(found.left_out),
    }


def _gaps(found: SessionSummary) -> list[tuple[str, float, float]]:
    from services.recordings.summary import FLOWING

    flowing = [(name, t) for name, t in found.topics.items() if name.partition("/")[0] in FLOWING]
    return [(name, at, seconds) for name, t in flowing for at, seconds in t.gaps()]


def _told(found: SessionSummary, rows: int) -> list[str]:
    from services.recordings.summary import strip

    size, state = f"{found.bytes / 1e6:.2f} MB", "not whole" if not found.damage.whole else str(found.damage)
    if not found.topics:
        return [f"{found.path}: it holds no message, {size}, {state}"]
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(found.start_ns * 1e-9))
    lines = [f"{found.path}: {found.duration_s:.1f} s from {began} UTC, {size}, {state}"]
    if event := found.metadata.get("event"):
        lines.append(f"a snapshot: {event}")
    lines += ["", f"{'topic':<18}{'messages':>9}{'per second':>12}{'missing':>9}{'MB':>8}"]
    for name, topic in sorted(found.topics.items()):
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.1f}"
        bad = f"  {topic.malformed} malformed" if topic.malformed else ""
        lines.append(f"{name:<18}{topic.messages:>9}{rate:>12}{topic.missing:>9}{topic.bytes / 1e6:>8.2f}{bad}")
    for skin, course in found.courses.items():
        force, valid, most = strip(course, found.duration_s, min(COLUMNS, max(8, len(course.times_s) // 3)))
        lines += ["", f"{skin}: force, at most {most:.1f} N, over {found.duration_s:.1f} s; below it ✕ where not valid"]
        lines += [f"  {force}", f"  {valid}"]
    contacts, gaps = found.contacts, _gaps(found)
    lines += ["", f"contacts: {len(contacts) + found.left_out['contacts']}"]
    for c in contacts[:rows]:
        force = "force not known" if c.most_n is None else f"up to {c.most_n:.2f} N"
        x, y = (f"{1e3 * v:+.1f}" for v in c.place[:2])
        lines.append(f"  {_when(c)}  {c.skin} {c.what}: {force} at {x}, {y} mm")
    lines += _more(len(contacts), rows)
    lines.append(f"faults: {len(found.faults) + found.left_out['faults']}")
    lines += [f"  {_when(f)}  {f.skin}: {f.what}" for f in found.faults[:rows]] + _more(len(found.faults), rows)
    lines.append(f"gaps: {len(gaps)}")
    lines += [f"  {at:8.2f} s  {name}: nothing for {seconds:.2f} s" for name, at, seconds in gaps[:rows]]
    return lines + _more(len(gaps), rows)


def _when(span: Span) -> str:
    return f"{span.begin_s:8.2f} to {span.end_s:8.2f} s"


def _more(count: int, rows: int) -> list[str]:
    return [f"  and {count - rows} more: --all"] if count > rows else []
