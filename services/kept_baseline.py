"""What of a baseline is kept across a crash, and when it may be taken over."""

from __future__ import annotations

import dataclasses
from typing import Any

from services.estimation.baseline import BaselineEstimator
from services.estimation.tare import Baseline
from services.runtime.stage import Refused

LONGEST_S = 1e9  # a saved time that is longer is none


def kept(estimator: BaselineEstimator) -> dict[str, Any] | None:
    """What is worth keeping, if it changed since the last call."""
    baseline = estimator.baseline
    if not estimator.news or baseline is None or estimator.source == "replay":
        return None
    estimator.news = False
    now_ns = estimator.last_sample_ns
    taken_s = estimator.undated_s or max(0.0, (now_ns - baseline.taken_ns) * 1e-9)
    saved = {"bundle": estimator.bundle.hash, "baseline": baseline.to_dict()}
    return saved | {"taken_s": taken_s, "quiet_s": estimator.since_s(now_ns)}


def take_over(estimator: BaselineEstimator, saved: dict[str, Any], age_s: float, oldest_s: float) -> None:
    """Use what was kept age_s ago. Raises Refused where it does not fit, or is older than oldest_s: then it only judges
    the next start.
    """
    if not isinstance(saved, dict) or saved.get("bundle") != estimator.bundle.hash:
        raise Refused("the saved baseline is of another bundle")
    baseline = Baseline.from_dict(saved.get("baseline", {}), len(estimator.bundle.pattern))
    if age_s > oldest_s:
        estimator.trusted = None if baseline.doubt else baseline
        raise Refused(
            f"the saved baseline is {age_s / 3600:.1f} h old, at most {oldest_s / 3600:.1f} h: another is taken, and "
            "held against it"
        )
    taken_s, quiet_s = ages(saved)
    estimator.set_baseline(
        dataclasses.replace(baseline, restored=True), age_s=age_s + quiet_s, undated_s=age_s + taken_s
    )
    estimator.news = False


def ages(saved: dict[str, Any]) -> tuple[float, float]:
    """When a baseline was taken and the skin last known as untouched, both in seconds before it was kept. Raises
    Refused where those are no times.
    """
    try:
        taken_s, quiet_s = (float(saved.get(key, 0.0)) for key in ("taken_s", "quiet_s"))
        if not (0 <= taken_s <= LONGEST_S and 0 <= quiet_s <= LONGEST_S):
            raise ValueError(f"found {taken_s:g} s and {quiet_s:g} s")
    except (TypeError, ValueError) as wrong:
        raise Refused(f"the saved baseline has no age ({wrong}): tare again") from None
    return taken_s, quiet_s
