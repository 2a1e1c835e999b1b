"""The scan order tells whether a scan follows those before it: by its number, and by the board's clock."""

from __future__ import annotations

from protocol import link

WRAP = 2**32  # of the scans' numbers
PAUSED = 0.5  # of a scan or part, which the board measured nothing for: what comes does not follow
SHORTER, LONGER = 0.5, 4.0  # times as long as the scans in between are said to have taken
PAUSE_US = 1_000_000  # a board may also pause between scans


class ScanOrder:
    """The order of one board's scans since START.

    A number that went on by n says that n scans have begun since; their durations say how far the board's clock went on
    meanwhile. Captured scans that are sent again fail one or the other, or lie before START.
    """

    def __init__(self) -> None:
        self._taken = False
        self.started(0)

    def started(self, device_us: int) -> None:
        """A START was carried out when the board's clock showed this (0: it does not say)."""
        self._again = self._taken
        self._started_us = device_us
        self._last: link.ScanFrame | None = None
        self._durations: dict[int, int] = {}  # us, by configuration

    def missing(self, scan: link.ScanFrame) -> int:
        """Returns how many scans lie between the last one and this; negative: it is that one again, or older."""
        if self._last is None:
            return 0
        ahead = (scan.seq - self._last.seq) % WRAP
        return (ahead if ahead < WRAP // 2 else ahead - WRAP) - 1

    def follows(self, scan: link.ScanFrame) -> bool:
        """Whether the board measured without a break from the last scan to this one; of the first one: whether none was
        taken before START.
        """
        last = self._last
        if last is None:
            return not self._again
        pause_us = scan.device_us - last.device_us - last.duration_us
        return self.missing(scan) == 0 and pause_us <= PAUSED * scan.duration_us

    def consistent(self, scan: link.ScanFrame) -> bool:
        """Whether the board's clock, and the part, have gone on as the scan's number says."""
        last = self._last
        if last is None:
            return scan.device_us + scan.duration_us >= self._started_us
        others = [*self._durations.values(), scan.duration_us]
        missing = self.missing(scan)
        if last.parts == scan.parts and (scan.part - last.part - missing - 1) % scan.parts:
            return False
        least = SHORTER * (last.duration_us + missing * min(others))
        most = LONGER * (last.duration_us + missing * max(others)) + PAUSE_US
        return least <= scan.device_us - last.device_us <= most

    def take(self, scan: link.ScanFrame) -> None:
        """Takes this scan as the last one."""
        self._taken = True
        self._last = scan
        self._durations[scan.config] = scan.duration_us
