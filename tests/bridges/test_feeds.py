"""What bridges read of a skin: at most so often, and what is new at once."""

import pytest

from bridges.clock import WallClock
from protocol.feeds import ContactPace, Measured
from protocol.frames import Contact, ContactFrame

PART_NS = 4_358_000  # of a scan in parts


def frame(*contacts: tuple[int, str], reasons: tuple[str, ...] = ()) -> ContactFrame:
    found = [Contact(id=number, state=state, position=[0.0, 0.0, 0.0]) for number, state in contacts]
    return ContactFrame(skin="palm", valid=True, reasons=list(reasons), contacts=found)


def test_parts_that_say_the_same_keep_the_rate_and_lose_none_below_it() -> None:
    for rate_hz in (20.0, 60.0, 100.0):
        pace = ContactPace(rate_hz)
        passed = [k for k in range(2294) if pace.passes(Measured(frame((1, "update")), k * PART_NS))]
        assert len(passed) == pytest.approx(10 * rate_hz, rel=0.02)
    pace = ContactPace(1000.0)
    assert all(pace.passes(Measured(frame((1, "update")), k * PART_NS)) for k in range(100))


def test_what_begins_ends_or_is_known_otherwise_passes_at_once() -> None:
    pace, one = ContactPace(10.0), (1, "update")
    told = [frame(), frame((1, "begin")), frame(one), frame(one, reasons=("coarse",)), frame(one, (2, "begin"))]
    told += [frame(one, (2, "end")), frame()]
    assert all(pace.passes(Measured(each, k * PART_NS)) for k, each in enumerate(told))
    assert not pace.passes(Measured(frame(), len(told) * PART_NS))
    pace.refused()
    assert pace.passes(Measured(frame(), (len(told) + 1) * PART_NS)), "what is valid again"
    assert pace.passes(Measured(frame(), 0)), "a clock that begins anew"


def test_time_follows_the_systems_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic_ns", lambda: 5_000)
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000_000_000_000)
    clock = WallClock()
    assert clock.time_ns(2_000_005_000) == 1_700_000_002_000_000_000
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_010_000_000_000)
    clock.measure()
    assert clock.time_ns(2_000_005_000) == 1_700_000_012_000_000_000 and clock.steps == 1
