"""A board in a few lines: answers the link protocol behind a pty, misbehaves as told. No physics: all Z are 1 + 2j."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np

from protocol import link

DURATION_US = 4000


class FakeBoard:
    """The firmware: bytes in, bytes out. `ident` may be changed to play another firmware or a broken chip.

    clock: its time [us], or None for a firmware that does not know the questions for it.
    """

    def __init__(self, unique_id: bytes = b"0123456789ab", measurements: int = 120) -> None:
        self.ident = link.Ident(schema_hash=link.SCHEMA_HASH, unique_id=unique_id, firmware="fake 1.0")
        self.decoder = link.Decoder()
        self.heard: list[link.Message] = []
        self.config: link.Config | None = None
        self.running = False
        self.seq = 0
        self.deaf = False
        self.status = 0  # of every measurement
        self.clock: Callable[[], int] | None = None
        self._scanned = (0, 0)  # number of the last scan, when it began [us]

    def receive(self, data: bytes) -> bytes:
        out = b""
        for message in self.decoder.feed(data):
            self.heard.append(message)
            if self.deaf:
                continue
            if isinstance(message, link.Hello):
                out += link.encode(self.ident)
            elif isinstance(message, link.Config):
                self.config = message
                out += link.encode(link.Ack(of=message.number, value=message.config))
            elif isinstance(message, link.Start):
                self.running, self.seq = True, 0
                us = self.clock() if self.clock else 0
                out += link.encode(link.Ack(of=message.number, value=message.config, device_us=us))
            elif isinstance(message, link.TimeAsk) and self.clock is not None:
                out += link.encode(link.Time(nonce=message.nonce, device_us=self.clock()))
        return out

    def scan(self, device_us: int | None = None) -> bytes:
        """The next scan; without a time, one that follows the scan before without a pause."""
        assert self.config is not None
        if device_us is None:
            ahead = (self.seq - self._scanned[0] + 2**31) % 2**32 - 2**31
            device_us = max(0, self._scanned[1] + ahead * DURATION_US)
        self._scanned = (self.seq, device_us)
        n = len(self.config.scan)
        frame = link.ScanFrame(
            seq=self.seq,
            device_us=device_us,
            duration_us=DURATION_US,
            config=self.config.config,
            z=np.full(n, 1 + 2j, np.complex64),
            status=np.full(n, self.status, np.uint8),
        )
        self.seq += 1
        return link.encode(frame)


class PtyBoard:
    """A FakeBoard behind a pty, linked at `path`, scanning every `period_s` in a thread."""

    def __init__(self, path: Path, board: FakeBoard, period_s: float = 0.01) -> None:
        self.board, self.path, self.period_s = board, path, period_s
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        path.symlink_to(os.ttyname(self.slave))
        self.garbage = b""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        began = time.monotonic()
        while not self._stop.is_set():
            with contextlib.suppress(OSError):
                if select.select([self.master], [], [], self.period_s)[0]:
                    os.write(self.master, self.board.receive(os.read(self.master, 4096)))
                if self.garbage:
                    os.write(self.master, self.garbage)
                    self.garbage = b""
                if self.board.running:
                    os.write(self.master, self.board.scan(int((time.monotonic() - began) * 1e6)))

    def unplug(self) -> None:
        self._stop.set()
        self._thread.join()
        self.path.unlink(missing_ok=True)
        os.close(self.master)
        os.close(self.slave)
