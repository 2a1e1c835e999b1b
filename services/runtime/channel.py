"""One skin in a process: its stage, where its frames come from, how it does."""

from __future__ import annotations

from typing import Any, Protocol

from protocol.frames import Frame
from protocol.topics import wire_topic
from services.runtime.heartbeat import Heartbeat
from services.runtime.said_once import SaidOnce
from services.runtime.stage import Stage


class Feed(Protocol):
    """Where a stage's frames come from."""

    @property
    def malformed(self) -> int: ...
    @property
    def skipped(self) -> int: ...
    @property
    def socket(self) -> Any: ...

    def recv(self) -> Frame | None: ...
    def close(self) -> None: ...


class Channel:
    """One skin in this process: its stage, where its frames come from, how it does."""

    def __init__(self, process: str, stage: Stage, feed: Feed) -> None:
        self.stage, self.feed = stage, feed
        self.heartbeat = Heartbeat(process, stage.skin)
        self.heads = {topic: wire_topic(topic, stage.skin) + b"\0" for topic in stage.writes}  # of its messages
        self.asleep = False
        self.wanted: frozenset[str] = frozenset()  # topics somebody subscribes to, as of the last tick
        self.failures = SaidOnce()
        self.unkept = ""  # why the stage's state could not be kept
