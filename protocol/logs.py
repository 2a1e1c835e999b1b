"""Logs that stay readable and small, whatever arrives. Only this module bounds what is logged and how much.

Text of another program may hold anything: `foreign` makes one short line of it. `setup` gives a process its log, in
which each place in the program writes at most BURST lines in EVERY_S seconds, none longer than LINE characters.
"""

from __future__ import annotations

import logging
import sys
import threading
import time

TEXT = 200
"""Most characters of somebody else's text in a line or a status message."""
LINE = 4000
"""Most characters of a record with its traceback."""
BURST, EVERY_S = 20, 10.0
"""Records of one place in the program (or of one source it names) within EVERY_S; the rest is counted."""
PLACES = 500


def foreign(text: object, most: int = TEXT) -> str:
    """What another program wrote, as one line without control characters, at most `most` characters long."""
    found = text.decode("utf-8", "backslashreplace") if isinstance(text, bytes) else str(text)
    whole = len(found)
    found = found[: most + 1]
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in found)
    return line if len(line) <= most and whole <= most else f"{line[: most - 3]}..."


class _Bounded(logging.Formatter):
    """A record as text that is bounded and holds no control characters but the ends of a traceback's lines."""

    def format(self, record: logging.LogRecord) -> str:
        return "\n".join(foreign(line, LINE) for line in super().format(record)[:LINE].splitlines())


class RateLimit(logging.Filter):
    """Lets BURST records of one place through in EVERY_S seconds, and says how many it kept back."""

    def __init__(self) -> None:
        super().__init__()
        self._places: dict[tuple[str, int], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:
        place, now = (record.pathname, record.lineno), time.monotonic()
        with self._lock:
            since, seen = self._places.get(place, (now, 0))
            kept_back = 0
            if now - since >= EVERY_S:
                since, seen, kept_back = now, 0, max(0, seen - BURST)
            if place not in self._places and len(self._places) >= PLACES:
                self._places.clear()
            self._places[place] = (since, seen + 1)
        if kept_back:
            record.msg, record.args = f"{record.getMessage()} (and {kept_back} more like it before, not logged)", ()
        return seen < BURST


def setup(form: str, level: int = logging.INFO) -> None:
    """The log of this process on stderr, in the format `form`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Bounded(form))
    handler.addFilter(RateLimit())
    logging.basicConfig(handlers=[handler], level=level)
