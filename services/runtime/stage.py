"""What a stage is: frame in, frames out. No sockets, no clock, no threads; temporal state explicit, so that it can be
reset, saved and loaded. services/runner.py drives stages over sockets, services/pipeline.py in one process.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from protocol.errors import EitskinError
from protocol.frames import Frame

STAGES = ("preprocessing", "inference", "publisher")
"""The processes whose stages keep state, in the order of the chain. Acquisition, or a replay in its place, feeds them.
"""
PROCESSES = ("acquisition", *STAGES)


SEPARATE = "separate"
"""Reason that a source of scans which do not follow each other in time gives to each of them, and stages hand on."""


HARMLESS = {"replay", "uncalibrated_force"}
"""Reasons that make no frame invalid."""


class Refused(EitskinError):
    """A command that the stage will not carry out now. The text says why and what to do."""


@dataclass
class Health:
    """How a stage is: `level` OK, WARN or ERROR, and why."""

    level: str = "OK"
    messages: list[str] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)

    def with_problems(self, problems: Sequence[str]) -> Health:
        """The same, and these."""
        if not problems:
            return self
        level = "WARN" if self.level == "OK" else self.level
        return Health(level, [*self.messages, *problems], self.counters)


class Stage(ABC):
    """One step of the chain, for one skin."""

    reads: ClassVar[str]  # topic
    writes: ClassVar[tuple[str, ...]]  # topics; the first one gets exactly one frame for each frame read
    stamp: ClassVar[str]  # key in Frame.stamps that says when this stage was done
    commands: ClassVar[tuple[str, ...]] = ()  # what `command` understands
    sleeps: ClassVar[bool] = False  # unsubscribes while nobody subscribes to what it writes
    persists: ClassVar[bool] = False  # `saved` is kept in the runtime folder and loaded at start
    lacks = False  # this stage lacks something that upstream sends only once; subscribing anew has it sent again

    def __init__(self, skin: str) -> None:
        self.skin = skin

    @abstractmethod
    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        """The frames that follow from `frame`; `wanted`: topics somebody subscribes to. Never raises for what is in a
        frame.
        """

    def beside(self, wanted: frozenset[str]) -> list[Frame]:
        """What else follows from the frame processed last, and can wait until the frames of `process` have left."""
        return []

    def everything(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        """All that follows from `frame`, in the order in which it leaves."""
        return [*self.process(frame, wanted), *self.beside(wanted)]

    def reset(self) -> None:  # noqa: B027  (a stage without state)
        """Forget all temporal state."""

    def new_session(self) -> None:  # noqa: B027
        """Begin a new session: ids that are unique within a session may begin anew."""

    def state(self) -> dict[str, Any]:
        """Temporal state: numbers, texts, lists, arrays. `load(state())` in another process continues bit by bit."""
        return {}

    def load(self, state: dict[str, Any]) -> None:  # noqa: B027
        """Take over a state. Raises Refused where it does not fit."""

    def saved(self) -> dict[str, Any] | None:
        """State to keep across a crash, or None where nothing changed since the last call. Only if `persists`."""
        return None

    def restore(self, saved: dict[str, Any], age_s: float) -> None:  # noqa: B027
        """Take over what an earlier process saved `age_s` ago. Raises Refused where it does not fit."""

    def joined(self, topic: str) -> None:  # noqa: B027
        """Somebody has subscribed to `topic`, which this stage writes: send again what is sent only once."""

    def wake(self) -> None:  # noqa: B027
        """Frames come again after a pause in which nobody subscribed: new subscribers know nothing of earlier
        frames.
        """

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        """Carry out one of `commands`. Raises Refused."""
        raise Refused(f"no command {name!r}")

    def info(self) -> dict[str, Any] | None:
        """What info/<skin> says, or None where nothing changed since the last call."""
        return None

    def health(self) -> Health:
        return Health()

    @classmethod  # noqa: B027
    def together(cls, work: Sequence[tuple[Stage, Frame]]) -> None:
        """Called before the stages process frames of several skins that wait at once: do what is cheaper for all of
        them than for each. Changes nothing but how soon a result is there.
        """

    def prepare(self) -> bool:
        """Called after frames were sent, while none is waiting: do one bounded piece of work that later frames will
        need, and say whether there was one. Changes nothing but how soon a result is there.
        """
        return False

    def between_frames(self) -> None:  # noqa: B027
        """Called a few times a second: adopt what other processes have made meanwhile. Never waits."""

    def warm_up(self) -> None:  # noqa: B027
        """Do once what is slow the first time."""


VALID_S, VALID_SCANS = 0.25, 3


def valid_for_s(scan_s: float) -> float:
    """How long after it was measured a frame of a source with full scans of scan_s may be acted on."""
    return max(VALID_S, VALID_SCANS * scan_s)


def inherited(frame: Frame) -> dict[str, Any]:
    """Header fields that a frame hands on to what is made of it."""
    return {
        "skin": frame.skin,
        "host": frame.host,
        "scan": frame.scan,
        "part": frame.part,
        "stamps": dict(frame.stamps),
        "time_ns": frame.time_ns,
        "sample_sigma_ns": frame.sample_sigma_ns,
        "source": frame.source,
        "valid": frame.valid,
        "reasons": list(frame.reasons),
        "valid_for_s": frame.valid_for_s,
    }


def add_reason(reasons: list[str], reason: str) -> None:
    if reason not in reasons:
        reasons.append(reason)


def invalidate(frame: Frame, reason: str) -> None:
    """A frame that is not to be acted on, and why."""
    frame.valid = False
    add_reason(frame.reasons, reason)
