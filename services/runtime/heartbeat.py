"""How a process does with one skin: counts, rates, latencies, and the status frames that say so."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any

from protocol.frames import Frame, StatusFrame
from protocol.metering import StatusBeat
from protocol.runtime import host_id
from services.runtime.stage import Health

LEVELS = ("OK", "WARN", "ERROR", "STALE")
LATE_S = 2.0  # how long a late frame is spoken of
FAILURE_S = 5.0  # how long a frame that could not be processed is spoken of


class Heartbeat:
    def __init__(self, process: str, skin: str) -> None:
        self.process, self.skin = process, skin
        self._beat = StatusBeat(process, skin)
        self._meter = self._beat.meter
        self.sent = self._meter.sent
        self.drops: Counter[str] = Counter({"late": 0, "failed": 0})
        self.late = 0  # frames that were sent too old to be acted on
        self.failures = self.unlogged = 0  # exceptions in the stage, and those of them that the log does not have
        self._late_at, self._late_by_s = -math.inf, 0.0
        self._failure, self._failed_at = "", 0.0
        self._since = self._received_s = time.monotonic()
        self._received_any = False

    @property
    def failure(self) -> str:
        return self._failure if time.monotonic() - self._failed_at < FAILURE_S else ""

    @failure.setter
    def failure(self, text: str) -> None:
        self._failure, self._failed_at = text, time.monotonic()

    def received(self, frame: Frame, now_ns: int) -> None:
        """A frame came."""
        self._received_s, self._received_any = now_ns * 1e-9, True

    def done(self, frame: Frame, began_ns: int, now_ns: int, late: bool = False) -> None:
        """A frame was processed and its successors were sent; `late`: too old to be acted on."""
        since = frame.stamps.get("sample")
        ours = since is not None and frame.source != "replay" and frame.host in ("", host_id())
        ago_ns = now_ns - since if since is not None and ours else None
        self._meter.handled(ago_ns, now_ns - began_ns)
        if late and ago_ns is not None:
            self.late += 1
            self._late_at, self._late_by_s = now_ns * 1e-9, ago_ns * 1e-9

    def silence(self, limit_s: float, upstream: str) -> str:
        """The text for an input that gives nothing; "" while it gives frames."""
        quiet = time.monotonic() - self._received_s
        if quiet < limit_s:
            return ""
        what = f"{upstream}/{self.skin}" if upstream else "frames from the source"
        return f"no {what} for {int(quiet)} s" if self._received_any and quiet >= 1 else f"no {what}"

    def deadline(self, limit_s: float) -> float:
        """When the next status is due, or the silence since the last frame becomes one to speak of."""
        silent_at = self._received_s + limit_s
        last, due = self._beat.last, self._beat.next_s
        spoken_of = last is not None and last.stamps["publish"] * 1e-9 > silent_at
        return due if spoken_of else min(due, silent_at)

    def status(
        self, health: Health, silent: str, now: float, every_s: float, asleep: bool = False
    ) -> StatusFrame | None:
        """The status frame that is due: once every_s, and at once when level or messages changed; else None."""
        level, messages = health.level, list(health.messages)
        if self.failure:
            level, messages = "ERROR", [*messages, self.failure]
        if silent and level != "ERROR":
            level = "STALE"
        if silent:
            messages.append(silent)
        if now - self._late_at < LATE_S:
            level = "WARN" if level == "OK" else level
            messages.append(
                f"frames come {self._late_by_s:.1f} s after they were measured, too late to be acted on: "
                "what is slow is the line to the board, or a process before this one"
            )
        if asleep:
            messages.append("idle: nobody subscribes")
        counters = {**health.counters, "late": self.late, "failures": self.failures, "unlogged": self.unlogged}
        return self._beat.frame(level, messages, now, every_s, self.drops, counters)

    def summary(self, asleep: bool, silent_s: float) -> dict[str, Any]:
        """For the control command `status`."""
        quiet = time.monotonic() - self._received_s
        last = self._beat.last
        return {
            "flowing": asleep or (self._received_any and quiet < silent_s),
            "idle": asleep,
            "quiet_s": quiet,
            "level": last.level if last else "STALE",
            "messages": list(last.messages) if last else [],
            "rates": dict(self._meter.rates),
            "drops": dict(self.drops),
            "failures": self.failures,
            "unlogged": self.unlogged,
            "latency": self._meter.quantiles(),
        }
