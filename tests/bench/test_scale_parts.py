"""Many skins whose scans come in parts: a part that no status accounts for is found."""

from collections import Counter
from typing import Any

import pytest

from bench.speed.scale import Said, Traffic
from bench.speed.scale_parts import accounted, goals

STEP_NS = 1e7


def status(at_s: float, frames: int, **drops: int) -> dict[str, Any]:
    return {"stamps": {"publish": round(at_s * 1e9)}, "counters": {"frames": frames}, "drops": drops}


def traffic(frames: int, missing: int = 0, **drops: int) -> Traffic:
    said = {
        ("acquisition", "s00"): Said(status(1, 0, late=0), status(11, 0, late=0)),
        ("preprocessing", "s00"): Said(status(1, 50, skipped=3), status(11, 50 + frames, skipped=3, **drops)),
    }
    return Traffic([1.0, 2.0, 30.0], Counter(s00=3), missing, said, {}, {})


@pytest.mark.parametrize(
    ("frames", "drops", "missing", "uncounted"), [(1000, 0, 0, 0), (990, 10, 0, 0), (990, 0, 2, 9)]
)
def test_each_part_is_taken_or_said_to_be_dropped(frames: int, drops: int, missing: int, uncounted: int) -> None:
    found = accounted(traffic(frames, missing, late=drops), STEP_NS)
    assert found["uncounted"] == uncounted, "three parts may be on their way"
    assert found["dropped"] == {"acquisition": 0, "preprocessing": drops}
    row = {"skins": 8, "touched": 0.25, "rate_hz": 100.0, **found}
    failed = [goal.figure for goal in goals([row]) if not goal.passed]
    assert any("accounts for" in figure for figure in failed) == (uncounted > 0)
