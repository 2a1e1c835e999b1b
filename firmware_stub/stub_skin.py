"""One skin of the stub: its rig behind its port, the truth about it and its status."""

from __future__ import annotations

import hashlib
import logging
import time

from protocol.sockets import Publisher

from .port import BoardPort
from .rig import Rig
from .status import Status
from .truth import truth_frame

log = logging.getLogger("stub")


def link_name(skin: str) -> str:
    """Name of the link to this skin's serial device in the runtime folder."""
    return f"board-{skin}"


def unique_id(skin: str) -> bytes:
    """The 12 bytes by which a host tells this skin's board from another's; the same each time."""
    return b"stub" + hashlib.sha256(skin.encode()).digest()[:8]


class StubSkin:
    """Hands bytes to and fro between a rig and its port, and publishes what was true. The rig's time is seconds since
    `begin_ns`.
    """

    def __init__(self, name: str, rig: Rig, port: BoardPort, begin_ns: int) -> None:
        self.name, self.rig, self.port = name, rig, port
        self._begin_ns = self._written_ns = begin_ns
        self._status = Status(name)
        self._unplugged_as = ""  # the name under which the device is to come back
        self._gone = False

    @property
    def now(self) -> float:
        return (time.monotonic_ns() - self._begin_ns) * 1e-9

    @property
    def wake_s(self) -> float:
        """Seconds until `step` has something to do, unless the port becomes readable before."""
        return self.rig.wake_s(self.now)

    def step(self, publisher: Publisher) -> None:
        data = self.port.read()
        now = self.now  # taken after the read: the board cannot have read it earlier
        if data:
            self.rig.feed(data, now)
        if sent := self.rig.pull(now):
            self._written_ns = time.monotonic_ns()  # before the write: its reader may run before we do again
            self.port.write(sent)
        self._plug()
        # A scan's last byte has left when the line has nothing left to send, or has gone on to the scans after it.
        rig = self.rig
        while rig.scans and (not rig.line.backlog or len(rig.scans) > 1):
            scan, world, middle = rig.scans.popleft()
            stamps = {"sample": self._begin_ns + round(middle * 1e9), "publish": self._written_ns}
            publisher.send(truth_frame(self.name, rig.sheet, scan, world, stamps))
            self._status.scanned()
        if (due := self._status.due(rig, self.port, now)) is not None:
            publisher.send(due)

    def _plug(self) -> None:
        """Unplug the port or plug it in again, as the rig's fault says."""
        fault = self.rig.unplugged
        if (fault is not None) == self._gone:
            return
        self._gone = fault is not None
        if fault is not None:
            self._unplugged_as = fault["name"]
            self.port.unplug()
            log.info("%s: unplugged", self.name)
        else:
            self.port.plug(self._unplugged_as)
            log.info("%s: plugged in again as %s %s", self.name, self.port.url, self._unplugged_as)

    def close(self) -> None:
        self.port.close()
        self.rig.close()
