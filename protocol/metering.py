"""How much a process does with one skin, and how fast: what its status frames say of it, and when one is due."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence

from .frame_types import StatusFrame

KEPT = 256  # frames over which p50 and p99 are taken
LEAST_S = 0.5  # a rate is a mean over at least so long


class Meter:
    """`sent` is the caller's to count with; `rates` [Hz, by topic] and `cpu` [share of a core] as last measured."""

    def __init__(self) -> None:
        self.sent: Counter[str] = Counter()
        self.rates: dict[str, float] = {}
        self.cpu = 0.0
        self._latency: deque[float] = deque(maxlen=KEPT)
        self._work: deque[float] = deque(maxlen=KEPT)
        self._at, self._sent_then, self._cpu_then = time.monotonic(), self.sent.copy(), time.process_time()

    def handled(self, since_sample_ns: int | None, work_ns: int) -> None:
        """One frame: how long ago it was measured, where that is known, and how long it was worked on."""
        if since_sample_ns is not None:
            self._latency.append(since_sample_ns * 1e-6)
        self._work.append(work_ns * 1e-6)

    def measure(self, now: float) -> None:
        """Rates and CPU since the last time, unless that was just before."""
        seconds = now - self._at
        if seconds < LEAST_S:
            return
        self.rates = {topic: (n - self._sent_then[topic]) / seconds for topic, n in self.sent.items()}
        cpu = time.process_time()
        self.cpu = max(0.0, cpu - self._cpu_then) / seconds
        self._at, self._sent_then, self._cpu_then = now, self.sent.copy(), cpu

    def quantiles(self) -> dict[str, float]:
        """p50 and p99 of the latency, work_p50 and work_p99 of the work [ms]; empty before the first frame."""
        found = {}
        for name, values in (("", self._latency), ("work_", self._work)):
            if values:
                ordered = sorted(values)
                found[name + "p50"] = ordered[len(ordered) // 2]
                found[name + "p99"] = ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]
        return found


class StatusBeat:
    """The status frames of one process about one skin: once in a while, and at once when something changed."""

    def __init__(self, process: str, skin: str) -> None:
        self.process, self.skin = process, skin
        self.meter = Meter()
        self.last: StatusFrame | None = None
        self.next_s = 0.0
        """When the next one is due whatever happens, by the monotonic clock."""

    def frame(
        self,
        level: str,
        messages: Sequence[str],
        now: float,
        every_s: float,
        drops: Mapping[str, int],
        counters: Mapping[str, int] | None = None,
    ) -> StatusFrame | None:
        """The status frame that is due: every_s after the last one, and when level or messages changed; else None."""
        last = self.last
        changed = last is None or level != last.level or _kinds(messages) != _kinds(last.messages)
        if not changed and now < self.next_s:
            return None
        self.meter.measure(now)
        self.next_s = now + every_s
        self.last = StatusFrame(
            skin=self.skin,
            process=self.process,
            valid=True,
            valid_for_s=3 * every_s,
            level=level,
            messages=list(messages),
            rates=dict(self.meter.rates),
            drops=dict(drops),
            counters=dict(counters or {}),
            latency=self.meter.quantiles(),
            cpu=self.meter.cpu,
            stamps={"publish": time.monotonic_ns()},
        )
        return self.last


def _kinds(messages: Sequence[str]) -> list[str]:
    """Messages without their numbers: a count that goes up is no change worth a frame of its own."""
    return ["".join(c for c in m if not c.isdigit()) for m in messages]
