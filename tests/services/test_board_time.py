"""Time at the board's end: which scans are believed, how old they are, and what is said when that is not known."""

import threading
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_stub.rig import Rig
from firmware_stub.timeline import Script, Timeline
from models.bundle import Bundle
from protocol import link
from protocol.frames import RawFrame
from services.acquisition import SourceFeed
from services.board.clock import DeviceClock
from services.board.frozen import FrozenScans
from services.board.host_time import HostTime
from services.board.remarks import FROZEN as FROZEN_TEXT
from services.board.remarks import UNKNOWN, UNTIMED
from services.board.scan_order import ScanOrder
from services.board.source import BoardSource
from services.board.time_questions import TimeQuestions
from services.runtime.config import Skin
from tests.services.stub_skin import sheet
from tests.waiting import WAIT_S

MS = 1_000_000
BEGAN = 10**12  # host ns at which the board's clock shows 0
LEAST_STEP_S = 2e-4


def heard(clock, until_s, late_s, from_s=0.0):
    """Frames of these times on the board's clock, late by so much."""
    for t in np.arange(from_s, until_s, 0.045):
        clock.observe(round(t * 1e6), BEGAN + round((t + late_s(t)) * 1e9))
    return clock


def off_ms(clock, t):
    """How much too late the clock says that this was."""
    return (clock.host_ns(round(t * 1e6)) - BEGAN - t * 1e9) / MS


def test_the_clock_finds_the_boards_rate_through_late_arrivals():
    """A crystal 40 ppm fast, frames late by 1 ms and an exponential 0.5 ms: known offset and slope must come out."""
    rng, clock = np.random.default_rng(0), DeviceClock()
    for n in range(2000):
        true_s, late = n * 0.045, 1e-3 + rng.exponential(0.5e-3)
        clock.observe(int(true_s * (1 + 40e-6) * 1e6) + 7_000_000, int((true_s + late) * 1e9) + BEGAN)
    us = int(90.0 * (1 + 40e-6) * 1e6) + 7_000_000
    assert clock.host_ns(us) == pytest.approx(90.0e9 + 1e6 + BEGAN, abs=150_000) and clock.sigma_ns(us) < 150_000


@pytest.mark.parametrize(("late_s", "slope"), [(0.4, 5e-3), (5.0, 20e-3)])
def test_what_comes_late_is_old_and_no_restart_and_a_growing_delay_no_crystal(late_s, slope):
    clock = heard(heard(DeviceClock(), 10.0, lambda t: 1e-3), 30.0, lambda t: late_s, 10.0)
    assert clock.resets == 0 and off_ms(clock, 29.0) == pytest.approx(1.0, abs=0.5)
    clock = heard(heard(DeviceClock(), 10.0, lambda t: 1e-3), 110.0, lambda t: 1e-3 + slope * (t - 10), 10.0)
    assert off_ms(clock, 110.0) <= min(1.0 + 100 * 1.0 + 3, 1e3 * slope * 100 / 2)  # crystals part by 1 ms/s


def test_a_timed_question_finds_a_delay_that_was_always_there():
    clock = DeviceClock()
    clock.timed = True
    heard(clock, 5.0, lambda t: 0.4)
    assert clock.unknown(5_000_000), "nothing has been asked yet"
    assert clock.answered(BEGAN + 5000 * MS, 5_000_000, BEGAN + 5400 * MS)
    assert clock.unknown(5_000_000) and clock.width_ns(5_000_000) == pytest.approx(400 * MS, rel=0.02)
    assert off_ms(clock, 5.0) == pytest.approx(0.0, abs=0.1), "as old as it can be"
    assert clock.sigma_ns(5_000_000) == pytest.approx(400 * MS / 12**0.5, rel=0.02)
    assert clock.answered(BEGAN + 5999 * MS, 6_000_000, BEGAN + 6004 * MS)
    assert not clock.unknown(6_000_000) and -1 <= off_ms(clock, 6.0) <= 4.0
    # 50 ms wide, where each crystal may err by 1 ms/s: no short round trip for 25 s
    assert clock.unknown(31_000_000) and not clock.unknown(26_000_000)


def test_only_what_cannot_be_is_a_jump_and_a_start_goes_on_or_begins_a_new_clock():
    clock = DeviceClock()
    assert clock.answered(BEGAN, 1_000, BEGAN + 4 * MS)
    assert clock.possible(2_000_000, BEGAN + 2000 * MS) and clock.possible(2_000_000, BEGAN + 9000 * MS)
    assert not clock.possible(2_000_000, BEGAN + 1990 * MS), "finished after it arrived"
    assert clock.answered(BEGAN + 1000 * MS, 2_000_000, BEGAN + 8000 * MS), "slow, yet possible"
    for jumped in (2_950_000, 3_050_000):
        assert not clock.answered(BEGAN + 3000 * MS, jumped, BEGAN + 3004 * MS)
    assert off_ms(clock, 3.0) == pytest.approx(0.0, abs=8.0), "and nothing was learnt from them"
    clock = DeviceClock()
    clock.started(BEGAN, 1_000, BEGAN + 4 * MS)
    clock.started(BEGAN + 5000 * MS, 5_002_000, BEGAN + 6000 * MS)
    assert clock.resets == 0 and off_ms(clock, 5.0) < 10
    clock.started(BEGAN + 9000 * MS, 500, BEGAN + 9003 * MS)
    assert clock.resets == 1 and (clock.host_ns(500) - BEGAN) / MS == pytest.approx(9003, abs=0.1)


def test_answers_count_once_and_only_for_questions_that_were_asked():
    questions = TimeQuestions()
    questions.begin(10.0)
    (ask,) = link.Decoder().feed(questions.to_send(10.0, True, False))
    assert questions.to_send(10.45, True, False) == b""
    assert questions.to_send(10.5, True, True) == b"", "a scan is on the line"
    assert questions.to_send(10.5, True, False)
    assert [questions.sent_s(link.Time(ask.nonce ^ k, 5)) for k in (1, 0, 0)] == [None, 10.0, None]


def scan(seq, device_us, duration_us=44_000, config=1):
    return link.ScanFrame(seq % 2**32, device_us, duration_us, config, np.ones(2, np.complex64), np.zeros(2, np.uint8))


def test_number_and_time_of_a_scan_go_together():
    order = ScanOrder()
    order.started(10_000_000)
    assert not order.consistent(scan(7000, 9_000_000)), "ended before START"
    assert order.consistent(scan(7000, 9_990_000)), "was under way"
    order.take(scan(0, 10_000_000))
    assert order.missing(scan(0, 0)) == -1 and order.missing(scan(-1, 0)) == -2
    for seq, device_us, good in (
        (1, 10_044_000, True), (1, 10_144_000, True),  # the next, and after a pause
        (1, 10_000_000, False), (1, 5_000_000, False), (1, 15_000_000, False),
        (101, 14_400_000, True), (101, 10_044_000, False), (101, 99_000_000, False),
    ):  # fmt: skip
        assert order.consistent(scan(seq, device_us)) is good, (seq, device_us)
    order.take(scan(1, 10_044_000))
    order.take(scan(2, 10_088_000, 2_000, 2))  # a short list
    assert order.consistent(scan(102, 10_300_000, 2_000, 2)) and order.consistent(scan(102, 14_400_000, 2_000, 2))


def frozen(values):
    scans, zeros = FrozenScans(), np.zeros(values.shape[1], np.uint8)
    frames = (link.ScanFrame(n, n * 44_000, 44_000, 1, z.astype(np.complex64), zeros) for n, z in enumerate(values))
    return [scans(one) for one in frames], scans


def test_frozen_scans_are_found_where_noise_is_known_and_a_board_without_noise_repeats_itself_by_right():
    rng = np.random.default_rng(0)
    noisy = 100 * (1 + 1e-4 * rng.standard_normal((40, 120)))
    found, _ = frozen(np.vstack([noisy, np.tile(noisy[-1], (10, 1)), noisy]))
    assert found == [False] * 41 + [True] * 9 + [False] * 40, "from the third alike on"
    t = np.linspace(0, 1, 60)[:, None]
    below = np.round(100 + 0.05 * rng.standard_normal((60, 120))) + (rng.random((60, 120)) < 0.02)  # a register's step
    for values in (below, *(100 + moved * noisy[0] for moved in (0 * t, t, np.abs((4 * t) % 2 - 1)))):
        found, scans = frozen(np.vstack([values, np.tile(values[-1], (20, 1))]))
        assert not any(found) and not scans.noisy


class DelayedLine(HostTime):
    """A port with the stub board behind it and the host's clock in one, in simulated time, which goes on while somebody
    waits for bytes, or sleeps. held_s: for how long [s] bytes are held up that enter the line at a time [s].
    """

    url = "socket://simulated:1"

    def __init__(self, held_s=lambda t: 0.0, answers_time=True):
        self.rig = Rig(sheet(), seed=1, answers_time=answers_time)
        self.rig.field.play(Timeline(Script("nothing"), 0.0, (), self.rig.sheet.electrodes), 0.0)
        self.captured = []  # every scan that entered the line
        self.happenings = []  # (when, what)
        self._delay, self.to_host, self._to_board = held_s, deque(), deque()  # (when it arrives, what)
        self._measured, self._middles, self._decoder = {}, {}, link.Decoder()
        self.true_s = self._stop_s = self._suspended_s = 0.0
        self._rng, self.close = np.random.default_rng(1), lambda: None

    def stop(self, seconds):
        """The process does not run for so long; the kernel keeps what comes."""
        self._stop_s = seconds

    def suspend(self, seconds):
        """The machine sleeps, and its monotonic clock with it; the board goes on."""
        self._go_on(self.true_s + seconds)
        self._suspended_s += seconds

    def now_ns(self):
        return BEGAN + round((self.true_s - self._suspended_s) * 1e9)

    def suspended_ns(self):
        return round(self._suspended_s * 1e9)

    def sleep(self, seconds):
        self._go_on(self.true_s + seconds)
        self._stand_still()

    def read(self, timeout_s):
        end = self.true_s + timeout_s
        while True:
            self._stand_still()
            data = b""
            while self.to_host and self.to_host[0][0] <= self.true_s:
                data += self.to_host.popleft()[1]
            if data or self.true_s >= end:
                return data
            self._step(end)
            if self.to_host and self.to_host[0][0] <= self.true_s:  # read a little later: a scheduler's doing
                self._go_on(self.true_s + 0.002 * float(self._rng.random()) ** 2)

    def write(self, data):
        self._to_board.append((self.true_s, data))

    def _stand_still(self):
        seconds, self._stop_s = self._stop_s, 0.0
        self._go_on(self.true_s + seconds)

    def _go_on(self, until):
        while self.true_s < until:
            self._step(until)

    def _step(self, until):
        """Go on to the next event, or to that time."""
        due = [self.true_s + max(LEAST_STEP_S, self.rig.wake_s(self.true_s)), until]
        due += [queue[0][0] for queue in (self.to_host,) if queue and queue[0][0] > self.true_s]
        due += [max(queue[0][0], self.true_s + LEAST_STEP_S) for queue in (self._to_board, self.happenings) if queue]
        self.true_s = min(due)
        while self.happenings and self.happenings[0][0] <= self.true_s:
            self.happenings.pop(0)[1](self)
        while self._to_board and self._to_board[0][0] <= self.true_s:
            self.rig.feed(self._to_board.popleft()[1], self.true_s)
        data = self.rig.pull(self.true_s)
        while self.rig.scans:
            scan, _, middle = self.rig.scans.popleft()
            self._middles[scan.seq] = middle
        for message in self._decoder.feed(data):
            if isinstance(message, link.ScanFrame):
                self._measured.setdefault(np.sort(message.z).tobytes(), self._middles[message.seq])
                self.captured.append(link.encode(message))
        if data:
            arrives = self.true_s + self._delay(self.true_s)
            self.to_host.append((max(arrives, self.to_host[-1][0]) if self.to_host else arrives, data))

    def seen(self, frame):
        """A frame as acquisition gave it out: when, how long ago its values were measured, and by its stamp."""
        stated_s = (self.now_ns() - frame.stamps["sample"]) * 1e-9
        usable = frame.valid and stated_s <= frame.valid_for_s  # late ones are not, to whoever hands them on
        true_s = self.true_s - self._measured[np.sort(frame.z).tobytes()]  # in an order of its own
        return SimpleNamespace(at_s=self.true_s, frame=frame, true_age_s=true_s, stated_age_s=stated_s, usable=usable)


class Seen:
    """What acquisition gave out of a line to which something happens at a time."""

    def __init__(self, seconds, *happenings, **line):
        line, self.frames = DelayedLine(**line), []
        line.happenings += happenings
        source = BoardSource("palm", Skin(port=line.url, bundle="square16", scan="full"), Bundle.load("square16"), line)
        source.open_port = lambda url: line
        for frame in source.frames():
            if line.true_s >= seconds:
                break
            self.frames += [line.seen(frame)] if frame is not None else []
        self.messages, self.counts = source.health().messages, source.counts

    def after(self, seconds, until=1e9):
        return [s for s in self.frames if seconds < s.at_s < until]

    def off_s(self, since_s=0.0):
        """How far the ages that frames state are from the true ones."""
        return max(abs(s.stated_age_s - s.true_age_s) for s in self.after(since_s))


def fault(kind, *until, **args):
    return lambda line: line.rig.fault(kind, args, line.true_s, *until)


def test_a_frame_states_its_age_although_its_bytes_were_held_up():
    seen = Seen(7.0, held_s=lambda t: 0.9 if t > 3 else 0.0)
    late = seen.after(4.5)
    assert min(s.true_age_s for s in late) > 0.9 and seen.off_s(4.5) < 0.02
    assert seen.counts["restarts"] == 1 and not seen.messages  # as the board came up
    assert all(s.usable for s in seen.after(0, 3)) and not any(s.usable for s in late)


def test_a_delay_from_the_start_is_seen_by_asking_and_said():
    seen = Seen(5.0, held_s=lambda t: 0.4)
    assert len(seen.frames) > 50 and not any(s.frame.valid for s in seen.frames)
    assert all("clock" in s.frame.reasons for s in seen.frames) and UNKNOWN in seen.messages
    assert all(s.stated_age_s >= s.true_age_s - 0.005 for s in seen.frames), "rather too old than too young"
    seen = Seen(5.0, answers_time=False)
    assert all(s.usable for s in seen.frames) and seen.messages == [UNTIMED] and seen.off_s() < 0.004
    doubted = ["clock" in s.frame.reasons for s in seen.frames]
    assert doubted[0] and not doubted[-1] and doubted == sorted(doubted, reverse=True), "until its line is settled"


@pytest.mark.parametrize("by", [-5.0, 5.0])
def test_a_clock_that_jumps_is_said_and_asked_for_anew(by):
    seen = Seen(8.0, (6.0, fault("clock_jump", by=by)))
    assert seen.counts["clock_jumps"] == 1
    doubted = [s for s in seen.frames if "clock" in s.frame.reasons]
    assert len(doubted) == 3 and not any(s.frame.valid for s in doubted) and 6.0 < doubted[0].at_s < 6.4
    assert all(s.usable for s in seen.after(7.0)) and seen.off_s(7.0) < 0.004


def test_a_frozen_board_is_named():
    seen = Seen(5.0, (3.0, fault("frozen", 60.0)))
    assert all(s.usable for s in seen.after(0, 3)) and FROZEN_TEXT in seen.messages
    assert all("frozen" in s.frame.reasons and not s.frame.valid for s in seen.after(3.2))


def test_captured_scans_are_refused_before_and_after_a_restart():
    def again(line):
        for data in line.captured[10:40]:
            line.to_host.append((line.true_s, data))

    seen = Seen(7.0, (3.0, again), (4.0, fault("power_cycle")), (4.3, again), (6.0, again))
    assert seen.counts["foreign"] + seen.counts["repeated"] >= 90 and max(s.true_age_s for s in seen.frames) < 0.06


def test_after_a_standstill_the_newest_scan_goes_on_and_after_a_suspension_the_clock_begins_anew():
    seen = Seen(8.0, (3.0, lambda line: line.stop(3.0)))
    assert seen.counts["standstills"] == 1 and 60 < seen.counts["skipped"] < 70 and seen.counts["restarts"] == 1
    first = seen.after(5.9)[0]
    assert first.at_s < 6.1 and first.true_age_s < 0.06 and "gap" in first.frame.reasons
    assert any("stood still for 3." in m for m in seen.messages) and seen.off_s() < 0.004
    seen = Seen(26.0, (3.0, lambda line: line.suspend(20.0)))
    assert seen.counts["restarts"] == 2 and seen.counts["foreign"] > 400 and len(seen.after(23.0)) > 50
    assert max(s.true_age_s for s in seen.frames) < 0.06 and seen.off_s() < 0.004


@pytest.mark.live
def test_frames_that_wait_while_the_machine_sleeps_are_dropped(skin, bundle):
    """The monotonic clock stood still meanwhile: by their stamps they would be new."""

    slept_ns, done = [0, 0, 60 * 10**9], threading.Event()

    def frames():
        for k in range(3):
            host.suspended_ns = lambda k=k: slept_ns[k]
            yield RawFrame(skin="palm", scan=k, z=np.ones(2, np.complex64), status=np.zeros(2, np.uint8))
        done.set()
        source.ending.wait()

    host, source = HostTime(), BoardSource("palm", skin, bundle)
    source.frames = frames
    feed = SourceFeed(source, host)
    assert done.wait(WAIT_S) and feed.recv().scan == 2 and feed.slept_over == 2 and feed.recv() is None
    feed.close()
