"""Faults of timing: delayed bytes, clocks that jump, scans sent again, a process or a machine that stands still.

The stub board behind a line that does these things, acquisition's own source at this end, in simulated time. The
promise: no frame that a reader may act on is older than its `valid_for_s` and SLACK_S, counted from when its values
were really measured; where time is well again, so are the frames.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from bench.stability.delayed_line import Delay, DelayedLine, Happening, ReceivedFrame, listen
from bench.stability.run import Row, Setting
from services.runtime.config import ScanMode

SLACK_S = 0.1
BEGIN_S = 4.0  # all is well until then
WELL_S = 2.0  # at the end, where time is well again
WELL_SHARE = 0.9  # of those frames


@dataclass(frozen=True)
class TimingCase:
    """seconds: how long it takes. well: whether all is well in its last WELL_S. quick: part of the short form."""

    name: str
    seconds: float
    to_host: Delay | None = None
    to_board: Delay | None = None
    at: list[tuple[float, Happening]] = field(default_factory=list)
    answers_time: bool = True
    well: bool = True
    quick: bool = True

    def line(self, seed: int, scan: ScanMode = "full") -> DelayedLine:
        made = DelayedLine(
            seed, to_host=self.to_host, to_board=self.to_board, answers_time=self.answers_time, scan=scan
        )
        for seconds, happening in self.at:
            made.at(seconds, happening)
        return made


def constant(delay_s: float) -> Delay:
    return lambda t: delay_s


def step(delay_s: float, until: float = 1e9) -> Delay:
    return lambda t: delay_s if BEGIN_S < t < until else 0.0


def ramp(slope: float, to: float = 1e9) -> Delay:
    """slope: s/s, up to so many seconds."""
    return lambda t: min(to, slope * max(0.0, t - BEGIN_S))


def burst(seconds: float) -> Delay:
    """Nothing arrives for so long, then all of it at once."""
    return lambda t: max(0.0, BEGIN_S + seconds - t) if t > BEGIN_S else 0.0


def fault(name: str, seconds: float = 5.0, **args: object) -> Happening:
    return lambda line: line.rig.fault(name, args, line.true_s, seconds)


def stopped(seconds: float) -> Happening:
    return lambda line: line.stop(seconds)


def suspended(seconds: float) -> Happening:
    return lambda line: line.suspend(seconds)


def again(first: int, last: int) -> Happening:
    """Scans captured before are sent to the host once more."""

    def inject(line: DelayedLine) -> None:
        for data in line.captured[first:last]:
            line.inject(data)

    return inject


DELAYS = [
    TimingCase("no delay", 8.0),
    TimingCase("0.4 s from the start", 10.0, constant(0.4), well=False),
    TimingCase("0.9 s from the start", 10.0, constant(0.9), well=False),
    TimingCase("0.4 s from now on", 10.0, step(0.4), well=False),
    TimingCase("0.9 s from now on", 10.0, step(0.9), well=False),
    TimingCase("0.9 s for a while", 12.0, step(0.9, until=8.0)),
    TimingCase("0.9 s towards the board", 12.0, to_board=step(0.9)),
    TimingCase("growing by 0.5 ms/s", 180.0, ramp(0.5e-3), well=False, quick=False),
    TimingCase("growing by 3 ms/s", 60.0, ramp(3e-3), well=False),
    TimingCase("growing by 20 ms/s to 2 s", 110.0, ramp(20e-3, 2.0), well=False, quick=False),
    TimingCase("growing by 20 ms/s", 30.0, ramp(20e-3), well=False),
    TimingCase("nothing for 0.8 s, then all at once", 10.0, burst(0.8)),
    TimingCase("nothing for 3 s, then all at once", 12.0, burst(3.0)),
]
CLOCKS = [
    TimingCase(f"{how} by {abs(by):g} s", 12.0, at=[(7.0, fault("clock_jump", by=by))])
    for by in (-5.0, -0.2, -0.03, 0.03, 0.2, 5.0)
    for how in ["back" if by < 0 else "on"]
]
AGAIN = [
    TimingCase("the same scan for 3 s", 10.0, at=[(BEGIN_S, fault("frozen", 3.0))]),
    TimingCase("scans of this session", 9.0, at=[(5.0, again(20, 60))]),
    TimingCase("scans from before a restart, at once", 11.0, at=[(5.0, fault("power_cycle")), (5.3, again(20, 60))]),
    TimingCase("scans from before a restart, later", 13.0, at=[(5.0, fault("power_cycle")), (8.0, again(0, 200))]),
    TimingCase("scans from long before a restart", 20.0, at=[(9.0, fault("power_cycle")), (11.0, again(150, 190))]),
]
STANDS_STILL = [
    *(TimingCase(f"stopped for {s:g} s", 12.0, at=[(BEGIN_S, stopped(s))]) for s in (0.3, 2.0, 5.0)),
    *(TimingCase(f"suspended for {s:g} s", 10.0 + s, at=[(BEGIN_S, suspended(s))]) for s in (0.5, 20.0)),
]
UNTIMED = [  # what a board that does not tell its time is seen by all the same
    TimingCase("0.9 s from now on", 10.0, step(0.9), answers_time=False, well=False),
    TimingCase("growing by 5 ms/s", 90.0, ramp(5e-3), answers_time=False, well=False),
    TimingCase("growing by 20 ms/s", 30.0, ramp(20e-3), answers_time=False, well=False),
    TimingCase("clock back by 5 s", 12.0, at=[(7.0, fault("clock_jump", by=-5.0))], answers_time=False),
    TimingCase("clock on by 5 s", 12.0, at=[(7.0, fault("clock_jump", by=5.0))], answers_time=False),
]


def played(cases: list[TimingCase]) -> Callable[[Setting], Iterator[Row]]:
    """A part: these cases."""

    def part(setting: Setting) -> Iterator[Row]:
        for case in cases:
            if case.quick or not setting.quick:
                yield judged(case, setting.seed, setting.scan)

    return part


def judged(case: TimingCase, seed: int, scan: ScanMode = "full") -> Row:
    log = logging.getLogger("services.board")
    level, log.level = log.level, logging.CRITICAL  # what acquisition says of the board is no news here
    try:
        seen, source = listen(case.line(seed, scan), case.seconds)
    finally:
        log.level = level
    usable = [s for s in seen if s.usable]
    broken = Counter[str]()
    broken["a frame to act on is older than it may be"] = sum(_too_old(s) for s in usable)
    last = [s for s in seen if s.at_s > case.seconds - WELL_S]
    good = sum(s.usable for s in last)
    broken["not well again"] = int(case.well and (not last or good < WELL_SHARE * len(last)))
    broken["never well before"] = int(not any(s.usable for s in seen) and "from the start" not in case.name)
    return {
        "case": case.name,
        "frames": len(seen),
        "valid_%": 100 * len(usable) / len(seen) if seen else None,
        "oldest_ms": 1e3 * max((s.true_age_s for s in usable), default=0.0),
        "stamp_off_ms": 1e3 * max((abs(s.stated_age_s - s.true_age_s) for s in usable), default=0.0),
        "refused": source.counts["foreign"] + source.counts["repeated"],
        "broken": {how: n for how, n in broken.items() if n},
    }


def _too_old(seen: ReceivedFrame) -> bool:
    return seen.true_age_s > seen.frame.valid_for_s + SLACK_S


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "time: bytes held up": played(DELAYS),
    "time: the board's clock jumps": played(CLOCKS),
    "time: scans sent again": played(AGAIN),
    "time: this end stands still": played(STANDS_STILL),
    "time: a board that does not tell its time": played(UNTIMED),
}
