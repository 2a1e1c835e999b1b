"""Remarks on a board that runs, for `skin status`: what cannot be seen of it, or not be believed."""

from __future__ import annotations

from services.board.boardlink import BoardLink
from services.board.clock import MAX_RATE_ERROR, WIDE_NS
from services.runtime.stage import Health

REMEMBERED_S = 5.0  # how long status speaks of a standstill

UNTIMED = (
    "this board's firmware does not tell its time (TIME_ASK): a delay of its line that was there from the start, "
    f"or that grows by less than {MAX_RATE_ERROR * 1e3:g} ms/s, is not seen"
)
WHOLE = "this board's firmware knows whole scans only: touches are told after whole scans"
FOR_NOW = "the board scans whole for now, as preprocessing did not keep up with parts; they are tried again by and by"
FROZEN = "the board sends the same scan again and again, with new numbers: its frames are not valid; power-cycle it"
UNKNOWN = (
    f"how old the board's frames are is not known within {WIDE_NS / 1e6:.0f} ms, for its answers take too long: "
    "its frames are not valid; is the line to it slow?"
)


class Remarks:
    """The source's thread keeps the remarks, the runner's reads them."""

    def __init__(self) -> None:
        self._levels: dict[str, str] = {}  # by text
        self._stood_still = -REMEMBERED_S, ""  # when that was last, and the text

    def stood_still(self, stood_s: float, skipped: int, now_s: float) -> None:
        """Acquisition has not run for so long, and skipped so many scans that waited."""
        self._stood_still = now_s, f"acquisition stood still for {stood_s:.1f} s: {skipped} scans were skipped"

    def look(self, board: BoardLink, now_s: float, whole: bool = False) -> None:
        """Looks for what is to be said now. whole: parts are too much for now."""
        levels = {}
        if board.state == "running":
            if not board.clock.timed:
                levels[UNTIMED] = "WARN"
            if board.knows_no_parts:
                levels[WHOLE] = "OK"
            elif whole:
                levels[FOR_NOW] = "OK"
            if board.clock_unknown:
                levels[UNKNOWN] = "ERROR"
            if board.frozen:
                levels[FROZEN] = "ERROR"
        if now_s - self._stood_still[0] < REMEMBERED_S:
            levels[self._stood_still[1]] = "WARN"
        self._levels = levels

    def added_to(self, health: Health) -> Health:
        levels = self._levels
        level = max(health.level, *levels.values(), key=("OK", "WARN", "ERROR").index) if levels else health.level
        return Health(level, [*health.messages, *levels], health.counters)
