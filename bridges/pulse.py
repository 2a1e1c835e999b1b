"""How a bridge does with one skin: what it handed on, how late, and the status frames that say so."""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import Any

from protocol.frames import StatusFrame

EVERY_S = 1.0
KEPT = 256  # frames over which p50 and p99 are taken
FLOWING_S = 0.5  # without a frame for so long, nothing flows


class Pulse:
    """`level`, `messages` and `idle` are the bridge's to set; `sent`, `drops` and `handed_on` its to count with."""

    def __init__(self, process: str, skin: str) -> None:
        self.process, self.skin = process, skin
        self.level, self.messages, self.idle = "STALE", ["no frame yet"], True
        self.sent: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self._latency: deque[float] = deque(maxlen=KEPT)
        self._work: deque[float] = deque(maxlen=KEPT)
        self._heard = time.monotonic()
        self._last: StatusFrame | None = None
        self._next = 0.0
        self._measured_at, self._measured_sent, self._rates = time.monotonic(), self.sent.copy(), dict[str, float]()
        self._cpu_at, self._cpu = time.process_time(), 0.0

    def heard(self) -> None:
        """A frame came, whatever it says."""
        self._heard = time.monotonic()

    def handed_on(self, measured_ns: int | None, taken_ns: int) -> None:
        """A frame was measured, taken at `taken_ns`, and is handed on now."""
        now = time.monotonic_ns()
        self._work.append((now - taken_ns) * 1e-6)
        if measured_ns is not None:
            self._latency.append((now - measured_ns) * 1e-6)

    @property
    def rates(self) -> dict[str, float]:
        """Messages a second, by topic of the other side."""
        return self._rates

    def status(self, problems: list[str]) -> StatusFrame | None:
        """The status frame that is due: once a second, and at once when the level or the messages changed."""
        now = time.monotonic()
        level = "WARN" if problems and self.level == "OK" else self.level
        messages = [*self.messages, *problems]
        last = self._last
        if last is not None and (level, messages) == (last.level, last.messages) and now < self._next:
            return None
        self._measure(now)
        self._next = now + EVERY_S
        self._last = StatusFrame(
            skin=self.skin,
            process=self.process,
            valid=True,
            valid_for_s=3 * EVERY_S,
            level=level,
            messages=messages,
            rates=dict(self._rates),
            drops=dict(self.drops),
            latency=self._quantiles(),
            cpu=self._cpu,
            stamps={"publish": time.monotonic_ns()},
        )
        return self._last

    def summary(self) -> dict[str, Any]:
        """For the control command `status`."""
        quiet_s = time.monotonic() - self._heard
        return {
            "flowing": self.idle or quiet_s < FLOWING_S,
            "idle": self.idle,
            "quiet_s": quiet_s,
            "level": self.level,
            "messages": list(self.messages),
            "rates": dict(self._rates),
            "sent": dict(self.sent),
            "drops": dict(self.drops),
            "latency": self._quantiles(),
        }

    def _measure(self, now: float) -> None:
        seconds = now - self._measured_at
        if seconds < 0.5:
            return
        self._rates = {topic: (n - self._measured_sent[topic]) / seconds for topic, n in self.sent.items()}
        cpu = time.process_time()
        self._cpu = max(0.0, cpu - self._cpu_at) / seconds
        self._measured_at, self._measured_sent, self._cpu_at = now, self.sent.copy(), cpu

    def _quantiles(self) -> dict[str, float]:
        found = {}
        for name, values in (("", self._latency), ("work_", self._work)):
            if values:
                ordered = sorted(values)
                found[name + "p50"] = ordered[len(ordered) // 2]
                found[name + "p99"] = ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]
        return found
