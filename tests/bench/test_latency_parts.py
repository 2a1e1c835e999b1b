"""What is asked of scans in parts: the figures that a short run in CI fails on."""

from __future__ import annotations

from bench.speed.latency_parts import goals


def rows(untouched: float, still: float) -> dict[str, dict[str, float]]:
    cores = {"untouched": untouched, "still": still, "moving": 0.6}
    return {scene: {"p50_ms": 9.0, "p99_ms": 99.0, "cores": used, "parts_hz": 229.0} for scene, used in cores.items()}


def test_only_a_ratio_fails_a_short_run() -> None:
    assert all(goal.passed for goal in goals(rows(0.25, 0.4)))
    failed = [goal.figure for goal in goals(rows(0.45, 0.4)) if not goal.passed]
    assert failed == ["in parts, untouched: CPU of a part, of a held touch's"]


def test_a_skin_that_scanned_whole_under_a_touch_is_compared_by_the_part() -> None:
    found = rows(0.8, 0.4)
    found["still"]["parts_hz"] = 23.0  # this computer did not keep up
    assert all(goal.passed for goal in goals(found))


def test_times_and_cores_have_targets() -> None:
    met = {goal.figure: goal.met for goal in goals(rows(0.25, 0.6))}
    assert met["in parts, untouched: cores, four processes"] and not met["in parts, still: cores, four processes"]
    assert not met["in parts, moving: p50, ms"]
