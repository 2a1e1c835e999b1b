"""Which of many sockets have something to read, at a cost that does not grow with those that have nothing.

zmq.Poller asks every socket each time it waits: with 32 skins that was a quarter of a process's CPU. Here the kernel
says which descriptors woke, and only their sockets are asked. A ZeroMQ socket's descriptor wakes when something about
it changes, not for as long as there is something to read (zmq_getsockopt, ZMQ_FD): so a socket that was ready is asked
again before the next wait, and all of them whenever `doubt` says so.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
from collections.abc import Callable

import zmq

from protocol.transport import Socket

Waitable = Socket | int
"""A ZeroMQ socket, or a descriptor that is readable for as long as there is something to read."""


class Waiter:
    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._by_descriptor: dict[int, Waitable] = {}
        self._doubtful: list[Socket] = []  # sockets to ask although their descriptor says nothing

    def register(self, what: Waitable) -> None:
        descriptor = what if isinstance(what, int) else int(what.get(zmq.FD))
        self._by_descriptor[descriptor] = what
        self._epoll.register(descriptor, select.EPOLLIN)
        self.doubt()

    def exchange(self, old: Socket, new: Socket) -> None:
        """Wait for `new` instead of `old`, which may be closed already."""
        for descriptor, what in list(self._by_descriptor.items()):
            if what is old:
                del self._by_descriptor[descriptor]
                with contextlib.suppress(OSError):  # closed: the kernel has forgotten it
                    self._epoll.unregister(descriptor)
        self.register(new)

    def doubt(self) -> None:
        """Ask every socket once. To be called now and then: another use of a socket than reading it (sending, a new
        subscription) takes its signals too.
        """
        self._doubtful = [what for what in self._by_descriptor.values() if not isinstance(what, int)]

    def wait(self, timeout_s: float) -> list[Waitable]:
        """What may have something to read, waiting up to timeout_s until there is any: reading it tells. What is not
        read empty comes again the next time.
        """
        ready: list[Waitable] = [socket for socket in self._doubtful if int(socket.get(zmq.EVENTS)) & zmq.POLLIN]
        for descriptor, _ in self._epoll.poll(0.0 if ready else max(0.0, timeout_s)):
            what = self._by_descriptor.get(descriptor)
            if what is not None and what not in ready:
                ready.append(what)
        self._doubtful = [what for what in ready if not isinstance(what, int)]
        return ready

    def close(self) -> None:
        self._epoll.close()


def wake_on_signals(stop: Callable[[], None]) -> int:
    """Install handlers of SIGINT and SIGTERM; the returned descriptor becomes readable when one came."""
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())
    return read
