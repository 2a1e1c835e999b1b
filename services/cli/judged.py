"""Judgements for a person: what `skin echo judgements` prints, and which of them turned, for `skin doctor`."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator

from protocol.frames import JudgementsFrame
from protocol.sockets import AllReader
from services.estimation.values.estimate import ROWS, CheckRow, Judgement, Verdict
from services.judged import MOST

ORDER = (Verdict.REFUSE, Verdict.NOTE, Verdict.PASS, Verdict.CANNOT, Verdict.NOT_ASKED)
UNKNOWN = CheckRow("", Verdict.NOTE)  # a name that this version's table does not have
TURNED = {Verdict.REFUSE: "refused", Verdict.NOTE: "noted"}


def said(frame: JudgementsFrame) -> list[Judgement]:
    """What turned first, then what is nearest to it."""
    verdicts = map(Verdict, frame.verdicts)
    columns = frame.names, frame.statistics, frame.expected, frame.ratios, verdicts, frame.where
    found = [Judgement(*row) for row in zip(*columns, strict=True)]
    return sorted(found, key=lambda each: (ORDER.index(each.verdict), -each.ratio))


def lines(frame: JudgementsFrame) -> list[str]:
    """One line per judgement."""
    return [f"    {each.verdict.value:9s} {each.name:13s} {_numbers(each)}" for each in said(frame)]


def judgements(skin: str, seconds: float) -> Iterator[JudgementsFrame]:
    """Those of the next `seconds`."""
    end = time.monotonic() + seconds
    reader = AllReader(["judgements"], skin)
    try:
        while (left := end - time.monotonic()) > 0:
            frame = reader.recv(left)
            if isinstance(frame, JudgementsFrame):
                yield frame
    finally:
        reader.close()


def turned(frames: Iterable[JudgementsFrame]) -> dict[str, str]:
    """What judgements say that is wrong, by their names, as it was when it was furthest from its limit; empty where
    nothing is.
    """
    worst = dict[str, Judgement]()
    for frame in frames:
        for each in said(frame):
            if _wrong(each) and (each.name not in worst or each.ratio > worst[each.name].ratio):
                worst[each.name] = each
    return {name: f"{_numbers(each)}: {TURNED[each.verdict]}" for name, each in worst.items()}


def _numbers(each: Judgement) -> str:
    """Statistic, limit and ratio; which electrode or touch it is about."""
    of = "electrode" if ROWS.get(each.name, UNKNOWN).file.startswith("faults") else "touch"
    place = f", {of} {each.where}" if each.where >= 0 else ""
    found, limit, ratio = (_short(value) for value in (each.statistic, each.expected, each.ratio))
    return f"{found}, limit {limit}, ratio {ratio}{place}"


def _short(value: float) -> str:
    return f"{math.copysign(math.inf, value) if abs(value) >= MOST else value:.4g}"


def _wrong(each: Judgement) -> bool:
    """Whether a reason follows: that something touches is noted, too, and is none."""
    noted = each.verdict is Verdict.NOTE and ROWS.get(each.name, UNKNOWN).reason
    return bool(noted) or each.verdict is Verdict.REFUSE
