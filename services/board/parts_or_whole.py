"""Which skins scan in parts: all that can, as long as parts come sooner than whole scans would.

Preprocessing takes the newest part and skips what is older: it says how many, and how old what it makes is.

Where it does not, half of the skins scan whole at once; one after the other goes back, and each time that was too soon
the next attempt waits twice as long. Additive increase, multiplicative decrease, as TCP shares a line (V. Jacobson,
Congestion avoidance and control, 1988).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from protocol.frames import StatusFrame

BEHIND_HZ = 115.0  # parts a second that were skipped: half of them
OLD_MS = 22.0  # from the middle of a measurement to what is made of it: as old a whole scan is when it ends
IN_A_ROW = 2  # statuses that say so: beginnings of touches take a process some milliseconds each
LEAST_APART_S = 0.5  # of two statuses: one comes at once, too, where something changed
SETTLES_S = 3.0  # after a change, before statuses are of it: two statuses
LEAST_WAIT_S, MOST_WAIT_S = 10.0, 640.0


class PartsOrWhole:
    """Of the skins of one process that are to scan in parts."""

    def __init__(self, skins: Iterable[str]) -> None:
        self._whole = dict.fromkeys(skins, False)
        self._last: dict[str, tuple[float, str, int]] = {}  # when, of which session, how many were behind
        self._behind_hz: dict[str, float] = {}  # parts a second that preprocessing did not read in time
        self._in_a_row: dict[str, int] = {}  # statuses that said that it is behind
        self._changed_s = self._retried_s = -math.inf
        self._wait_s = LEAST_WAIT_S

    def whole(self, skin: str) -> bool:
        """Whether this skin is to scan whole for now."""
        return self._whole.get(skin, False)

    def update(self, status: StatusFrame, now_s: float) -> None:
        """A status of preprocessing, once a second of each skin."""
        skin = status.skin
        if skin not in self._whole:
            return
        behind = status.drops.get("skipped", 0) + status.counters.get("late", 0)
        then_s, session, before = self._last.get(skin, (now_s, "", 0))
        if session != status.session:
            self._last[skin] = now_s, status.session, behind
        elif now_s - then_s > LEAST_APART_S:
            self._last[skin] = now_s, session, behind
            self._behind_hz[skin] = (behind - before) / (now_s - then_s)
            slow = self._behind_hz[skin] > BEHIND_HZ or status.latency.get("p50", 0.0) > OLD_MS
            self._in_a_row[skin] = self._in_a_row.get(skin, 0) + 1 if slow else 0
        self._decide(now_s)

    def _decide(self, now_s: float) -> None:
        if now_s - self._changed_s < SETTLES_S:
            return
        if any(count >= IN_A_ROW and not self._whole[skin] for skin, count in self._in_a_row.items()):
            if now_s - self._retried_s < self._wait_s:
                self._wait_s = min(MOST_WAIT_S, 2 * self._wait_s)
            in_parts = [skin for skin, whole in self._whole.items() if not whole]
            in_parts.sort(key=lambda skin: self._behind_hz.get(skin, 0.0))
            self._change(in_parts[len(in_parts) // 2 :], True, now_s)
            return
        waiting = [skin for skin, whole in self._whole.items() if whole]
        if waiting and now_s - self._changed_s > self._wait_s:
            if now_s - self._retried_s > 2 * self._wait_s:
                self._wait_s = max(LEAST_WAIT_S, self._wait_s / 2)
            self._retried_s = now_s
            self._change(waiting[:1], False, now_s)

    def _change(self, skins: list[str], whole: bool, now_s: float) -> None:
        self._changed_s = now_s
        for skin in skins:
            self._whole[skin] = whole
        self._behind_hz.clear()
        self._in_a_row.clear()
