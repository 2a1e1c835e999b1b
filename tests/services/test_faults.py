"""Faults of the stub's board, bytes in: each is named, makes no contact, hides none, and is soon over."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_stub.faults import FAULTS, Faults
from services.runtime.config import ScanMode
from simulation.faults import CONTACT_RISES, ROWS, FaultRow
from simulation.host import LATE_S, SimulatedHost, tared
from simulation.scenes import DiscPress, path_of, script, spread, step
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


def test_presses_are_shown_beside_an_electrode_that_is_off_the_skin() -> None:
    """A press every three seconds. It changes the rest of the skin as a touch would: one stood for eleven seconds."""
    begins = np.arange(FAILS_S + 1.5, 15.0 - 2.5, 3.0).tolist()
    tracks = [path_of(touch, t, t + 1.5) for touch, t in zip(spread(len(begins), 2), begins, strict=True)]
    host = SimulatedHost("full", 80.0, 2, script=script(*tracks, contact=(step(9, 1000.0, FAILS_S),)), late_s=LATE_S)
    for second in np.arange(1.0, 15.5):
        host.until(float(second))
        assert second < FAILS_S + 2 or host.pipeline.delta.electrodes[9]  # type: ignore[union-attr]
    host.close()
    frames = [(at, frame) for at, frame in host.contacts if at > FAILS_S + 1.0]
    assert not host.wrong(FAILS_S + 1.0) and len(host.valid(FAILS_S + 1.0)) > 0.99 * len(frames)
