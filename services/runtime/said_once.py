"""Which failures are worth a line in the log: a text at once when it is new, and so many lines a minute at most."""

from __future__ import annotations

import time
from collections import OrderedDict

REMEMBERED = 100  # texts
AGAIN_S = 60.0  # after which a failure that goes on is logged once more
LINES, WINDOW_S = 20, 60.0  # lines at most in a window


class SaidOnce:
    """Numbers within a text make no new one: the same failure may name another scan each time."""

    def __init__(self) -> None:
        self._said: OrderedDict[str, float] = OrderedDict()
        self._window_s, self._lines = 0.0, 0

    def worth_a_line(self, why: Exception, where: str) -> bool:
        """Whether this failure is to be logged now. where: what was being done."""
        now = time.monotonic()
        kind = f"{where}{type(why).__name__}: " + "".join(c for c in str(why)[:500] if not c.isdigit())
        if now - self._said.get(kind, -AGAIN_S) < AGAIN_S or not self._room(now):
            return False
        self._said[kind] = now
        self._said.move_to_end(kind)
        while len(self._said) > REMEMBERED:
            self._said.popitem(last=False)
        return True

    def _room(self, now: float) -> bool:
        if now - self._window_s >= WINDOW_S:
            self._window_s, self._lines = now, 0
        self._lines += 1
        return self._lines <= LINES
