"""A subscription in simulated time: what the clients read and when, without socket, thread or clock."""

import asyncio
import time

from protocol import aio, freshness
from protocol.aio import AsyncContactSubscriber
from protocol.frames import ContactFrame

S = 10**9
AHEAD_NS = 7_000 * S  # of another host's clock


class Clock:
    """Stands for the module `time`: it moves only where somebody waits."""

    CLOCK_MONOTONIC, CLOCK_BOOTTIME = time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME

    def __init__(self):
        self.ns = 1000 * S
        self.slept_ns = 5 * S  # until now, while the host was suspended

    def monotonic_ns(self):
        return self.ns

    def monotonic(self):
        return self.ns / S

    def clock_gettime_ns(self, _):
        return self.ns + self.slept_ns

    def go(self, seconds):
        self.ns += round(seconds * S)


class Line:
    """What NewestReader is to a client: it holds the newest message that has arrived."""

    def __init__(self, clock):
        self.clock, self.socket = clock, self
        self.malformed, self.last_error = 0, None
        self.session, self.sent, self.closed = "a" * 16, 0, False
        self.held_up_s = 0.0  # how long the process stands still in its next wait
        self._coming = []

    def send(self, after_s=0.0, age_s=0.0, **fields):
        """A valid frame that comes after so long, read and published just then and measured `age_s` before."""
        at = self.clock.ns + round(after_s * S)
        now = at + (AHEAD_NS if fields.get("host") else 0)
        stamps = {"sample": now - round(age_s * S), "read": now, "publish": now}
        fields = {"valid": True, "valid_for_s": 5.0, "stamps": stamps, "session": self.session, **fields}
        self._coming.append((at, ContactFrame(skin="palm", seq=self.sent, **fields)))
        self.sent += 1

    def recv(self, timeout_s):
        assert timeout_s == 0.0
        arrived = [frame for at, frame in self._coming if at <= self.clock.ns]
        self._coming = [(at, frame) for at, frame in self._coming if at > self.clock.ns]
        return arrived[-1] if arrived else None

    def poll(self, milliseconds):
        self.clock.go(self.held_up_s)
        self.held_up_s = 0.0
        end = self.clock.ns + milliseconds * 1_000_000
        first = min((at for at, _ in self._coming), default=end + 1)
        self.clock.ns = max(self.clock.ns, min(first, end))
        return first <= end

    def close(self, *_):
        self.closed = True


class InALoop:
    """The client for asyncio, called like the one that blocks."""

    def __init__(self, *args, **options):
        self.loop, self.client = asyncio.new_event_loop(), AsyncContactSubscriber(*args, **options)
        self.run = self.loop.run_until_complete

    replayed = property(lambda self: self.client.replayed)

    def latest(self, *args, **options):
        return self.run(self.client.latest(*args, **options))

    def next_frame(self, *args, **options):
        return self.run(self.client.next_frame(*args, **options))

    def __iter__(self):
        frames = aiter(self.client)
        while True:
            yield self.run(anext(frames))

    def close(self):
        self.client.close()
        self.run(self.loop.shutdown_asyncgens())
        self.loop.close()


class _Awaited:
    def __init__(self, line):
        self.line = line

    async def poll(self, milliseconds):
        return self.line.poll(milliseconds)

    def close(self, *_): ...


def simulated(monkeypatch, *modules):
    """A line that the clients made from now on read; `modules` go by its clock."""
    line = Line(Clock())
    for module in modules:
        monkeypatch.setattr(module, "time", line.clock)
    monkeypatch.setattr(freshness, "NewestReader", lambda *read: {("contact", "palm", None): line}[read])
    monkeypatch.setattr(aio.zmq.asyncio.Socket, "from_socket", staticmethod(_Awaited))
    return line
