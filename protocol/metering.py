"""How much a process does with one skin, and how fast: what its status frames say of it."""

from __future__ import annotations

import time
from collections import Counter, deque

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
