"""The estimator's one output: which touches there are, with their uncertainty, and what was judged on the way.

Every decision has one form: which statistic met which limit, and what follows for the frame. `valid` and `reasons`
follow from the list of judgements alone, by the table ROWS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.measurement.arrays import Array, Mask
from services.estimation.values.scan import Scan


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


@dataclass(frozen=True)
class TouchEstimate:
    """One touch at the scan's `sample`. Model units and S on a sheet of 1 S, seconds; newtons nowhere."""

    id: int  # stays while the touch lasts; counts up in a session
    began: bool  # seen to begin; False: it was there when the estimator first looked
    age_s: float  # since it was first fitted
    x: float
    y: float
    vx: float  # 0 where it is steady
    vy: float
    log_radius: float  # of the disc of its area
    drop: float  # of conductivity, mean over the disc
    covariance: Annotated[Array, "published", "published"]  # (4, 4) of x, y, log radius, drop
    z2: float  # of the disc: how much it explains, in squared sigmas
    strength: float  # integral of drop / (1 - drop / 2): what the measurements tell best
    strength_sd: float
    unexplained: float  # share of the change that the fit leaves

    @property
    def radius(self) -> float:
        return float(np.exp(self.log_radius))


@dataclass(frozen=True)
class Estimate:
    """Of one scan. `valid` and `reasons` are computed from the judgements and what came with the scan."""

    scan: Scan
    whole: bool  # it shares no value with the last one that was whole
    touches: tuple[TouchEstimate, ...]
    electrodes: NDArray[np.uint8]  # (E,) protocol.frame_types.ELECTRODE_STATES
    live: Mask  # (K,) measurements that count
    difference: Array  # (K,) log |Z| / Z0 with drift, contact impedances and memory taken out
    sigma: Array  # (K,) its standard deviation
    judgements: tuple[Judgement, ...]

    @cached_property
    def valid(self) -> bool:
        return self.scan.believed and valid(self.judgements)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*self.scan.reasons, *reasons(self.judgements)]))

    @cached_property
    def touch(self) -> Judgement | None:
        """Whether something touches; None before there is a baseline."""
        return next((each for each in self.judgements if each.name == "touch"), None)

    @property
    def touched(self) -> bool:
        return self.touch is not None and self.touch.verdict is Verdict.NOTE
