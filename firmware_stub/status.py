"""How the stub does: a status frame a second, and at once when a fault begins or ends."""

from __future__ import annotations

import time

from protocol.frames import StatusFrame

from .faults import messages_of
from .port import BoardPort
from .rig import Rig

EVERY_S = 1.0


class Status:
    """Counts what was published and says how the rig is."""

    def __init__(self, skin: str) -> None:
        self._skin = skin
        self._scans = 0
        self._since, self._cpu = time.monotonic(), time.process_time()
        self._messages: list[str] = []

    def scanned(self) -> None:
        self._scans += 1

    def due(self, rig: Rig, port: BoardPort, now: float) -> StatusFrame | None:
        """The status frame that is due at `now` (the rig's seconds), or None."""
        messages = messages_of(rig.faults.listing(now))
        clock = time.monotonic()
        passed = clock - self._since
        if passed < EVERY_S and messages == self._messages:
            return None
        cpu = time.process_time()
        frame = StatusFrame(
            skin=self._skin,
            source="stub",
            valid=True,
            valid_for_s=3 * EVERY_S,
            stamps={"publish": time.monotonic_ns()},
            process="stub",
            level="WARN" if messages else "OK",
            messages=messages,
            rates={"truth": self._scans / passed if passed > 0 else 0.0},
            drops={"line_full": rig.line.dropped, "bytes_unread": port.overrun},
            counters={"solves": rig.field.solves, "late_poses": rig.field.late, **rig.board.received},
            cpu=(cpu - self._cpu) / passed if passed > 0 else 0.0,
        )
        self._scans, self._since, self._cpu, self._messages = 0, clock, cpu, messages
        return frame
