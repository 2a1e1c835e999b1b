"""Faults of the stub's board: bytes in, contact frames out. Each is named, makes no contact and hides none, and all is
well soon after it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.trust import plans
from bench.trust.runs import skin_of
from bench.trust.scene import BEGIN_S
from bench.trust.session import PlayedSession, SessionPlan
from bench.trust.stages import Today
from firmware_stub.faults import FAULTS, Faults
from firmware_stub.world import Touch
from services.recordings.replay_session import private_runtime
from services.runtime.config import ScanMode
from simulation.faults import CONTACT_RISES, ROWS, FaultRow, row_of
from simulation.host import LATE_S, SimulatedHost, loaded, tared
from simulation.scenes import ContactCurves, DiscPress, disc, path_of, ramp, script, spread, step
from simulation.sheets import solved_sheet
from simulation.truth import lasting

FAULT_S, BEGINS_S, FAILS_S = 0.3, 6.2, 5.5
WELL = 5  # frames in a row
IN_PARTS = "clipped", "fifo_overflow", "electrode_open", CONTACT_RISES, "mux_stuck", "sequence_gaps", "frozen"
MARKS: dict[str, Any] = dict.fromkeys(IN_PARTS, ())
MARKS["gain"] = pytest.mark.xfail(reason="for some parts a gain that steps within a scan is a small touch")
SMALL_RISE = {"electrode": 12, "times": 1.75}  # a large one is a touch on its electrode in the parts before it is named
CASES = [pytest.param(row, "full", id=f"{row.title}-full") for row in ROWS] + [
    pytest.param(row, "rolling", id=f"{row.title}-rolling", marks=MARKS.get(row.title, pytest.mark.release))
    for row in ROWS
]


@pytest.mark.parametrize(("row", "scan"), CASES)
def test_a_fault_is_named_and_wrong_nowhere_and_soon_over(row: FaultRow, scan: ScanMode) -> None:
    """Where nothing touches, and then under a touch that is held."""
    args, at = row.draw(np.random.default_rng([5, *row.title.encode()])), BEGINS_S
    if row.title == CONTACT_RISES and scan == "rolling":
        args = SMALL_RISE
    host = tared(scan)
    lasts_s = 1.5 if row.board else FAULT_S  # a board is asked how it is now and then
    for press in (None, DiscPress(0.012, -0.02, 0.0, 60.0, ramp=0.05)):
        if press is not None:
            press, at = replace(press, start=host.now + 0.05), host.now + 0.5
        played = script(*[press] * (press is not None), cues=row.cues(args, at, lasts_s))
        played = replace(played, contact=row.contact(args, at, lasts_s))
        host.rig.field.play(host.rig.timeline(played, 0.0), host.now)
        over = at + lasts_s
        host.until(over)
        while not well(host, over, int(press is not None)):
            assert host.now < over + row.recovery_s + 0.3
            host.until(host.now + 0.05)
        assert not (row.names or row.board) or named(host, row, at, over)
        wrong = [each for each in host.wrong(at) if "changing" not in each.frame.reasons]
        assert not wrong, "\n".join(map(str, wrong[:5]))
    host.close()


def well(host: SimulatedHost, since: float, touches: int) -> bool:
    last = [frame for at, frame in host.contacts[-WELL:] if at > since]
    return len(last) == WELL and all(frame.valid and len(lasting(frame)) == touches for frame in last)


def named(host: SimulatedHost, row: FaultRow, at: float, over: float) -> bool:
    said = row.board and any(text for when, text in host.problems if at <= when <= over + 0.2)
    return said or any(set(row.names) & set(f.reasons) for t, f in host.contacts if at <= t <= over + 0.1)


def test_every_fault_of_the_stub_has_a_row_with_arguments_that_it_takes() -> None:
    assert {row.fault for row in ROWS} == set(FAULTS) | {CONTACT_RISES}
    known = Faults()
    for row, seed in ((row, seed) for row in ROWS for seed in range(20) if row.fault != CONTACT_RISES):
        known.inject(row.fault, row.draw(np.random.default_rng(seed)), 0.0, 1.0)


ONE, OTHER = spread(2, 5)


@pytest.mark.parametrize(
    ("title", "situation", "touch", "seed", "args"),
    [
        (CONTACT_RISES, "sliding", ONE, 5, None),  # it differs from the frames before for a few frames only
        ("fifo_overflow", "held", OTHER, 6, None),  # after it a touch waits to be confirmed
        # a gain that was believed meanwhile is given up
        pytest.param("fifo_overflow, silent", "begins", ONE, 5, None, marks=pytest.mark.release),
        ("gain", "untouched", disc(0.01, 0.01, 3.0), 1, {"factor": 1.002}),  # too small to be named
    ],
)
def test_a_fault_in_a_session_is_never_wrong_and_over_in_time(
    title: str, situation: str, touch: Touch, seed: int, args: dict[str, Any] | None
) -> None:
    row, bundle, skin = row_of(title), loaded("square16"), skin_of("full", "square16")
    drawn = args or row.draw(np.random.default_rng([seed, *row.title.encode()]))
    scene = replace(plans.fault_case(row, drawn, situation, touch, BEGIN_S), seconds=12.8)
    with private_runtime():
        session = PlayedSession(SessionPlan("", seed, scene.seconds), scene, solved_sheet(), skin, bundle)
        score = session.judged({"": Today(skin, bundle)})[""]
    wrong = ("phantom", "hidden", "hidden briefly", "back late", "refused", "aged")
    assert {key: score.counts[key] for key in wrong} == dict.fromkeys(wrong, 0), score.notes
    assert score.counts["ended"] == 1 and (args or score.counts["named"] == score.counts["faults"])
    assert title != CONTACT_RISES or score.percent("in fault valid", "in fault") > 50


OFF_THE_SKIN = (step(9, 1000.0, FAILS_S),)  # changes the rest of it as a touch would: one stood for eleven seconds
# drift is seen through the changed contact: learnt without it, its covariance was none after a minute
UP_AND_DOWN = ((4, ramp((0, 1.0), *((FAILS_S + 20 * k, 1.0 + 2 * (k % 2)) for k in range(5)))),)


@pytest.mark.parametrize(
    ("seconds", "contact"),
    [
        (15.0, OFF_THE_SKIN),
        pytest.param(60.0, OFF_THE_SKIN, marks=pytest.mark.release),
        pytest.param(65.0, UP_AND_DOWN, marks=pytest.mark.release),
    ],
)  # fmt: skip
def test_presses_are_shown_beside_an_electrode_that_failed(seconds: float, contact: ContactCurves) -> None:
    """A press every three seconds."""
    begins = np.arange(FAILS_S + 1.5, seconds - 2.5, 3.0).tolist()
    tracks = [path_of(touch, t, t + 1.5) for touch, t in zip(spread(len(begins), 2), begins, strict=True)]
    host = SimulatedHost("full", 80.0, 2, script=script(*tracks, contact=contact), late_s=LATE_S)
    for second in np.arange(1.0, seconds + 0.5):
        host.until(float(second))
        assert contact is not OFF_THE_SKIN or second < FAILS_S + 2 or host.pipeline.delta.electrodes[9]  # type: ignore[union-attr]
    host.close()
    frames = [(at, frame) for at, frame in host.contacts if at > FAILS_S + 1.0]
    assert not host.wrong(FAILS_S + 1.0) and len(host.valid(FAILS_S + 1.0)) > 0.99 * len(frames)
