"""The thread that reads one skin's frames and has its node publish them: contacts, or why there are none to act on;
images and diagnostics while somebody wants them.
"""

from __future__ import annotations

import threading
import time
import traceback

import rclpy
import zmq
from eitskin.ages import Ages
from eitskin.frames import ELECTRODE_STATES, DeltaFrame, ImageFrame, InfoFrame, StatusFrame
from eitskin.freshness import NewestContacts, NotValid
from eitskin.held import HeldImage
from eitskin.runtime import host_id
from eitskin.sockets import AllReader, NewestReader

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
        except Exception:
            if rclpy.ok():  # else Ctrl-C ended it, and what is published fails
                self.failed = True
                self._node.get_logger().fatal(traceback.format_exc())
                rclpy.try_shutdown()

    def _read(self) -> None:
        contacts, images, statuses = Contacts(self._node), Images(self._node), Statuses(self._node)
        next_tick = 0.0
        while not self._closing.is_set():
            poller = zmq.Poller()
            for reader in (contacts.reader, statuses.reader, *images.readers):
                poller.register(reader.socket, zmq.POLLIN)
            since_ns = time.monotonic_ns()
            ready = dict(poller.poll(max(0.0, min(next_tick, contacts.due) - since_ns * 1e-9) * 1000))
            contacts.take(since_ns, contacts.reader.socket in ready)
            images.take(since_ns)
            statuses.take()
            if time.monotonic() >= next_tick:
                next_tick = time.monotonic() + TICK_S
                contacts.reader.mind()
                images.look()
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


class Images:
    """`readers`: one while somebody wants images, else none. A held image is put in again."""

    def __init__(self, node: SkinNode) -> None:
        self._node = node
        self.readers: list[NewestReader] = []
        self._ages, self._held = Ages(), HeldImage()

    def look(self) -> None:
        """Subscribe while somebody wants images."""
        if self._node.wants_image and not self.readers:
            self.readers = [NewestReader("image", self._node.skin)]
        elif not self._node.wants_image and self.readers:
            self.readers.pop().close()
        for reader in self.readers:
            reader.mind()

    def take(self, since_ns: int) -> None:
        """One of another host has come since `since_ns`, and more is not known."""
        frame = self.readers[0].recv(0.0) if self.readers else None
        if not isinstance(frame, ImageFrame) or (frame.source == "replay" and not self._node.replay):
            return
        here = frame.host in ("", host_id())
        measured_ns = self._ages.measured_ns(frame, time.monotonic_ns() if here else since_ns)
        if not self._held.complete(frame):
            self.readers.pop().close()  # whoever subscribes is sent it
        elif frame.valid and measured_ns is not None and self._ages.age_s(measured_ns) <= frame.valid_for_s:
            self._node.show(frame, measured_ns)


class Statuses:
    """What eitskin's processes say of themselves, and where the skin is."""

    def __init__(self, node: SkinNode) -> None:
        self._node = node
        self.reader = AllReader(["status", "info"], node.skin)
        self._statuses: dict[str, tuple[StatusFrame, float]] = {}
        self._scans: NewestReader | None = None  # which say how the electrodes are
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
        if not self._node.wants_diagnostics or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + DIAGNOSTICS_S
        if self._scans is None:
            self._scans = NewestReader("delta", self._node.skin)
        self._scans.mind()
        scan = self._scans.recv(0.0)
        states = scan.electrodes.tolist() if isinstance(scan, DeltaFrame) else []
        electrodes = [ELECTRODE_STATES[s] if s < len(ELECTRODE_STATES) else "unknown" for s in states]
        now = time.monotonic()
        self._node.diagnose([(frame, now - at) for frame, at in self._statuses.values()], electrodes)
