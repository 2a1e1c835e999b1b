"""What info says of how often contact frames come."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.frames import RawFrame
from services.describe import BaselineNews, FrameRate
from tests.services.rolling_host import rolling_host

STEP_NS = 4_500_000


def raw(scan: int, parts: int = 1, step_ns: int = STEP_NS, **fields: object) -> RawFrame:
    frame = RawFrame(skin="palm", z=np.ones(1, "c8"), status=np.zeros(1, "u1"), scan=scan, parts=parts)
    frame.stamps["sample"] = 10**9 + scan * step_ns
    for name, value in fields.items():
        setattr(frame, name, value)
    return frame


def test_it_is_that_of_whole_scans_and_of_parts_whatever_was_lost() -> None:
    rate = FrameRate()
    for scan in range(8):
        rate(raw(scan, parts=10))
    assert rate.found is None
    for scan in range(8, 60, 3):  # two of three were overtaken
        rate(raw(scan, parts=10))
    assert rate.found == {"least": pytest.approx(22.22, abs=0.01), "touched": pytest.approx(222.2, abs=0.1)}
    told = rate.found
    for scan in range(60, 120):
        rate(raw(scan, parts=10, step_ns=round(1.02 * STEP_NS)))
    assert rate.found is told, "as good as the same"
    for scan in range(20):  # the board began anew, and scans whole
        rate(raw(scan, step_ns=10 * STEP_NS))
    assert rate.found == {"least": pytest.approx(22.22, abs=0.01), "touched": pytest.approx(22.22, abs=0.01)}


def test_scans_that_do_not_follow_each_other_say_nothing() -> None:
    rate = FrameRate()
    for scan in range(40):
        rate(raw(scan, reasons=["separate"]))
        rate(raw(scan, kind="sentinel"))
    assert rate.found is None


def test_info_is_sent_again_with_another_rate() -> None:
    news = BaselineNews()
    assert news(None, 0) and not news(None, 1)
    assert news(None, 2, {"least": 22.0, "touched": 22.0}) and not news(None, 3, {"least": 22.0, "touched": 22.0})
    assert news(None, 4, {"least": 22.0, "touched": 220.0})


def test_info_of_rolling_scans_promises_the_rate_of_whole_ones() -> None:
    with rolling_host(seed=3) as host:
        info = host.pipeline.pre.info()
        assert info is not None and info["rate_hz"]["least"] == pytest.approx(22.9, rel=0.03)
        assert info["rate_hz"]["touched"] == pytest.approx(10 * info["rate_hz"]["least"], rel=0.01)
        came = np.array([f.stamps["sample"] for _, f in host.contacts[-40:]]) * 1e-9
        assert np.diff(came).max() < 1.1 / info["rate_hz"]["least"]
        host.press(x=0.01, y=0.0, force=2.0, radius=0.01, seconds=60.0)
        first = len(host.contacts)
        host.until(host.now + 0.5)
        when = np.array([t for t, _ in host.contacts[first:]])
        assert np.diff(when).max() < 3 / info["rate_hz"]["least"], "silence is still a fault"
        assert len(when) > 3 * 0.5 * info["rate_hz"]["least"]
