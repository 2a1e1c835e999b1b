"""What frames say after a time in which nothing was measured, or a stage saw nothing of it: never what was before."""

from __future__ import annotations

import os

import numpy as np
import pytest

from services.runtime.config import ScanMode
from tests.services.gap_host import FAR_M, SCAN_S, GapHost, Press

PART_S = SCAN_S / 10
HELD = (-0.03, 0.03)
TOUCHED_S = 4.0
GAP_S = 4.6
STAGES = ("Preprocessing", "Inference", "Publishing")
WHATS = ("elsewhere", "ramps", "beside", "released", "begins", "held")


def presses(what: str, start: float, end: float, rng: np.random.Generator) -> list[Press]:
    """A touch that is held, and what becomes of it in a gap."""
    changed, over = start + rng.uniform(0.1, 0.8) * (end - start), end + 20.0
    x, y = HELD
    while np.hypot(x - HELD[0], y - HELD[1]) < 0.03:
        x, y = rng.uniform(-0.034, 0.034, 2)
    begins = end + rng.uniform(-1.0, 0.5) * 0.1
    gone = Press(*HELD, TOUCHED_S, changed)
    return {
        "elsewhere": [gone, Press(x, y, changed, over)],
        "ramps": [gone, Press(x, y, begins, over, ramp=0.1)],
        "beside": [Press(*HELD, TOUCHED_S, over), Press(x, y, changed, over)],
        "released": [gone],
        "begins": [Press(x, y, changed, over)],
        "held": [Press(*HELD, TOUCHED_S, over)],
    }[what]


def after_a_gap(scan: str, how: str, seconds: float, what: str, seed: int) -> GapHost:
    """A gap at any phase of a scan; half a second more, or longer where the board is to be found again."""
    rng = np.random.default_rng([seed, round(1e4 * seconds)])
    start = GAP_S + SCAN_S * float(rng.random())
    host = GapHost(scan, seed, presses(what, start, start + seconds, rng))
    host.outage(start, seconds, how)
    again = 1.2 if how == "unplug" or (how == "hang" and seconds > 0.5) else 0.0
    host.until(start + seconds + 0.5 + again)
    host.close()
    assert any(frame.valid for at, frame in host.frames if at > start + seconds)
    assert not host.wrong(start), "\n".join(map(str, host.wrong(start)))
    return host


def cases(seeds: range, gaps: dict[str, list[float]]) -> list[tuple[str, str, float, str, int]]:
    """Every kind of gap, a few of its lengths and of what becomes of the touch in each seed."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 3])
        for how, lengths in gaps.items():
            for scan in ("full", "rolling"):
                found.append((scan, how, float(rng.choice(lengths)), str(rng.choice(WHATS)), seed))
    return found


LENGTHS = [PART_S, 3 * PART_S, SCAN_S, 0.07, 0.1, 0.2, 0.3, 0.5, 0.8, 1.3, 3.0, 10.0]
LOST = [0.05, *LENGTHS[3:]]  # at least a scan
FEW = {"lost": [0.1, 0.3], "hang": [1.3], "unplug": [0.3], **dict.fromkeys(STAGES, [0.1, 0.5])}
MANY = {"lost": LOST, "hang": LOST, "unplug": LENGTHS, **dict.fromkeys(STAGES, LENGTHS[3:])}


@pytest.mark.parametrize("how", ["lost", "Publishing"])
@pytest.mark.parametrize("what", ["elsewhere", "ramps"])
@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_a_touch_that_ended_in_a_gap_is_not_shown_and_one_that_began_is(scan: str, what: str, how: str) -> None:
    after_a_gap(scan, how, 0.8, what, seed=1)


@pytest.mark.release
@pytest.mark.parametrize(("scan", "how", "seconds", "what", "seed"), cases(range(1), FEW))
def test_nothing_is_hidden_behind_a_gap(scan: str, how: str, seconds: float, what: str, seed: int) -> None:
    after_a_gap(scan, how, seconds, what, seed)


SEEDS = range(10, 30) if os.environ.get("EITSKIN_SEARCH") else range(10, 11)


@pytest.mark.release
@pytest.mark.parametrize(("scan", "how", "seconds", "what", "seed"), cases(SEEDS, MANY))
def test_nothing_is_hidden_behind_any_gap(scan: str, how: str, seconds: float, what: str, seed: int) -> None:
    after_a_gap(scan, how, seconds, what, seed)


@pytest.mark.parametrize("seconds", [2 * PART_S, 0.8])
def test_a_touch_that_is_held_over_a_gap_is_valid_again_with_its_first_scan(seconds: float) -> None:
    for scan in ("full", "rolling"):
        host = after_a_gap(scan, "lost", seconds, "held", seed=4)
        whole = [f for at, f in host.frames if f.stamps["sample"] * 1e-9 > GAP_S + SCAN_S + seconds]
        assert all(f.valid for f in whole) and {c.id for f in whole for c in f.contacts} == {1}


def test_in_parts_a_touch_is_followed_at_full_rate_soon_after_a_gap() -> None:
    host = after_a_gap("rolling", "lost", 0.3, "held", seed=5)
    end = host.frames[-1][0]
    times = [at for at, frame in host.frames if at > end - 0.3 and frame.valid]
    assert len(times) / 0.3 > 200, "before: 23, as of whole scans"


@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_single_lost_scans_make_no_frame_of_a_held_touch_invalid(scan: str) -> None:
    host = GapHost(scan, 6, presses("held", GAP_S, GAP_S, np.random.default_rng(6)))
    host.until(GAP_S)
    host.rig.fault("sequence_gaps", {"fraction": 0.2 if scan == "full" else 0.02}, GAP_S, 5.0)
    host.until(GAP_S + 3.0)
    host.close()
    frames = [frame for at, frame in host.frames if at > GAP_S]
    assert any("gap" in frame.reasons for frame in frames)
    assert all(frame.valid for frame in frames)
    assert not host.wrong(GAP_S)


@pytest.mark.parametrize("stage", ["Inference", "Publishing"])
def test_in_parts_a_single_image_that_is_skipped_hides_nothing(stage: str) -> None:
    """The touch is let go and another one begins meanwhile. Before: the second image was valid and showed none."""
    gone = Press(-0.0213, -0.0232, TOUCHED_S, 4.6269, 2.82, radius=0.0104)
    began = Press(0.0091, 0.0351, 4.6472, 20.0, 2.06, radius=0.0065)
    host = GapHost("rolling", 5, [gone, began])
    host.outage(4.6212, 0.0543, stage)
    host.until(5.0)
    host.close()
    assert not host.wrong(4.5), "\n".join(map(str, host.wrong(4.5)))
    (contact,) = host.frames[-1][1].contacts
    assert host.frames[-1][1].valid and np.hypot(contact.position[0] - began.x, contact.position[1] - began.y) < FAR_M


@pytest.mark.parametrize("scan", ["full", pytest.param("rolling", marks=pytest.mark.release)])
@pytest.mark.parametrize("lag", [0.0, 0.005, 0.02])
def test_touches_that_change_places_without_a_gap_are_not_hidden(scan: str, lag: float) -> None:
    """Before: what took another one's place waited for a second image in valid frames that showed nothing."""
    for seed in range(3):
        rng = np.random.default_rng([seed, round(1e3 * lag)])
        swap, (x, y) = GAP_S + SCAN_S * float(rng.random()), HELD
        while np.hypot(x - HELD[0], y - HELD[1]) < 0.03:
            x, y = rng.uniform(-0.034, 0.034, 2)
        force, radius = float(rng.uniform(1.0, 4.0)), float(rng.uniform(0.006, 0.011))
        began = Press(x, y, swap + lag, 20.0, force, radius=radius)
        host = GapHost(scan, seed, [Press(*HELD, TOUCHED_S, swap), began])
        host.until(swap + 0.4)
        host.close()
        assert not host.wrong(4.5), "\n".join(map(str, host.wrong(4.5)))
        assert host.frames[-1][1].valid and [c.state for c in host.frames[-1][1].contacts] == ["hold"]


@pytest.mark.parametrize("scan", ["full", pytest.param("rolling", marks=pytest.mark.release)])
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_that_skips_most_frames_says_nothing_wrong_and_still_something(stage: str, scan: str) -> None:
    """Each of its frames comes after a gap."""
    move = GAP_S + 1.0
    host = GapHost(scan, 7, [Press(*HELD, TOUCHED_S, move), Press(0.025, -0.02, move + 0.02, 20.0)])
    host.until(GAP_S)
    every = 1 if stage == "Preprocessing" and scan == "full" else 0
    host.pipeline.every = {stage: 23 if stage == "Preprocessing" and not every else 3}
    host.until(GAP_S + 2.0)
    host.close()
    assert not host.wrong(GAP_S), "\n".join(map(str, host.wrong(GAP_S)))
    frames = [frame for at, frame in host.frames if at > GAP_S]
    assert np.mean([frame.valid for frame in frames]) > 0.8
    (contact,) = [c for c in frames[-1].contacts if c.state != "end"]
    assert np.hypot(contact.position[0] - 0.025, contact.position[1] + 0.02) < FAR_M


@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_presses_that_take_turns_behind_gaps_are_not_what_foam_remembers(scan: ScanMode) -> None:
    """Two places in turn for seven seconds: what each touch left there adds up to no touch."""
    turns = [Press(*((-0.03, 0.03), (0.025, -0.02))[n % 2], 7.0 + 0.6 * n, 7.6 + 0.6 * n) for n in range(12)]
    host = GapHost(scan, 2, turns)
    for press in turns[1:]:
        host.outage(press.start - 0.1, 0.3, "Preprocessing")
    host.until(turns[-1].end)
    host.close()
    assert sum(1 for _ in host.valid(7.0)) > 50 and not host.wrong(7.0), "\n".join(map(str, host.wrong(7.0)))
