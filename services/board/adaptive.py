"""The adaptive scan decides which list the board scans, the whole pattern or the sentinel list, and which of its scans
go on to preprocessing.

A state machine without I/O, told the time. *full*: the whole pattern, over and over. *idle*: the sentinel list, and a
full scan every FULL_EVERY_S, at once on a suspicion. The judge of "nothing touches" is preprocessing, whose delta
frames are heard: the board idles after QUIET_FRAMES full scans in a row that were valid, untouched and without an
electrode in doubt, and no longer than such verdicts come. Where they stop, every scan is a full one.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from models.sentinel import Sentinel
from protocol import link
from protocol.frames import DeltaFrame
from services.estimation.sentinel import SentinelDetector, SentinelVerdict

QUIET_FRAMES = 64  # 3 s: a tare's worth, so that one can be taken while the board idles
FULL_EVERY_S = 0.5  # as often as preprocessing follows drift: longer gaps would widen what it allows for
DEAF_S = 0.4  # without a verdict: preprocessing is down, or far behind
LOST_S = 0.5  # a full scan asked for that does not come is asked for again
BEGUN_S = 0.005  # after the scan under way, by when the next one has begun

Passed = tuple[link.ScanFrame, str]  # a scan and its kind


class AdaptiveScan:
    """The adaptive scan of one connection. `wants` is "full" or "sentinel"; idle_config: the id of the sentinel list on
    the board.
    """

    def __init__(self, sentinel: Sentinel, idle_config: int, quiet_frames: int = QUIET_FRAMES) -> None:
        self.rows, self.idle_config = sentinel.rows, idle_config
        self.watch = SentinelDetector(sentinel)
        self.counts: Counter[str] = Counter()
        self.idle = False
        self._quiet_frames = quiet_frames
        self._untouched: deque[NDArray[np.float64]] = deque(maxlen=quiet_frames)  # |z| of the sentinel's measurements
        self._quiet = 0  # full scans in a row that preprocessing found untouched
        self._heard_s = 0.0
        self._full_s = self._passed_s = 0.0  # when the last full scan came; when the last scan was passed on
        self._asked_s: float | None = None  # when a full scan was asked for that has not come
        self._promised_s: float | None = None  # when the board said that it would make it
        self._long_s = self._short_s = 0.05  # seconds of a full and of a sentinel scan
        self._block: list[link.ScanFrame] = []  # sentinel scans not passed on yet

    def wants(self, now_s: float, confirmed: str = "") -> str:
        """Returns what the board should scan now. confirmed: what it said that it scans after the scan under way."""
        if not self.idle:
            return "full"
        if now_s - self._heard_s > DEAF_S:
            self._wake("deaf")
            return "full"
        if self._asked_s is not None and now_s - self._asked_s > LOST_S + self._long_s:
            self.counts["unanswered"] += 1
            self._asked_s = None
        if self._asked_s is None and now_s - self._full_s > FULL_EVERY_S:
            self._ask(now_s)
        if self._asked_s is None:
            return "sentinel"
        if self._promised_s is None:
            self._promised_s = now_s if confirmed == "full" and now_s > self._asked_s else None
            return "full"
        return "full" if now_s < self._promised_s + self._short_s + BEGUN_S else "sentinel"

    def due_s(self, now_s: float) -> float:
        """Returns the seconds until `wants` changes by itself."""
        if not self.idle or self._asked_s is None or self._promised_s is None:
            return FULL_EVERY_S
        return max(0.001, self._promised_s + self._short_s + BEGUN_S - now_s)

    def interrupted(self) -> None:
        """The board does not scan any more: it will begin with full scans, and nothing is known of them."""
        if self.idle:
            self._wake("interrupted")
        self._quiet = 0
        self._untouched.clear()

    def scanned(self, scan: link.ScanFrame, now_s: float) -> list[Passed]:
        """Takes a scan of the board; returns what goes on to preprocessing."""
        if scan.config == self.idle_config:
            self._short_s = scan.duration_us * 1e-6
            return self._sentinel(scan, now_s)
        self._full_s, self._long_s, self._asked_s = now_s, scan.duration_us * 1e-6, None
        self._passed_s = now_s
        self._block.clear()
        self._untouched.append(np.abs(scan.z[self.rows]).astype(float))
        return [(scan, "full")]

    def _sentinel(self, scan: link.ScanFrame, now_s: float) -> list[Passed]:
        self.counts["sentinels"] += 1
        if not self.idle:  # on the way to full scans: a touch is under way
            return [(scan, "sentinel")]
        if scan.status.any() or not np.isfinite(scan.z).all() or not scan.z.all():
            self._wake("unsound")
            return []
        self._block.append(scan)
        verdict = self.watch(np.abs(scan.z).astype(float))
        if verdict is SentinelVerdict.HIT:
            self._wake("hit")
            return [(_mean(self._block[-self.watch.window :]), "sentinel")]
        if verdict is SentinelVerdict.SUSPECT and self._asked_s is None:
            self.counts["suspicions"] += 1
            self._ask(now_s)
        soon = self._asked_s is not None and now_s - self._asked_s < 3 * self._short_s
        # After those nothing comes until the full scan has been measured and sent.
        if not soon and now_s - self._passed_s < self._long_s - self._short_s / 2:
            return []
        mean, self._block, self._passed_s = _mean(self._block), [], now_s
        return [(mean, "sentinel")]

    def heard(self, delta: DeltaFrame, now_s: float) -> None:
        """Takes what preprocessing made of a scan."""
        self._heard_s = now_s
        if delta.touched or not delta.valid or delta.electrodes.any():
            if self.idle:
                self._wake("touched" if delta.touched else "doubt")
            self._quiet = 0
        elif "coarse" not in delta.reasons and not self.idle:
            self._quiet += 1
            if self._quiet >= self._quiet_frames and len(self._untouched) == self._quiet_frames:
                self._rest(now_s)

    def _rest(self, now_s: float) -> None:
        frames = np.array(self._untouched)
        if not np.isfinite(frames).all() or not (frames > 0).all():
            self._quiet = 0
            return
        self.watch.begin(frames)
        self.idle, self._asked_s, self._full_s = True, None, now_s
        self._block = []
        self.counts["rests"] += 1

    def _wake(self, why: str) -> None:
        self.counts[f"woken_{why}"] += 1
        self.idle, self._asked_s, self._quiet = False, None, 0
        self._untouched.clear()

    def _ask(self, now_s: float) -> None:
        self._asked_s, self._promised_s = now_s, None


def _mean(scans: list[link.ScanFrame]) -> link.ScanFrame:
    """Returns one scan that is the mean of several in a row."""
    if len(scans) == 1:
        return scans[0]
    first, last = scans[0], scans[-1]
    return link.ScanFrame(
        seq=last.seq,
        device_us=first.device_us,
        duration_us=last.device_us + last.duration_us - first.device_us,
        config=last.config,
        z=np.mean([scan.z for scan in scans], axis=0).astype(np.complex64),
        status=last.status,
    )
