"""The estimator's judgements as a frame, for whoever asks why a frame is not valid."""

from __future__ import annotations

import math
from collections.abc import Iterable

from protocol.frames import DeltaFrame, JudgementsFrame
from services.estimation.values.estimate import Judgement
from services.runtime.stage import inherited

MOST = 1e300  # what stands for more, and for no number: a verdict turns at both


def judged(frame: DeltaFrame, judgements: Iterable[Judgement]) -> JudgementsFrame:
    """Why a frame, or the part frame of the same scan, is as it is; with its validity, reasons and stamps."""
    out = JudgementsFrame(**inherited(frame))
    for each in judgements:
        out.names.append(each.name)
        out.statistics.append(_finite(each.statistic))
        out.expected.append(_finite(each.expected))
        out.ratios.append(_finite(each.ratio))
        out.verdicts.append(each.verdict.value)
        out.where.append(int(each.where))
    return out


def _finite(value: float) -> float:
    return MOST if math.isnan(value) else float(min(max(value, -MOST), MOST))
