"""What `skin top` shows: rates, ages and latencies counted from the frames themselves, health from status frames."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from protocol.frames import ContactFrame, Frame, ImageFrame, InfoFrame, StatusFrame
from protocol.held import HeldImage
from protocol.runtime import host_id
from protocol.sockets import AllReader
from protocol.topics import TOPIC_OF, TOPICS

WINDOW_S = 5.0
SKIPS = ("untouched", "held", "unwanted")  # counters of frames that inference had no image to make for
SILENT_S = 3.5
"""A process that says so little for so long is shown as silent: it promises a status each second."""


def percentile(values: list[float], share: float) -> float | None:
    """The value that this share of the values does not exceed; None without values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


@dataclass
class TopicRow:
    """One topic as seen here."""

    # when [s], age of the sample [ms], time since acquisition read it [ms]
    arrivals: deque[tuple[float, float | None, float | None]] = field(default_factory=deque)
    last: Frame | None = None
    last_s: float = 0.0

    def add(self, frame: Frame, now_s: float) -> None:
        ours = frame.host == host_id() and frame.source != "replay"
        stamps = (frame.stamps.get(key) if ours else None for key in ("sample", "read"))
        age, read = (None if stamp is None else now_s * 1e3 - stamp / 1e6 for stamp in stamps)
        self.arrivals.append((now_s, age, read))
        self.last, self.last_s = frame, now_s
        self.trim(now_s)

    def trim(self, now_s: float) -> None:
        while self.arrivals and self.arrivals[0][0] < now_s - WINDOW_S:
            self.arrivals.popleft()

    def summary(self, now_s: float, since_s: float) -> dict[str, Any]:
        self.trim(now_s)
        ages = [age for _, age, _ in self.arrivals if age is not None]
        since_read = [read for _, _, read in self.arrivals if read is not None]
        seconds = max(min(WINDOW_S, now_s - since_s), 1e-3)
        return {
            "rate_hz": round(len(self.arrivals) / seconds, 2),
            "age_ms": round((now_s - self.last_s) * 1e3, 1) if self.last else None,
            "latency_ms": _quantiles(ages),
            "since_read_ms": _quantiles(since_read),
            "valid": self.last.valid if self.last else None,
            "reasons": list(self.last.reasons) if self.last else [],
        }


class Monitor:
    """Subscribes to one skin's topics and keeps the last seconds of them. Lazy topics are left asleep."""

    def __init__(self, skin: str) -> None:
        self.skin = skin
        self.started_s = time.monotonic()
        names = [t.name for t in TOPICS.values() if not t.lazy]
        self.reader = AllReader(names, skin)
        self.topics = {name: TopicRow() for name in names if name not in ("status", "info")}
        self.processes: dict[str, tuple[StatusFrame, float]] = {}
        self._before: dict[str, StatusFrame] = {}  # the status before the last, of each
        self.info: dict[str, Any] = {}
        self.image: ImageFrame | None = None
        """The newest frame with an image, its own or the one it holds; None while nothing touches."""
        self.image_held = False
        self._held = HeldImage()

    def read(self, seconds: float) -> None:
        """Read what arrives within `seconds`."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            frame = self.reader.recv(left)
            if frame is not None:
                self.take(frame, time.monotonic())

    def take(self, frame: Frame, now_s: float) -> None:
        if isinstance(frame, StatusFrame):
            if frame.process in self.processes:
                self._before[frame.process] = self.processes[frame.process][0]
            self.processes[frame.process] = (frame, now_s)
        elif isinstance(frame, InfoFrame):
            self.info.update(frame.info)
        else:
            if isinstance(frame, ImageFrame):
                self._held.complete(frame)
                self.image = frame if frame.image.size else None
                self.image_held = frame.held
            self.topics[TOPIC_OF[type(frame)].name].add(frame, now_s)

    @property
    def received(self) -> bool:
        return bool(self.processes) or any(row.last for row in self.topics.values())

    @property
    def contact(self) -> ContactFrame | None:
        last = self.topics["contact"].last
        return last if isinstance(last, ContactFrame) else None

    def snapshot(self) -> dict[str, Any]:
        """Everything `skin top` shows, as plain values."""
        now = time.monotonic()
        contact = self.contact
        return {
            "skin": self.skin,
            "topics": {
                name: row.summary(now, self.started_s)
                | {"producer": "/".join(TOPICS[name].producers)}
                | {"lost": self.reader.lost[f"{name}/{self.skin}"]}
                for name, row in self.topics.items()
                if row.last
            },
            "processes": {
                name: _process(status, self._before.get(name), now - seen)
                for name, (status, seen) in sorted(self.processes.items())
            },
            "valid": bool(contact and contact.valid),
            "reasons": list(contact.reasons) if contact else [],
            "contacts": [
                {"id": c.id, "state": c.state, "position": list(c.position), "force_n": c.force_n, "shape": c.shape}
                for c in (contact.contacts if contact else [])
            ],
            "malformed": self.reader.malformed,
        }


def _process(status: StatusFrame, before: StatusFrame | None, silent_s: float) -> dict[str, Any]:
    silent = silent_s > SILENT_S
    return {
        "level": "STALE" if silent else status.level,
        "messages": [f"silent for {silent_s:.0f} s"] if silent else list(status.messages),
        "cpu": round(status.cpu, 4),
        "skipped": _skipped(status, before),
        "latency_ms": dict(status.latency),
        "rates_hz": dict(status.rates),
        "drops": dict(status.drops),
        "counters": dict(status.counters),
    }


def _skipped(status: StatusFrame, before: StatusFrame | None) -> dict[str, float]:
    """For each skip rule, the share of frames since the last status for which it saved work."""
    new = {k: n - (before.counters.get(k, 0) if before else 0) for k, n in status.counters.items()}
    counted = [new.get(k, 0) for k in ("networks_run", *SKIPS)]
    if min(counted) < 0 or not sum(counted):  # it began anew, or nothing came
        return {}
    return {k: round(new.get(k, 0) / sum(counted), 3) for k in SKIPS if new.get(k, 0)}


def _quantiles(values: list[float]) -> dict[str, float | None]:
    return {"p50": _round(percentile(values, 0.5)), "p99": _round(percentile(values, 0.99))}


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 2)
