"""Time at the board's end: which scans are believed, how old they are, and what is said when that is not known."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from bench.stability.delayed_line import DelayedLine, ReceivedFrame, listen
from models.bundle import Bundle
from protocol import link
from protocol.frames import RawFrame
from services.acquisition import SourceFeed
from services.board.boardlink import BoardLink
from services.board.clock import MAX_RATE_ERROR, WIDE_NS, DeviceClock
from services.board.frozen import FROZEN, PROOF, FrozenScans
from services.board.host_time import HostTime
from services.board.remarks import FROZEN as FROZEN_TEXT
from services.board.remarks import UNKNOWN, UNTIMED
from services.board.scan_check import DOUBTED_SCANS
from services.board.scan_order import ScanOrder
from services.board.source import BoardSource, Source
from services.board.time_questions import ASK_EVERY_S, TimeQuestions
from services.runtime.config import Skin
from tests.services.fake_board import FakeBoard
from tests.services.test_acquisition import SCANNING

MS = 1_000_000
BEGAN = 10**12  # host ns at which the board's clock shows 0


def heard(clock: DeviceClock, seconds: np.ndarray, late_s: Callable[[float], float]) -> None:
    """Frames of these times on the board's clock, late by so much."""
    for t in seconds:
        clock.observe(round(t * 1e6), BEGAN + round((t + late_s(t)) * 1e9))


def off_ms(clock: DeviceClock, t: float) -> float:
    """How much too late the clock says that this was."""
    return (clock.host_ns(round(t * 1e6)) - BEGAN - t * 1e9) / MS


@pytest.mark.parametrize("late_s", [0.4, 0.9, 5.0])
def test_what_comes_late_is_old_and_no_restart(late_s: float) -> None:
    clock = DeviceClock()
    heard(clock, np.arange(0, 10, 0.045), lambda t: 1e-3)
    heard(clock, np.arange(10, 30, 0.045), lambda t: late_s)
    assert clock.resets == 0
    assert off_ms(clock, 29.0) == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("slope", [5e-3, 20e-3])
def test_a_growing_delay_is_no_crystal(slope: float) -> None:
    """For 100 s; what the crystals may part by is the most that it can hide."""
    clock = DeviceClock()
    heard(clock, np.arange(0, 10, 0.045), lambda t: 1e-3)
    heard(clock, np.arange(10, 110, 0.045), lambda t: 1e-3 + slope * (t - 10))
    assert off_ms(clock, 110.0) <= 1.0 + 1e3 * MAX_RATE_ERROR * 100 + 3
    assert off_ms(clock, 110.0) < 1e3 * slope * 100 / 2


def test_a_timed_question_finds_a_delay_that_was_always_there() -> None:
    clock = DeviceClock()
    clock.timed = True
    heard(clock, np.arange(0, 5, 0.045), lambda t: 0.4)
    assert clock.unknown(5_000_000), "nothing has been asked yet"
    assert clock.answered(BEGAN + 5000 * MS, 5_000_000, BEGAN + 5400 * MS)
    assert clock.unknown(5_000_000) and clock.width_ns(5_000_000) == pytest.approx(400 * MS, rel=0.02)
    assert off_ms(clock, 5.0) == pytest.approx(0.0, abs=0.1), "as old as it can be"
    assert clock.sigma_ns(5_000_000) == pytest.approx(400 * MS / 12**0.5, rel=0.02)
    assert clock.answered(BEGAN + 5999 * MS, 6_000_000, BEGAN + 6004 * MS)
    assert not clock.unknown(6_000_000) and -1 <= off_ms(clock, 6.0) <= 4.0
    longest_s = WIDE_NS / MS / (2 * 1e3 * MAX_RATE_ERROR)
    assert clock.unknown(round((6 + longest_s) * 1e6)), "no short round trip for some time"


def test_only_what_cannot_be_is_a_jump() -> None:
    clock = DeviceClock()
    assert clock.answered(BEGAN, 1_000, BEGAN + 4 * MS)
    assert clock.possible(2_000_000, BEGAN + 2000 * MS) and clock.possible(2_000_000, BEGAN + 9000 * MS)
    assert not clock.possible(2_000_000, BEGAN + 1990 * MS), "finished after it arrived"
    assert clock.answered(BEGAN + 1000 * MS, 2_000_000, BEGAN + 8000 * MS), "slow, yet possible"
    assert not clock.answered(BEGAN + 3000 * MS, 2_950_000, BEGAN + 3004 * MS), "went back by 50 ms"
    assert not clock.answered(BEGAN + 3000 * MS, 3_050_000, BEGAN + 3004 * MS), "went on by 50 ms"
    assert off_ms(clock, 3.0) == pytest.approx(0.0, abs=8.0), "and nothing was learnt from them"


def test_a_start_goes_on_with_the_clock_or_begins_a_new_one() -> None:
    clock = DeviceClock()
    clock.started(BEGAN, 1_000, BEGAN + 4 * MS)
    clock.started(BEGAN + 5000 * MS, 5_002_000, BEGAN + 6000 * MS)
    assert clock.resets == 0 and off_ms(clock, 5.0) < 10
    clock.started(BEGAN + 9000 * MS, 500, BEGAN + 9003 * MS)
    assert clock.resets == 1
    assert (clock.host_ns(500) - BEGAN) / MS == pytest.approx(9003, abs=0.1)


def test_answers_count_once_and_only_for_questions_that_were_asked() -> None:
    questions = TimeQuestions()
    questions.begin(10.0)
    (ask,) = link.Decoder().feed(questions.to_send(10.0, True, False))
    assert isinstance(ask, link.TimeAsk)
    assert questions.to_send(10.0 + ASK_EVERY_S / 2, True, False) == b""
    assert questions.to_send(10.0 + ASK_EVERY_S, True, True) == b"", "a scan is on the line"
    assert questions.to_send(10.0 + ASK_EVERY_S, True, False)
    assert questions.asked_s(link.Time(ask.nonce ^ 1, 5)) is None
    assert questions.asked_s(link.Time(ask.nonce, 5)) == 10.0
    assert questions.asked_s(link.Time(ask.nonce, 5)) is None


def scan(seq: int, device_us: int, duration_us: int = 44_000, config: int = 1) -> link.ScanFrame:
    return link.ScanFrame(seq % 2**32, device_us, duration_us, config, np.ones(2, np.complex64), np.zeros(2, np.uint8))


def test_number_and_time_of_a_scan_go_together() -> None:
    order = ScanOrder()
    order.started(10_000_000)
    assert not order.consistent(scan(7000, 9_000_000)), "ended before START"
    assert order.consistent(scan(7000, 9_990_000)), "was under way"
    order.take(scan(0, 10_000_000))
    assert order.missing(scan(0, 0)) == -1 and order.missing(scan(-1, 0)) == -2
    for seq, device_us, good in (
        (1, 10_044_000, True),
        (1, 10_144_000, True),  # after a pause
        (1, 10_000_000, False),  # the same once more
        (1, 5_000_000, False),
        (1, 15_000_000, False),
        (101, 14_400_000, True),
        (101, 10_044_000, False),  # a number far ahead
        (101, 99_000_000, False),
    ):
        assert order.consistent(scan(seq, device_us)) is good, (seq, device_us)
    order.take(scan(1, 10_044_000))
    order.take(scan(2, 10_088_000, 2_000, 2))  # a short list
    assert order.consistent(scan(102, 10_300_000, 2_000, 2)) and order.consistent(scan(102, 14_400_000, 2_000, 2))


def scans_of(values: np.ndarray) -> list[link.ScanFrame]:
    zeros = np.zeros(values.shape[1], np.uint8)
    return [link.ScanFrame(n, n * 44_000, 44_000, 1, z.astype(np.complex64), zeros) for n, z in enumerate(values)]


def test_frozen_scans_are_found_where_noise_is_known() -> None:
    rng = np.random.default_rng(0)
    noisy = 100 * (1 + 1e-4 * rng.standard_normal((40, 120)))
    values = np.vstack([noisy, np.tile(noisy[-1], (10, 1)), noisy])
    frozen, found = FrozenScans(), []
    for one in scans_of(values):
        found.append(frozen(one))
    assert found == [False] * (40 - 1 + FROZEN - 1) + [True] * (10 + 2 - FROZEN) + [False] * 39 + [False]


@pytest.mark.parametrize("kind", ["constant", "moving", "pressing and releasing", "below a register's step"])
def test_a_board_without_noise_repeats_itself_by_right(kind: str) -> None:
    rng = np.random.default_rng(0)
    t, pattern = np.linspace(0, 1, 60)[:, None], rng.standard_normal(120)
    moved = {
        "constant": 0 * t,
        "moving": t,
        "pressing and releasing": np.abs((4 * t) % 2 - 1),
        "below a register's step": 0 * t,
    }[kind] * pattern + 100
    if kind == "below a register's step":
        moved = np.round(moved + 0.05 * rng.standard_normal(moved.shape), 0) + (rng.random(moved.shape) < 0.02)
    frozen = FrozenScans()
    values = np.vstack([moved, np.tile(moved[-1], (20, 1))])
    assert not any(frozen(one) for one in scans_of(values)) and not frozen.noisy
    assert len(values) > PROOF + FROZEN


def run(line: DelayedLine, seconds: float) -> tuple[list[ReceivedFrame], list[str], dict[str, int]]:
    seen, source = listen(line, seconds)
    return seen, source.health().messages, dict(source.counts)


def after(seen: list[ReceivedFrame], seconds: float) -> list[ReceivedFrame]:
    return [s for s in seen if s.at_s > seconds]


def test_a_frame_states_its_age_although_its_bytes_were_held_up() -> None:
    seen, messages, counts = run(DelayedLine(1, to_host=lambda t: 0.9 if t > 3 else 0.0), 7.0)
    late = after(seen, 4.5)
    assert min(s.true_age_s for s in late) > 0.9
    assert max(abs(s.stated_age_s - s.true_age_s) for s in late) < 0.02
    assert counts["restarts"] == 1 and not messages  # as the board came up
    assert all(s.usable for s in seen if s.at_s < 3) and not any(s.usable for s in late)


def test_a_delay_from_the_start_is_seen_by_asking_and_said() -> None:
    seen, messages, _ = run(DelayedLine(1, to_host=lambda t: 0.4), 5.0)
    assert len(seen) > 50 and not any(s.frame.valid for s in seen)
    assert all("clock" in s.frame.reasons for s in seen) and UNKNOWN in messages
    assert all(s.stated_age_s >= s.true_age_s - 0.005 for s in seen), "rather too old than too young"


def test_a_board_that_does_not_tell_its_time_works_and_the_bound_is_said() -> None:
    seen, messages, _ = run(DelayedLine(1, answers_time=False), 5.0)
    assert all(s.usable for s in seen) and messages == [UNTIMED]
    assert max(abs(s.stated_age_s - s.true_age_s) for s in seen) < 0.004


@pytest.mark.parametrize("by", [-5.0, 5.0])
def test_a_clock_that_jumps_is_said_and_asked_for_anew(by: float) -> None:
    line = DelayedLine(1)
    line.at(6.0, lambda line: line.rig.fault("clock_jump", {"by": by}, line.true_s))
    seen, _, counts = run(line, 8.0)
    assert counts["clock_jumps"] == 1
    doubted = [s for s in seen if "clock" in s.frame.reasons]
    assert len(doubted) == DOUBTED_SCANS and not any(s.frame.valid for s in doubted)
    assert 6.0 < doubted[0].at_s < 6.4
    assert all(s.usable and abs(s.stated_age_s - s.true_age_s) < 0.004 for s in after(seen, 7.0))


def test_a_frozen_board_is_named() -> None:
    line = DelayedLine(1)
    line.at(3.0, lambda line: line.rig.fault("frozen", {}, line.true_s, 60.0))
    seen, messages, _ = run(line, 5.0)
    assert all(s.usable for s in seen if s.at_s < 3) and FROZEN_TEXT in messages
    assert all("frozen" in s.frame.reasons and not s.frame.valid for s in after(seen, 3.2))


def test_captured_scans_are_refused_before_and_after_a_restart() -> None:
    line = DelayedLine(1)
    replayed: set[bytes] = set()

    def again(line: DelayedLine) -> None:
        for data in line.captured[10:40]:
            replayed.add(data)
            line.inject(data)

    line.at(3.0, again)
    line.at(4.0, lambda line: line.rig.fault("power_cycle", {}, line.true_s))
    line.at(4.3, again)
    line.at(6.0, again)
    seen, _, counts = run(line, 7.0)
    assert len(replayed) == 30 and counts["foreign"] + counts["repeated"] >= 90
    assert max(s.true_age_s for s in seen) < 0.06


def test_after_a_standstill_only_the_newest_scan_goes_on() -> None:
    line = DelayedLine(1)
    line.at(3.0, lambda line: line.stop(3.0))
    seen, messages, counts = run(line, 8.0)
    assert counts["standstills"] == 1 and 60 < counts["skipped"] < 70 and counts["restarts"] == 1
    first = after(seen, 5.9)[0]
    assert first.at_s < 6.1 and first.true_age_s < 0.06 and "gap" in first.frame.reasons
    assert any("stood still for 3.0 s" in m or "stood still for 3.1 s" in m for m in messages)
    assert max(abs(s.stated_age_s - s.true_age_s) for s in seen) < 0.004


def test_after_a_suspension_the_clock_begins_anew() -> None:
    line = DelayedLine(1)
    line.at(3.0, lambda line: line.suspend(20.0))
    seen, _, counts = run(line, 26.0)
    assert counts["restarts"] == 2 and counts["foreign"] > 400
    assert len(after(seen, 23.0)) > 50
    assert max(s.true_age_s for s in seen) < 0.06
    assert max(abs(s.stated_age_s - s.true_age_s) for s in seen) < 0.004


def test_the_machines_own_clock_of_suspensions_stands_while_it_runs() -> None:
    host = HostTime()
    assert abs(host.suspended_ns() - host.suspended_ns()) < 2 * MS


def test_a_start_that_is_answered_with_the_time_settles_the_clock_at_once() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    board.ident = link.Ident(
        schema_hash=link.SCHEMA_HASH, capabilities=link.Capability.TIME, unique_id=bytes(12), firmware="fake 1.1"
    )
    now = 0.0
    board.clock = lambda: round((now + 7.0) * 1e6)
    while now < 0.2:
        host.received(board.receive(host.to_send(now)), now)
        now += 0.02
    assert [type(m).__name__ for m in board.heard] == ["Hello", "Config", "Start", "TimeAsk"]
    assert host.state == "running" and not host.clock_unknown
    assert not host.received(board.scan(6_000_000), now) and host.counts["foreign"] == 1, "from before START"
    board.seq = 0
    assert host.received(board.scan(7_100_000), now) and host.clock.host_ns(7_100_000) == pytest.approx(0.1e9, abs=MS)


def test_frames_that_wait_while_the_machine_sleeps_are_dropped(skin: Skin, bundle: Bundle) -> None:
    """The monotonic clock stood still meanwhile: by their stamps they would be new."""

    class Host(HostTime):
        slept_ns = 0

        def suspended_ns(self) -> int:
            return self.slept_ns

    class Three(Source):
        def frames(self) -> Iterator[RawFrame | None]:
            for k in range(3):
                host.slept_ns = 0 if k < 2 else 60 * 10**9
                yield RawFrame(skin="palm", scan=k, z=np.ones(2, np.complex64), status=np.zeros(2, np.uint8))
            done.set()
            yield from self._ended("no more")

    host, done = Host(), threading.Event()
    feed = SourceFeed(Three("palm", skin, bundle), host)
    try:
        assert done.wait(10)
        frame = feed.recv()
        assert frame is not None and frame.scan == 2 and feed.slept_over == 2
        assert feed.recv() is None
    finally:
        feed.close()


def test_trouble_that_comes_and_goes_is_logged_once(
    skin: Skin, bundle: Bundle, caplog: pytest.LogCaptureFixture
) -> None:
    source = BoardSource("palm", skin, bundle, DelayedLine(1))
    with caplog.at_level("INFO", logger="services.board.source"):
        for _ in range(50):
            source._trouble("the board's clock jumped")
            source._trouble("")
    assert len(caplog.records) == 2
