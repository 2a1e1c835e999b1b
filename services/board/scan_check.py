"""The scan check decides which scans of a board are believed, and gives their reasons."""

from __future__ import annotations

from protocol import link
from services.board.clock import DeviceClock
from services.board.frozen import FrozenScans
from services.board.scan_order import ScanOrder

IMPOSSIBLE_SCANS = 3  # in a row whose times cannot be: the board's clock has jumped
DOUBTED_SCANS = 3  # after that: the clock is to be believed again only once it goes on well


class ScanCheck:
    """The scan check of one connection.

    `reasons`: of the scans received last, by number: gap, clock, frozen. `jumped`: the board's clock has, by the scans.
    """

    def __init__(self, clock: DeviceClock) -> None:
        self.reasons: dict[int, list[str]] = {}
        self.missing = 0  # just before the last scan that was believed
        self._clock, self._order, self._frozen = clock, ScanOrder(), FrozenScans()
        self._impossible = self._doubted = 0  # scans in a row; scans still to come

    @property
    def jumped(self) -> bool:
        return self._impossible >= IMPOSSIBLE_SCANS

    @property
    def frozen(self) -> bool:
        """Whether the last scan was one of several that are the same."""
        return self._frozen.frozen

    def started(self, device_us: int) -> None:
        """The board has carried out START when its clock showed this (0: it does not say)."""
        self._order.started(device_us)
        self._impossible = 0

    def doubt(self) -> None:
        """The board's clock was wrong: it has to go on well for DOUBTED_SCANS."""
        self._doubted = DOUBTED_SCANS

    def __call__(self, scan: link.ScanFrame, arrived_ns: int, fit: bool) -> str:
        """Returns what a scan counts as: scans, repeated, foreign. fit: the clock may be set by it."""
        missing = self._order.missing(scan)
        if missing < 0:  # repeated or older. If the board began anew without a word, it counts as silent
            return "repeated"
        ended_us = scan.device_us + scan.duration_us
        if not self._order.consistent(scan) or not self._clock.possible(ended_us, arrived_ns):
            self._impossible += 1
            return "foreign"  # captured before, or of a clock that jumped
        self._impossible, self.missing, follows = 0, missing, self._order.follows(scan)
        self._order.take(scan)
        self._clock.observe(ended_us, arrived_ns, fit)
        frozen = self._frozen(scan)
        known = ("gap", not follows), ("clock", self._doubted > 0), ("frozen", frozen)
        self.reasons[scan.seq] = [reason for reason, holds in known if holds]
        self._doubted = max(0, self._doubted - 1)
        return "scans"
