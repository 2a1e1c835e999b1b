"""How a bridge does with one skin: what it handed on, how late, and the status frames that say so."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from protocol.frames import StatusFrame
from protocol.metering import StatusBeat

EVERY_S = 1.0
FLOWING_S = 0.5  # without a frame for so long, nothing flows


class Pulse:
    """`level`, `messages` and `idle` are the bridge's to set; `sent`, `drops` and `handed_on` its to count with."""

    def __init__(self, process: str, skin: str) -> None:
        self.process, self.skin = process, skin
        self.level, self.messages, self.idle = "STALE", ["no frame yet"], True
        self._beat = StatusBeat(process, skin)
        self._meter = self._beat.meter
        self.sent = self._meter.sent
        self.drops: Counter[str] = Counter()
        self._heard = time.monotonic()

    def heard(self) -> None:
        """A frame came, whatever it says."""
        self._heard = time.monotonic()

    def handed_on(self, measured_ns: int | None, taken_ns: int) -> None:
        """A frame was measured, taken at `taken_ns`, and is handed on now."""
        now = time.monotonic_ns()
        self._meter.handled(None if measured_ns is None else now - measured_ns, now - taken_ns)

    @property
    def rates(self) -> dict[str, float]:
        """Messages a second, by topic of the other side."""
        return self._meter.rates

    def status(self, problems: list[str]) -> StatusFrame | None:
        """The status frame that is due: once a second, and at once when the level or the messages changed."""
        level = "WARN" if problems and self.level == "OK" else self.level
        return self._beat.frame(level, [*self.messages, *problems], time.monotonic(), EVERY_S, self.drops)

    def summary(self) -> dict[str, Any]:
        """For the control command `status`."""
        quiet_s = time.monotonic() - self._heard
        return {
            "flowing": self.idle or quiet_s < FLOWING_S,
            "idle": self.idle,
            "quiet_s": quiet_s,
            "level": self.level,
            "messages": list(self.messages),
            "rates": dict(self._meter.rates),
            "sent": dict(self.sent),
            "drops": dict(self.drops),
            "latency": self._meter.quantiles(),
        }
