"""What `skin top` and `skin compare` make of frames."""

from __future__ import annotations

import time

import numpy as np

from protocol.frames import Contact, ContactFrame, InfoFrame, RawFrame, StatusFrame, TrueTouch, TruthFrame
from protocol.runtime import host_id
from services.cli.heatmap import LETTERS, coarse, draw
from services.cli.monitor import Monitor, percentile
from services.cli.truth import pairs
from services.polygon import inside


def raw(scan: int, age_s: float) -> RawFrame:
    sample = time.monotonic_ns() - int(age_s * 1e9)
    return RawFrame(
        skin="palm", scan=scan, host=host_id(), stamps={"sample": sample}, z=np.ones(3, "c8"), status=np.zeros(3, "u1")
    )


def test_rates_and_latencies_are_counted_from_frames(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    now = time.monotonic()
    monitor.started_s = now - 2
    for k in range(40):
        frame = raw(k, 0.010)
        frame.stamps["sample"] = round((now - 0.010) * 1e9)  # however long the loop takes
        monitor.take(frame, now)
    row = monitor.snapshot()["topics"]["raw"]
    assert 19 < row["rate_hz"] <= 20 and 9.9 < row["latency_ms"]["p50"] < 10.1


def test_time_since_read_is_the_services_own(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    frame = raw(1, 0.050)
    frame.stamps["read"] = time.monotonic_ns() - 2_000_000
    monitor.take(frame, time.monotonic())
    row = monitor.snapshot()["topics"]["raw"]
    assert row["latency_ms"]["p50"] > 49 and 1.9 < row["since_read_ms"]["p50"] < 30


def test_what_skip_rules_spared_is_of_the_last_second(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    counts = {"networks_run": 100, "held": 0, "untouched": 0}
    for more in ({}, {"networks_run": 105, "held": 10, "untouched": 5}):
        status = StatusFrame(skin="palm", process="inference", level="OK", counters=counts | more)
        monitor.take(status, time.monotonic())
    row = monitor.snapshot()["processes"]["inference"]
    assert row["skipped"] == {"untouched": 0.25, "held": 0.5}
    monitor.take(StatusFrame(skin="palm", process="inference", counters={"networks_run": 1}), time.monotonic())
    assert monitor.snapshot()["processes"]["inference"]["skipped"] == {}  # begun anew


def test_a_replayed_or_foreign_frame_has_no_latency(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    for change in ({"source": "replay"}, {"host": "elsewhere"}):
        frame = raw(1, 100.0)
        for name, value in change.items():
            setattr(frame, name, value)
        monitor.take(frame, time.monotonic())
    assert monitor.snapshot()["topics"]["raw"]["latency_ms"] == {"p50": None, "p99": None}


def test_a_silent_process_is_stale_whatever_it_said_last(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    monitor.take(StatusFrame(skin="palm", process="inference", level="OK"), time.monotonic() - 10)
    row = monitor.snapshot()["processes"]["inference"]
    assert row["level"] == "STALE" and row["messages"] == ["silent for 10 s"]


def test_info_is_kept(runtime) -> None:  # type: ignore[no-untyped-def]
    monitor = Monitor("palm")
    monitor.take(InfoFrame(skin="palm", info={"bundle": "square16"}), 0.0)
    assert monitor.info["bundle"] == "square16" and not monitor.snapshot()["topics"]


def test_percentile() -> None:
    assert percentile([], 0.5) is None
    assert percentile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert percentile(list(range(100)), 0.99) == 99


def test_a_touch_is_drawn_where_it_is() -> None:
    """Up is up, right is right: a drop at the upper right comes out in the first lines' last columns."""
    image = np.zeros((96, 96), np.float32)
    image[80:90, 70:80] = 0.5
    lines = draw(image, 0.05, cells=32, coloured=False).plain.splitlines()
    marked = {(row, column) for row, text in enumerate(lines) for column, c in enumerate(text) if c == LETTERS[-1]}
    assert marked and all(row <= 3 and 22 <= column <= 27 for row, column in marked)


def test_a_contact_is_marked_and_outside_is_empty() -> None:
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    disc = (0.05 * np.stack([np.cos(angle), np.sin(angle)], 1)).tolist()
    lines = draw(None, 0.05, [(-0.03, 0.0)], disc, cells=32, coloured=False).plain.splitlines()
    assert lines[0][0] == " " and lines[8][16] == LETTERS[0]
    assert [(row, text.index("X")) for row, text in enumerate(lines) if "X" in text] == [(7, 6)]


def test_a_small_touch_does_not_fade() -> None:
    image = np.zeros((96, 96))
    image[50, 50] = 0.4
    assert coarse(image, 24).max() == 0.4


def test_inside_an_l() -> None:
    shape = [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]
    x, y = np.array([0.5, 1.5, 1.5, 0.5]), np.array([0.5, 0.5, 1.5, 1.5])
    assert inside(shape, x, y).tolist() == [True, True, False, True]


def test_each_true_touch_meets_the_nearest_contact() -> None:
    touches = [TrueTouch(shape="circle", x=x, y=0.0, radius_m=0.01, drop=0.3, force_n=3.0) for x in (0.03, -0.03)]
    found = [Contact(id=1, position=[-0.029, 0.0, 0.0], force_n=2.9), Contact(id=2, state="end", position=[0.03, 0, 0])]
    rows = pairs(TruthFrame(skin="palm", touches=touches), ContactFrame(skin="palm", contacts=found))
    assert rows[0]["found"] is None and rows[1]["found"]["id"] == 1  # the contact that ended is none
    assert abs(rows[1]["found"]["error_mm"] - 1.0) < 1e-6
