"""The seconds in memory: what a snapshot begins with."""

from __future__ import annotations

from services.recordings.recording import RecordedMessage
from services.recordings.ring import OVERHEAD_BYTES, Ring, RingEntry

S = 1_000_000_000


def heard(topic: str, at_s: float, data: str = "", key: str = "", again: bool = False) -> RingEntry:
    return RingEntry(RecordedMessage(topic, int(at_s * S), data.encode()), key, again)


def told(found: list[RecordedMessage]) -> list[tuple[str, float, str]]:
    return [(m.topic, m.log_time_ns / S, m.data.decode()) for m in found]


def test_it_holds_the_last_seconds_and_what_was_latched_before() -> None:
    ring = Ring(3.0, 10**6)
    ring.add(heard("info/palm", 0, "first", "info/palm/preprocessing"))
    ring.add(heard("status/palm", 0, "board", "status/palm/acquisition"))
    ring.add(heard("status/palm", 0, "stub", "status/palm/stub"))
    for k in range(10):
        ring.add(heard("raw/palm", k, str(k)))
    assert ring.held_s == 3.0 and ring.forgotten == 0
    found = told(ring.since(8 * S))
    assert found[:3] == [("info/palm", 8, "first"), ("status/palm", 8, "board"), ("status/palm", 8, "stub")]
    assert found[3:] == [("raw/palm", 8, "8"), ("raw/palm", 9, "9")]


def test_latched_values_are_those_of_the_beginning_not_of_now() -> None:
    ring = Ring(100, 10**6)
    for k, text in enumerate(["before", "within"]):
        ring.add(heard("info/palm", 2 * k, text, "info/palm/preprocessing"))
        ring.add(heard("raw/palm", 2 * k + 1))
    assert told(ring.since(int(0.5 * S))) == [
        ("info/palm", 1, "before"),
        ("raw/palm", 1, ""),
        ("info/palm", 2, "within"),
        ("raw/palm", 3, ""),
    ]


def test_it_begins_where_the_stages_state_is_known_and_leaves_later_ones_out() -> None:
    ring = Ring(100, 10**6)
    for k in range(10):
        if k % 3 == 0:
            ring.add(heard("state/palm", k, f"state {k}", "state/palm", again=True))
        ring.add(heard("raw/palm", k + 0.5, str(k)))
        if k == 7:
            ring.add(heard("state/palm", k + 0.6, "tare", "state/palm"))
    found = told(ring.since(int(5.2 * S)))
    assert found[0] == ("state/palm", 3, "state 3")  # the last one before, and so a little earlier
    assert [data for topic, _, data in found if topic == "state/palm"] == ["state 3", "tare"]
    assert [data for topic, _, data in found if topic == "raw/palm"] == ["3", "4", "5", "6", "7", "8", "9"]


def test_each_skin_begins_with_its_own_state() -> None:
    ring = Ring(100, 10**6)
    for skin, at in (("palm", 1), ("sole", 2)):
        ring.add(heard(f"state/{skin}", at, skin, f"state/{skin}", again=True))
    ring.add(heard("raw/palm", 3))
    found = told(ring.since(3 * S))
    assert found == [("state/palm", 1, "palm"), ("state/sole", 2, "sole"), ("raw/palm", 3, "")]


def test_a_state_that_fell_out_of_memory_is_still_the_one_to_begin_with() -> None:
    ring = Ring(2.0, 10**6)
    ring.add(heard("state/palm", 0, "old", "state/palm", again=True))
    for k in range(1, 6):
        ring.add(heard("raw/palm", k))
    assert told(ring.since(4 * S))[0] == ("state/palm", 4, "old")


def test_memory_is_bounded_and_what_had_to_go_is_counted() -> None:
    ring = Ring(1000, 10 * (100 + OVERHEAD_BYTES))
    for k in range(50):
        ring.add(heard("raw/palm", k, "x" * 100))
        assert ring.bytes <= ring.most_bytes
    assert ring.forgotten == 40 and len(ring.since(0)) == 10
    ring.add(heard("raw/palm", 51, "x" * 10**5))  # one that is larger than all of it
    assert len(ring.since(0)) == 1
