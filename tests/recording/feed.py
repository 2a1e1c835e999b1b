"""A recorder that is fed in simulated time: no socket, thread, process or clock."""

import time
from collections import deque
from typing import Any

import msgpack

from protocol.frames import Contact, ContactFrame, Frame, pack, unpack
from services import recorder as service
from services.recordings import patient_file, recorder, recording, rotation, snapshots
from services.recordings.recording import RecordingReader
from tests.protocol import line
from tests.protocol.line import S


class Clock(line.Clock):
    strftime = staticmethod(time.strftime)

    def time_ns(self):
        return 17 * 10**17 + int(self.ns)

    def gmtime(self):
        return time.gmtime(self.time_ns() / S)


class Feed:
    """What AllReader and StateReader are to a recorder: frames that have come, and the stages' answers."""

    def __init__(self, clock):
        self.clock, self.skin, self.gaps, self.answered = clock, "palm", 0, 0
        self.coming: deque[tuple[Frame, bytes]] = deque()
        self.asked: list[tuple[str, str]] = []

    def send(self, *frames):
        self.coming.extend((frame, pack(frame)) for frame in frames)
        return [message for _, message in self.coming]

    def recv_message(self, timeout_s):
        if self.coming:
            return self.coming.popleft()
        self.clock.go(timeout_s)
        return None

    def ask(self, skin, purpose):
        self.asked.append((skin, purpose))

    def answers(self):
        new, self.answered = self.asked[self.answered :], len(self.asked)
        return [(*asked, msgpack.packb({"preprocessing": {"time": len(self.asked)}})) for asked in new]

    def close(self): ...


def set_clock(monkeypatch):
    clock = Clock()
    for module in (service, recorder, recording, rotation, patient_file, snapshots):
        monkeypatch.setattr(module, "time", clock)
    return clock


def fed(recorder_, clock):
    recorder_.reader.close()
    recorder_.states.close()
    feed: Any = Feed(clock)
    recorder_.reader = recorder_.states = feed
    return feed  # type: ignore[no-any-return]


def command(of, name, **args):
    return of.control.handlers[name](args)


def touched(*ids, **fields):
    contacts = [Contact(id=k, position=[0.0, 0.0, 0.0]) for k in ids]
    return ContactFrame(**{"skin": "palm", "contacts": contacts, "valid": True, **fields})


def contacts_in(path):
    found = [unpack(message.wire) for message in RecordingReader(path).messages({"contact"})]
    return [frame for frame in found if isinstance(frame, ContactFrame)]
