"""Contacts beside the stub's truth: what `skin compare` prints."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from itertools import islice
from statistics import median
from typing import Any

from protocol.frames import ContactFrame, TruthFrame
from protocol.sockets import AllReader
from services.cli.common import NOT_RUNNING, emit, fail, nobody

LIGHT_N = 0.5  # a lighter touch's force is left out of the relative error: presses begin and end at zero


def pairs(truth: TruthFrame, contact: ContactFrame) -> list[dict[str, Any]]:
    """Each true touch and the contact that is its; `found` is None where none is left. Nearest pairs go first."""
    found = [c for c in contact.contacts if c.state != "end"]
    near = sorted(
        (math.dist(c.on_sheet, (t.x, t.y)), i, j) for i, t in enumerate(truth.touches) for j, c in enumerate(found)
    )
    partner: dict[int, int] = {}
    for _, i, j in near:
        if i not in partner and j not in partner.values():
            partner[i] = j
    rows = []
    for i, touch in enumerate(truth.touches):
        row: dict[str, Any] = {"scan": contact.scan, "x": touch.x, "y": touch.y, "force_n": touch.force_n}
        row |= {"shape": touch.shape, "found": None}
        if i in partner:
            best = found[partner[i]]
            row["found"] = {
                "id": best.id,
                "x": best.on_sheet[0],
                "y": best.on_sheet[1],
                "force_n": best.force_n,
                "shape": best.shape,
                "error_mm": math.dist(best.on_sheet, (touch.x, touch.y)) * 1e3,
            }
        rows.append(row)
    return rows


def compare_for(skin: str, seconds: float, count: int, as_json: bool) -> None:
    """Until `count` frames were compared (0: without end), or `seconds` have passed."""
    rows: list[dict[str, Any]] = []
    received: set[str] = set()
    compared = 0
    for truth, contact in islice(_paired(skin, time.monotonic() + seconds, received), count or None):
        compared += 1
        for row in pairs(truth, contact):
            rows.append(row)
            emit(row) if as_json else print(_line(row), flush=True)
    if "contact" not in received:
        fail(nobody(skin, seconds), NOT_RUNNING)
    if "truth" not in received:
        fail(f"no truth/{skin} came: only the stub board knows the truth", NOT_RUNNING)
    _summary(rows, compared, as_json)


def _paired(skin: str, end_s: float, received: set[str]) -> Iterator[tuple[TruthFrame, ContactFrame]]:
    """The frames of each scan, which come over two sockets. received: gets the topics that came."""
    contacts, truths = AllReader(["contact"], skin), AllReader(["truth"], skin)
    known: dict[int, TruthFrame] = {}
    waiting: dict[int, ContactFrame] = {}
    while (now := time.monotonic()) < end_s:
        frame = contacts.recv(min(0.05, end_s - now))
        if isinstance(frame, ContactFrame):
            waiting[frame.scan] = frame
            received.add("contact")
        while (true := truths.recv(0.0)) is not None:
            if isinstance(true, TruthFrame):
                known[true.scan] = true
                received.add("truth")
        for scan in sorted(waiting.keys() & known.keys()):
            yield known.pop(scan), waiting.pop(scan)
        for old in (known, waiting):
            while len(old) > 200:
                old.pop(next(iter(old)))


def _line(row: dict[str, Any]) -> str:
    true, found = f"scan {row['scan']:7d}  true {_touch(row)}", row["found"]
    return f"{true}  seen {_touch(found)}  off by {found['error_mm']:.2f} mm" if found else f"{true}  not seen"


def _touch(row: dict[str, Any]) -> str:
    return f"({row['x'] * 1e3:+6.1f}, {row['y'] * 1e3:+6.1f}) mm {_newton(row['force_n'])} {row['shape']:9s}"


def _newton(force: float | None) -> str:
    return "   -  N" if force is None else f"{force:5.2f} N"


def _summary(rows: list[dict[str, Any]], frames: int, as_json: bool) -> None:
    seen = [row for row in rows if row["found"] is not None]
    errors = sorted(row["found"]["error_mm"] for row in seen)
    forces = sorted(
        abs(row["found"]["force_n"] / row["force_n"] - 1) * 100
        for row in seen
        if (row["force_n"] or 0.0) >= LIGHT_N and row["found"]["force_n"] is not None
    )
    result = {
        "frames": frames,
        "touches": len(rows),
        "seen": len(seen),
        "position_error_mm": _spread(errors),
        "force_error_percent": _spread(forces),
    }
    if as_json:
        emit({"summary": result})
    elif not rows:
        print(f"nothing touched in {frames} frames: `skin press --x 0.02 --y -0.01 --force 3`")
    else:
        print(f"{frames} frames: {len(seen)} of {len(rows)} true touches seen")
        if errors:
            text = "position error: median {median:.2f} mm, p95 {p95:.2f} mm, largest {max:.2f} mm"
            print(text.format(**_spread(errors)))
        if forces:
            text = "force error from {0:g} N on: median {median:.1f} %, p95 {p95:.1f} %, largest {max:.1f} %"
            print(text.format(LIGHT_N, **_spread(forces)))


def _spread(ordered: list[float]) -> dict[str, float]:
    """Median, 95th percentile and largest of sorted values; empty without any."""
    if not ordered:
        return {}
    return {"median": median(ordered), "p95": ordered[int(0.95 * (len(ordered) - 1))], "max": ordered[-1]}
