"""`begin` and `end` of contacts stay long enough for a reader that takes the newest frame now and then."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.frames import Contact, ContactFrame
from services.contacts.lasting import LASTS_NS, LastingStates
from tests.services.rolling_host import rolling_host

MS = 1_000_000
READS_S = 0.040  # a slow controller's period


def contact(number: int, state: str) -> Contact:
    return Contact(id=number, state=state, position=[0.0, 0.0, 0.0])


def states(contacts: list[Contact]) -> dict[int, str]:
    return {c.id: c.state for c in contacts}


def test_both_are_repeated_for_50_ms() -> None:
    lasting = LastingStates()
    assert states(lasting([contact(1, "begin")], 0)) == {1: "begin"}
    assert states(lasting([contact(1, "hold")], LASTS_NS - 1)) == {1: "begin"}
    assert states(lasting([contact(1, "hold")], LASTS_NS)) == {1: "hold"}
    assert states(lasting([contact(1, "end")], 60 * MS)) == {1: "end"}
    assert states(lasting([contact(2, "begin")], 80 * MS)) == {1: "end", 2: "begin"}
    assert states(lasting([contact(2, "hold")], 111 * MS)) == {2: "begin"}


def test_a_touch_that_is_there_again_has_not_ended() -> None:
    lasting = LastingStates()
    lasting([contact(1, "end")], 0)
    assert states(lasting([contact(1, "hold")], 5 * MS)) == {1: "hold"}


def test_what_lasts_goes_with_a_recording() -> None:
    first, second = LastingStates(), LastingStates()
    first([contact(1, "end"), contact(2, "begin")], 0)
    second.load(first.state())
    later = [contact(2, "hold")]
    assert states(first(later, 9 * MS)) == states(second(later, 9 * MS)) == {1: "end", 2: "begin"}


@pytest.mark.release
def test_a_slow_reader_of_the_newest_frame_sees_every_touch_begin_and_end() -> None:
    rng = np.random.default_rng(5)
    with rolling_host(seed=6) as host:
        first = len(host.contacts)
        for _ in range(6):
            x, y = rng.uniform(-0.03, 0.03, 2)
            host.press(x=x, y=y, force=2.0, radius=0.01, seconds=60.0)
            host.until(host.now + rng.uniform(0.06, 0.25))
            host.release()
            host.until(host.now + rng.uniform(0.15, 0.3))
        came = host.contacts[first:]
    told = said(frame for _, frame in came)
    assert len(told) >= 6
    times = np.array([t for t, _ in came])
    for phase in np.arange(0.0, READS_S, READS_S / 8):
        reads = np.searchsorted(times, np.arange(times[0] + phase, times[-1], READS_S), side="right") - 1
        seen = said(came[k][1] for k in dict.fromkeys(reads[reads >= 0].tolist()))
        missed = {number for number in told if not {"begin", "end"} <= seen.get(number, set())}
        assert not missed, f"read every {1e3 * READS_S:.0f} ms from {1e3 * phase:.0f} ms on: {missed} of {set(told)}"


def said(frames: object) -> dict[int, set[str]]:
    """The states in which valid frames listed each contact."""
    found: dict[int, set[str]] = {}
    for frame in frames:  # type: ignore[attr-defined]
        assert isinstance(frame, ContactFrame)
        for c in frame.contacts if frame.valid else []:
            found.setdefault(c.id, set()).add(c.state)
    return found
