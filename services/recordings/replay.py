"""Replay: a recording's raw frames, one at a time, through the same sockets as a board's.

Stands in for acquisition: binds its socket and sends the next frame only when the contacts of the one before have come
out, so that nothing is lost or batched and the same recording gives the same contacts each time. The `sample` stamps
are used as recorded.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from protocol.errors import EitskinError
from protocol.frames import ContactFrame, FrameError, RawFrame, StatusFrame, as_sent, read_map, unpack
from protocol.pause import pause
from protocol.sockets import AllReader, ControlClient, ControlError, Publisher
from services.recordings.recording import STATE_TOPIC, RecordedMessage, RecordingError, RecordingReader, RecordingWriter
from services.runtime.config import MOST_SKINS, SKIN_NAME
from services.runtime.stage import STAGES, add_reason

CHAIN_S = 20.0  # for the stages to start and find each other
ANSWER_S = 5.0  # for the contacts of one frame
PART_EVERY_S = 0.002  # a part of a scan that is not answered is asked after
PRIME_EVERY_S = 0.25
LONGEST_PAUSE_S = 10.0  # between two recorded frames: a file's times are its maker's, and nobody is to wait for years


class ReplayError(EitskinError):
    """The replay cannot begin or go on; the text says why and what to do."""


@dataclass
class Step:
    """What is to be done next: load states, or send a frame."""

    at_ns: int
    skin: str
    raw: RawFrame | None = None
    states: dict[str, Any] = field(default_factory=dict)


def steps(reader: RecordingReader, start_s: float = 0.0, only: str = "") -> Iterator[Step]:
    """The raw frames from `start_s` on, in order, and the states that belong before them.

    The first state of a skin goes before its first frame: the recorder asked for it on seeing that frame. Malformed
    messages are left out. Raises ReplayError where nothing lies behind `start_s`.
    """
    last_ns: int | None = None
    any_raw = False
    latest = _first_states(reader)
    held = set(latest)
    for last_ns, step in _timed_steps(reader, only):
        if step.raw is None and step.skin in held:
            held.remove(step.skin)  # that one is in `latest` already
        elif not start_s or last_ns >= start_s * 1e9:
            if step.skin in latest:
                yield latest.pop(step.skin)
            any_raw = any_raw or step.raw is not None
            yield step
        elif step.raw is None:
            latest[step.skin] = step
    if start_s > 0 and not any_raw and last_ns is not None:
        raise ReplayError(
            f"found --from {start_s:g}, but {reader.path} is only {last_ns * 1e-9:.1f} s long: begin before its end"
        )


def _timed_steps(reader: RecordingReader, only: str) -> Iterator[tuple[int, Step]]:
    """The steps of one skin ("": of all), each with its time from the first message on [ns]."""
    first_ns: int | None = None
    for message in reader.messages({"raw", STATE_TOPIC}):
        first_ns = message.log_time_ns if first_ns is None else first_ns
        step = _step(message)
        if step is not None and only in ("", step.skin):
            yield message.log_time_ns - first_ns, step


def _first_states(reader: RecordingReader) -> dict[str, Step]:
    found: dict[str, Step] = {}
    for message in RecordingReader(reader.path).messages({STATE_TOPIC}):
        step = _step(message)
        if step is not None:
            found.setdefault(step.skin, step)
    return found


def _step(message: RecordedMessage) -> Step | None:
    topic, _, skin = message.topic.partition("/")
    try:
        if topic == STATE_TOPIC:
            return Step(message.log_time_ns, skin, states=read_map(message.data, STATE_TOPIC))
        frame = unpack(message.wire)
    except FrameError:
        return None
    return Step(message.log_time_ns, skin, raw=frame) if isinstance(frame, RawFrame) else None


def mark(raw: RawFrame) -> None:
    """Mark a recorded frame as replayed, and read now."""
    raw.source, raw.host = "replay", ""
    raw.stamps = {"sample": raw.stamps.get("sample", 0), "read": time.monotonic_ns()}
    raw.valid, raw.reasons = as_sent(raw)  # whoever reads it will remark on failed measurements again
    add_reason(raw.reasons, "replay")


class Replayer:
    """Feeds stages that run already. `speed` None: as fast as they can."""

    def __init__(self, skins: list[str], speed: float | None, out: RecordingWriter | None = None) -> None:
        self.skins, self.speed, self.out = skins, speed, out
        self.publisher = Publisher("acquisition")
        self.contacts = AllReader(["contact"])
        self.counts: Counter[str] = Counter()
        self.warnings: list[str] = []
        self._started: set[str] = set()
        self._before_ns: int | None = None
        self._due = 0.0
        self._status_due = 0.0

    def run(self, source: Iterator[Step]) -> Iterator[ContactFrame]:
        """The contact frames, one for each scan. Raises ReplayError where one does not come."""
        for step in source:
            if step.skin not in self.skins:
                continue
            if step.skin not in self._started:
                self._started.add(step.skin)
                self._prime(step.skin)
                if step.raw is not None:
                    self._begin(step.skin, {})
                    yield from self._send(step, step.raw)
                else:
                    self._begin(step.skin, step.states)
            elif step.raw is None:
                self._load(step.skin, {name: s for name, s in step.states.items() if name == "preprocessing"})
            else:
                self._pace(step.at_ns)
                yield from self._send(step, step.raw)

    def _pace(self, at_ns: int) -> None:
        if self.speed is None:
            return
        if self._before_ns is None:
            self._before_ns, self._due = at_ns, time.monotonic()
        apart_s = (at_ns - self._before_ns) * 1e-9
        self._before_ns = at_ns
        self._due += min(max(0.0, apart_s), LONGEST_PAUSE_S) / self.speed
        while (left := self._due - time.monotonic()) > 0:
            pause(min(left, 0.2))
            self._report()

    def _send(self, step: Step, raw: RawFrame) -> Iterator[ContactFrame]:
        """Yields the answer; none to a part of a scan that preprocessing only takes note of."""
        mark(raw)
        self.publisher.send(raw)
        self.counts["frames"] += 1
        contact = self._answer(step.skin, raw, step.at_ns)
        self._report()
        if contact is not None:
            yield contact

    def _answer(self, skin: str, raw: RawFrame, at_ns: int) -> ContactFrame | None:
        """Returns the contacts made of a raw frame, which was recorded at `at_ns`; None where it is known that there
        will be none.
        """
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end:
            wait_s = ANSWER_S if raw.parts == 1 else PART_EVERY_S
            if (contact := self._contact(skin, raw.scan, wait_s, at_ns)) is not None:
                return contact
            told = {} if raw.parts == 1 else self._call("preprocessing", "part", skin=skin, scan=raw.scan)
            if told.get("seen") and not told.get("handed_on"):
                return None
        raise ReplayError(
            f"no contacts of scan {raw.scan} came within {ANSWER_S:g} s: is a stage down? `skin top` shows which"
        )

    def _contact(self, skin: str, scan: int, timeout_s: float, at_ns: int = 0) -> ContactFrame | None:
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0:
            got = self.contacts.recv_message(left)
            if got is None:
                return None
            frame, message = got
            if isinstance(frame, ContactFrame) and frame.skin == skin and frame.scan == scan:
                if self.out is not None and skin in self._started:
                    self.out.write(f"contact/{skin}", message.partition(b"\0")[2], at_ns)
                self.counts["contacts"] += 1
                self.counts["valid"] += frame.valid
                self.counts["touched"] += any(c.state != "end" for c in frame.contacts)
                return frame
        return None

    # getting ready

    def _prime(self, skin: str) -> None:
        """Sends frames that change nothing until contacts come out: then every socket of the chain is connected."""
        out, self.out = self.out, None
        counts = self.counts.copy()
        end = time.monotonic() + CHAIN_S
        try:
            while time.monotonic() < end:
                self.publisher.send(_primer(skin))
                if self._contact(skin, 0, PRIME_EVERY_S) is not None:
                    break
            else:
                raise ReplayError(
                    f"no contacts of skin {skin!r} came within {CHAIN_S:g} s: is it in the stages' configuration?"
                )
            while self.contacts.recv(PRIME_EVERY_S) is not None:  # answers to primers that were under way
                pass
        finally:
            self.out = out
            self.counts = counts

    def _begin(self, skin: str, states: dict[str, Any]) -> None:
        """Every stage forgets what it knew and starts a new session, so that a replay's frames count from 0."""
        for process in STAGES:
            self._call(process, "reset", skin=skin, new_session=True)
        self._load(skin, states)

    def _load(self, skin: str, states: dict[str, Any]) -> None:
        for process, state in states.items():
            if process in STAGES:
                self._call(process, "load", skin=skin, state=state)

    def _connect_anew(self) -> None:
        """The socket was opened anew: wait for the stages, lest a frame be lost, and have them go on as they were."""
        for skin in sorted(self._started):
            states = {process: self._call(process, "state", skin=skin).get("state", {}) for process in STAGES}
            self._prime(skin)
            self._load(skin, states)

    def _call(self, process: str, command: str, **args: Any) -> dict[str, Any]:
        """The answer; empty where the process would not."""
        try:
            return ControlClient(process, 5.0).call(command, **args)
        except ControlError as error:
            if error.kind in ("unreachable", "timeout"):
                raise ReplayError(str(error)) from None
            self.warnings.append(f"{process} could not {command} the recorded state: {error}")
        except (ValueError, OverflowError) as error:  # nested deeper than msgpack packs
            self.warnings.append(f"the recorded state of {process} cannot be sent: {error}")
        return {}

    def _report(self) -> None:
        """A status a second, as every process gives, and a look at the socket."""
        if (now := time.monotonic()) < self._status_due:
            return
        self._status_due = now + 1.0
        if self.publisher.mind():
            self._connect_anew()
        problems, counts = self.publisher.problems, dict(self.counts)
        level = "WARN" if problems else "OK"
        for skin in self.skins:
            self.publisher.send(
                StatusFrame(
                    skin=skin,
                    process="replay",
                    level=level,
                    messages=problems,
                    source="replay",
                    valid=True,
                    valid_for_s=3.0,
                    stamps={"publish": time.monotonic_ns()},
                    counters=counts,
                )
            )

    def close(self) -> None:
        self.publisher.close()
        self.contacts.close()


def _primer(skin: str) -> RawFrame:
    """A frame that no stage takes for a measurement: one value, of a kind that is no more, invalid."""
    import numpy as np

    return RawFrame(
        skin=skin,
        z=np.ones(1, np.complex64),
        status=np.zeros(1, np.uint8),
        kind="sentinel",
        source="replay",
        reasons=["replay"],
        stamps={"sample": 0, "read": time.monotonic_ns()},
    )


def skins_in(reader: RecordingReader) -> dict[str, int]:
    """The skins whose raw frames a recording holds, and how many. The reader's `damage` is complete then.

    Raises RecordingError where they are more than any service has.
    """
    found: Counter[str] = Counter()
    for message in reader.messages({"raw"}):
        skin = message.topic.partition("/")[2]
        if SKIN_NAME.fullmatch(skin):
            found[skin] += 1
        if len(found) > MOST_SKINS:
            raise RecordingError(f"{reader.path} holds more than {MOST_SKINS} skins: no recording does")
    return dict(found)
