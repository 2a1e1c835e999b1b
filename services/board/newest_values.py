"""The newest value of every measurement, and when each was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from protocol import link
from protocol.frames import RawFrame
from services.runtime.stage import add_reason


class NewestValues:
    """Of one connection. order (K,): the place in the pattern of each measurement, in the order of the scan list."""

    def __init__(self, order: NDArray[np.integer]) -> None:
        self._order = np.asarray(order)
        self._z = np.zeros(len(order), np.complex64)
        self._status = np.zeros(len(order), np.uint8)
        self._measured_us = np.zeros(len(order))  # by the board's clock
        self._next_seq, self._in_a_row = -1, 0
        self._gap = False  # parts were lost since the last message that was handed on

    def take(self, scan: link.ScanFrame, gap: bool = False) -> bool:
        """Take a scan, or a part of one; False while not every value is of the last `parts` that the board sent: after
        a gap nothing that lies before it is handed on again. gap: something is missing just before this one.
        """
        follows = scan.seq == self._next_seq and not gap
        self._gap = self._gap or not (follows or self._next_seq < 0)
        self._in_a_row = self._in_a_row + 1 if follows else 1
        self._next_seq = (scan.seq + 1) % 2**32
        rows = self._rows(scan)
        self._z[rows], self._status[rows] = scan.z, scan.status
        at = (np.arange(len(rows)) + 0.5) / len(rows)
        self._measured_us[rows] = scan.device_us + at * scan.duration_us
        return self._in_a_row >= scan.parts

    def frame(self, header: RawFrame, scan: link.ScanFrame) -> RawFrame:
        """The newest value of every measurement, with the header of the part taken last, or of a whole scan."""
        age_us = (scan.device_us + scan.duration_us - self._measured_us).astype(np.float32)
        reasons = list(header.reasons)
        frame = replace(header, z=self._z.copy(), status=self._status.copy(), age_us=age_us, reasons=reasons)
        if scan.parts > 1:
            frame.new = np.zeros(len(self._order), np.uint8)
            frame.new[self._rows(scan)] = 1
            frame.part, frame.parts = scan.part + 1, scan.parts
        if self._gap:
            add_reason(frame.reasons, "gap")
            self._gap = False
        return frame

    def _rows(self, scan: link.ScanFrame) -> NDArray[np.integer]:
        rows: NDArray[np.integer] = self._order.reshape(scan.parts, -1)[scan.part]
        return rows
