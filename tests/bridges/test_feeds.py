"""What bridges read of a skin: at most so often, and what is new at once."""

from __future__ import annotations

import time

import pytest

from bridges.feeds import ContactFeed, ContactPace, Measured
from protocol.frames import Contact, ContactFrame
from tests.bridges.conftest import FakeService

PART_NS = 4_358_000  # of a scan in parts


def frame(*contacts: Contact, reasons: tuple[str, ...] = ()) -> ContactFrame:
    return ContactFrame(skin="palm", valid=True, reasons=list(reasons), contacts=list(contacts))


def touch(number: int, state: str = "update") -> Contact:
    return Contact(id=number, state=state, position=[0.0, 0.0, 0.0])


@pytest.mark.parametrize("rate_hz", [20.0, 60.0, 100.0])
def test_parts_that_say_the_same_keep_the_rate(rate_hz: float) -> None:
    pace = ContactPace(rate_hz)
    passed = [k for k in range(2294) if pace.passes(Measured(frame(touch(1)), k * PART_NS))]
    assert len(passed) == pytest.approx(10 * rate_hz, rel=0.02)


def test_a_rate_above_that_of_the_parts_loses_none() -> None:
    pace = ContactPace(1000.0)
    assert all(pace.passes(Measured(frame(touch(1)), k * PART_NS)) for k in range(100))


def test_what_begins_ends_or_is_known_otherwise_passes_at_once() -> None:
    pace = ContactPace(10.0)
    told = [
        frame(),
        frame(touch(1, "begin")),
        frame(touch(1)),
        frame(touch(1), reasons=("coarse",)),
        frame(touch(1), touch(2, "begin")),
        frame(touch(1), touch(2, "end")),
        frame(),
    ]
    assert all(pace.passes(Measured(each, k * PART_NS)) for k, each in enumerate(told))
    assert not pace.passes(Measured(frame(), len(told) * PART_NS))


def test_what_is_valid_again_passes_at_once() -> None:
    pace = ContactPace(10.0)
    assert pace.passes(Measured(frame(), 0)) and not pace.passes(Measured(frame(), PART_NS))
    pace.refused()
    assert pace.passes(Measured(frame(), 2 * PART_NS))


def test_a_clock_that_begins_anew_withholds_nothing() -> None:
    pace = ContactPace(10.0)
    assert pace.passes(Measured(frame(), 10**12)) and pace.passes(Measured(frame(), 10**9))


def test_a_feed_of_a_service_in_parts_is_paced_and_tells_a_beginning_at_once(fake: FakeService) -> None:
    fake.every_s = 0.004
    feed = ContactFeed("palm", rate_hz=5.0)
    feed.want(True)

    def taken(seconds: float) -> list[Measured]:
        found, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            got = feed.take(time.monotonic_ns())
            found += [got] if isinstance(got, Measured) else []
            time.sleep(0.001)
        return found

    taken(0.5)
    sent = len(fake.sent)
    held = taken(2.0)
    assert 5 <= len(held) <= 11 and len(fake.sent) - sent > 5 * len(held)
    sent, fake.contact = fake.scan, 2
    began = next(each.frame for each in taken(0.5) if each.frame.contacts[0].id == 2)
    assert began.scan - sent < 25  # 0.1 s, half of what the rate alone would wait for
    feed.close()
