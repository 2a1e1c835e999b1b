"""The thread that reads one skin's frames and has its node publish them: contacts, or why there are none to act on;
images and diagnostics while somebody wants them.
"""

from __future__ import annotations

import threading
import time
import traceback

import rclpy
import zmq
from eitskin.errors import EitskinError
from eitskin.feeds import ImageFeed, NewestFeed
from eitskin.frames import ELECTRODE_STATES, DeltaFrame, InfoFrame, StatusFrame
from eitskin.freshness import NewestContacts, NotValid
from eitskin.sockets import AllReader

from .messages import SILENT
from .node import SkinNode

TICK_S = 0.1
"""How often it looks who subscribes, and how often it says that nothing comes."""
DIAGNOSTICS_S = 1.0


class ReaderThread:
    """Reads from the start on, until `close`. Where it fails it ends the node."""

    def __init__(self, node: SkinNode) -> None:
        self._node = node
        self.failed = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reader")
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._read()
        except Exception as why:
            if rclpy.ok():  # else Ctrl-C ended it, and what is published fails
                self.failed = True
                self._node.get_logger().fatal(str(why) if isinstance(why, EitskinError) else traceback.format_exc())
                rclpy.try_shutdown()

    def _read(self) -> None:
        node = self._node
        contacts, images, statuses = Contacts(node), ImageFeed(node.skin, node.replay), Statuses(node)
        next_tick = 0.0
        while not self._closing.is_set():
            poller = zmq.Poller()
            for socket in (contacts.reader.socket, statuses.reader.socket, *images.sockets()):
                poller.register(socket, zmq.POLLIN)
            since_ns = time.monotonic_ns()
            ready = dict(poller.poll(max(0.0, min(next_tick, contacts.due) - since_ns * 1e-9) * 1000))
            contacts.take(since_ns, contacts.reader.socket in ready)
            if (picture := images.take(since_ns)) is not None:
                node.show(picture.frame, picture.measured_ns)
            statuses.take()
            if time.monotonic() >= next_tick:
                next_tick = time.monotonic() + TICK_S
                contacts.reader.mind()
                images.want(node.wants_image)
                statuses.look()


class Contacts:
    """`due`: when the newest frame is too old, and it is time to say so."""

    def __init__(self, node: SkinNode) -> None:
        self._node = node
        self._newest = NewestContacts(node.skin, replay=node.replay)
        self.reader = self._newest.reader
        self.due = time.monotonic() + self._newest.silence_s(None)

    def take(self, since_ns: int, came: bool) -> None:
        """We have waited since `since_ns`."""
        newest = self._newest
        if came:
            newest.woken(since_ns)
        try:
            frame = newest.fresh()
        except NotValid as why:
            self._node.refuse(str(why), list(why.frame.reasons), newest.measured_ns)
            self.due = time.monotonic() + newest.silence_s(None)
            return
        if frame is not None and newest.measured_ns is not None:
            self._node.hand_on(frame, newest.measured_ns)
            self.due = newest.measured_ns * 1e-9 + frame.valid_for_s
        elif time.monotonic() >= self.due:
            self._node.refuse(str(newest.stale(None)), [SILENT])
            self.due = time.monotonic() + TICK_S


class Statuses:
    """What eitskin's processes say of themselves, and where the skin is."""

    def __init__(self, node: SkinNode) -> None:
        self._node = node
        self.reader = AllReader(["status", "info"], node.skin)
        self._statuses: dict[str, tuple[StatusFrame, float]] = {}
        self._scans = NewestFeed("delta", node.skin)  # which say how the electrodes are
        self._next = 0.0

    def take(self) -> None:
        while (frame := self.reader.recv(0.0)) is not None:
            if isinstance(frame, StatusFrame):
                self._statuses[frame.process] = frame, time.monotonic()
            elif isinstance(frame, InfoFrame):
                self._node.place(frame.info)

    def look(self) -> None:
        """Publish diagnostics, where they are wanted and due."""
        self.reader.mind()
        wanted = self._node.wants_diagnostics
        self._scans.want(wanted)
        if not wanted or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + DIAGNOSTICS_S
        scan = self._scans.recv()
        states = scan.electrodes.tolist() if isinstance(scan, DeltaFrame) else []
        electrodes = [ELECTRODE_STATES[s] if s < len(ELECTRODE_STATES) else "unknown" for s in states]
        now = time.monotonic()
        self._node.diagnose([(frame, now - at) for frame, at in self._statuses.values()], electrodes)
