"""One form for every decision: which statistic met which limit, and what follows for the frame.

`valid` and `reasons` follow from the list of judgements alone, by the table ROWS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple


class Verdict(Enum):
    """PASS: nothing is wrong. NOTE: to know, the frame may be acted on. REFUSE: it may not. NOT_ASKED: an earlier row
    decided. CANNOT: this bundle or board has no means to tell.
    """

    PASS = "pass"
    NOTE = "note"
    REFUSE = "refuse"
    NOT_ASKED = "not asked"
    CANNOT = "cannot"


class Judgement(NamedTuple):
    """The record that a decision leaves."""

    name: str  # row of the table
    statistic: float
    expected: float  # its limit where nothing is wrong
    ratio: float  # statistic / expected; the verdict turns at 1
    verdict: Verdict
    where: int = -1  # electrode or touch; -1: the scan


@dataclass(frozen=True)
class CheckRow:
    """One check of the table."""

    file: str  # of services/estimation, that judges it
    turned: Verdict
    reason: str = ""  # that a frame says where it turned


NOTE, REFUSE = Verdict.NOTE, Verdict.REFUSE
ROWS: Mapping[str, CheckRow] = {
    "believed": CheckRow("estimator", REFUSE),  # its reasons came with the frame
    "silent": CheckRow("faults/advice", REFUSE, "multiplexer"),
    "stuck": CheckRow("faults/advice", NOTE, "multiplexer"),
    "open": CheckRow("faults/advice", NOTE, "electrode_open"),
    "short": CheckRow("faults/advice", NOTE, "electrode_short"),
    "exchanged": CheckRow("faults/advice", NOTE, "electrode_swapped"),
    "saturated": CheckRow("faults/advice", NOTE, "saturated"),
    "fifo": CheckRow("faults/advice", NOTE, "fifo"),
    "impedance": CheckRow("faults/advice", NOTE, "electrode_drift"),
    "gain": CheckRow("estimator", NOTE, "gain"),
    "gain_gross": CheckRow("estimator", REFUSE, "gain"),
    "degraded": CheckRow("faults/advice", NOTE, "degraded"),
    "too_many": CheckRow("faults/advice", REFUSE),  # what is wrong with each of them is said
    "gap": CheckRow("estimator", REFUSE, "gap"),
    "seen": CheckRow("estimator", REFUSE, "degraded"),
    "baseline": CheckRow("initialisation/tare", REFUSE, "stale_baseline"),
    "agrees": CheckRow("initialisation/tare", REFUSE, "stale_baseline"),
    "noise_trained": CheckRow("initialisation/tare", REFUSE, "stale_baseline"),
    "identical": CheckRow("initialisation/tare", REFUSE, "stale_baseline"),
    "hidden": CheckRow("initialisation/start", REFUSE, "stale_baseline"),
    "start": CheckRow("initialisation/start", REFUSE, "touched_at_start"),
    "touch": CheckRow("estimator", NOTE),  # it says that something touches
    "explained": CheckRow("estimator", REFUSE, "out_of_distribution"),
    "changing": CheckRow("estimator", NOTE, "changing"),
}
"""In the order in which reasons are said. A new fault is one row here and one file in faults/."""


def judge(name: str, statistic: float, expected: float, where: int = -1, turned: Verdict | None = None) -> Judgement:
    """The judgement of a row: it turns where the statistic reaches its limit, which is above 0.

    turned: its verdict then, where that is not the row's own. Raises KeyError for a row that the table does not have.
    """
    ratio = statistic / expected
    verdict = (turned or ROWS[name].turned) if not ratio < 1 else Verdict.PASS
    return Judgement(name, statistic, expected, ratio, verdict, where)


def valid(judgements: Iterable[Judgement]) -> bool:
    """Whether a frame with these judgements may be acted on."""
    return all(each.verdict is not Verdict.REFUSE for each in judgements)


def reasons(judgements: Iterable[Judgement]) -> list[str]:
    """What a frame with these judgements says, in the table's order, each once."""
    turned = {each.name for each in judgements if each.verdict in (Verdict.NOTE, Verdict.REFUSE)}
    return list(dict.fromkeys(row.reason for name, row in ROWS.items() if name in turned and row.reason))
