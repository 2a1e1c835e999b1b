"""Presses for a force law while one presses and another sensor says the force: `skin calibrate force --live`.

A press counts where one touch was held still, the skin was free before and after it, and the reference tells its force.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from protocol.ages import Ages
from protocol.frames import Frame, ImageFrame, ReferenceFrame
from protocol.sockets import AllReader
from services.calibration.force_fit import CalibrationError, Press
from services.calibration.force_presses import PATIENCE_S, STEADY_S, Steady
from services.calibration.reference import (
    AROUND_S,
    GUARD_S,
    SETTLE_S,
    STALE_S,
    ZERO_S,
    Doubtful,
    PressCourse,
    ReferenceForce,
)
from services.calibration.seen import SeenTouch, SeenTouches, TouchReader
from services.contacts.force.calibration_file import Calibration

FREE_S = GUARD_S + ZERO_S + AROUND_S  # how long the skin is free before a press
COURSE = 4096  # images of one press that are kept
LEAST_PRESSES = 20  # with 12 a law of four parameters was off by 2.4 % and thought 0.8 %
OF_A_TIP = LEAST_PRESSES // 2  # of the tip that presses: a law of two tips was measured with ten of each
ENOUGH = 0.015  # relative standard uncertainty of the law: with so much nobody needs to press on
QUARTERS = {(1, 1): "upper right", (-1, 1): "upper left", (-1, -1): "lower left", (1, -1): "lower right"}


class LivePresses:
    """The presses that are made from now on. show: takes a line for who presses."""

    def __init__(self, skin: str, read: TouchReader, show: Callable[[str], None], tip_m: float | None) -> None:
        self.reference = ReferenceForce(skin)
        self._read, self._show, self._tip = read, show, tip_m
        self._reader = AllReader(["image", "reference"], skin)
        self._ages = Ages()
        self._shown = ""  # last
        self._counts = 0, 0  # of messages that could not be read, and that came again
        self._unread = -math.inf, ""  # when such a message came last [s], and what was wrong with it
        self._course: deque[tuple[float, float]] = deque(maxlen=COURSE)
        self._images = 0
        self._seen = SeenTouches([], [])  # in the newest frame

    def __iter__(self) -> Iterator[Press]:
        """Each press that counts. Raises CalibrationError where none comes within the patience."""
        count = 0
        while True:
            self._free()
            try:
                force, seen = self._press()
            except Doubtful as why:
                self._tell(f"{why}; this press does not count", again=True)
                continue
            count += 1
            yield Press(force, seen, f"press {count}", self._tip)

    def close(self) -> None:
        self._reader.close()
        self.reference.close()
        self._ages.close()

    # -- one press --------------------------------------------------------------------------------------------------
    def _free(self) -> None:
        """Until the skin has been free for long enough while the reference was there."""
        while self._reader.recv(0.0) is not None:  # what came while somebody was told of the last press
            pass
        since: float | None = None
        asked = False
        for frame, now in self._frames("the skin did not become free: release it, or tare (`skin tare`)"):
            trouble = self._trouble(now)
            if trouble or frame.touched:
                if trouble:
                    self._tell(f"{trouble}; no press counts until then")
                if frame.touched and not asked:
                    self._tell("release", again=True)
                since, asked = None, asked or frame.touched
            elif since is None:
                since = now
            elif now - since >= FREE_S:
                self._tell("press one place and hold still", again=True)
                return

    def _press(self) -> tuple[float, SeenTouch]:
        """The next press. Raises Doubtful where it does not count."""
        began = self._until(True, "no press came")
        seen, steady = self._steady()
        self._tell("release", again=True)
        ended = self._until(False, "something still touches: free the skin, or tare (`skin tare`)")
        for _, now in self._frames("the images ended"):
            if now - ended > SETTLE_S + STEADY_S / 10:
                break
        times, shown = np.array(self._course).T
        return self.reference.force(PressCourse(times, shown, began, steady, ended)), seen

    def _until(self, touched: bool, why: str) -> float:
        """When something touched first, or nothing any more. Raises Doubtful where the reference ends meanwhile."""
        for frame, now in self._frames(why):
            if trouble := self._trouble(now):
                raise Doubtful(trouble)
            if frame.touched == touched:
                return self._when(frame, now)
        raise AssertionError("frames end by an exception")

    def _steady(self) -> tuple[SeenTouch, tuple[float, float]]:
        """What a press shows once it is steady, and from when to when that was. Raises Doubtful."""
        steady, trouble_before = Steady(), "too short"
        for frame, now in self._frames("no steady press"):
            if trouble := self._trouble(now):
                raise Doubtful(trouble)
            seen = steady(self._seen, frame.stamps.get("sample", 0))
            if not frame.touched:
                raise Doubtful(f"released before it was steady ({trouble_before}): hold still until told")
            trouble_before = steady.trouble
            if seen is not None:
                end = self._when(frame, now)
                return seen, (end - STEADY_S, end)
        raise AssertionError("frames end by an exception")

    # -- what comes ---------------------------------------------------------------------------------------------------
    def _frames(self, why: str) -> Iterator[tuple[ImageFrame, float]]:
        """Image frames, and when each came [s]; the reference is followed beside them. Raises CalibrationError."""
        end = time.monotonic() + PATIENCE_S
        while (now := time.monotonic()) < end:
            frame: Frame | None = self._reader.recv(min(0.5, end - now))
            arrived = time.monotonic()
            self._note_unread(arrived)
            if isinstance(frame, ReferenceFrame):
                self.reference.take(frame, arrived)
            elif isinstance(frame, ImageFrame):
                self._images += 1
                self._seen = self._read(frame)
                self._note(frame, arrived)
                yield frame, arrived
        if not self._images:
            why = "no image came: start the service with `skin up`"
        elif trouble := self._trouble(time.monotonic()):
            why = trouble
        raise CalibrationError(f"no press within {PATIENCE_S:g} s: {why}")

    def _note(self, frame: ImageFrame, now: float) -> None:
        """A point of the course: of frames that show something, or that nothing touches."""
        if self._seen.touches or not frame.touched:
            acts = sum(touch.acts for touch in self._seen.touches)
            self._course.append((self._when(frame, now), acts))

    def _when(self, frame: ImageFrame, arrived_s: float) -> float:
        measured = self._ages.measured_ns(frame, int(arrived_s * 1e9))
        return arrived_s if measured is None else 1e-9 * measured

    def _trouble(self, now_s: float) -> str:
        """Why the reference says nothing at present; "" where it does."""
        trouble = self.reference.trouble(now_s)
        noted_s, unread = self._unread
        return unread if trouble and unread and now_s - noted_s < STALE_S else trouble

    def _note_unread(self, now_s: float) -> None:
        """What is wrong with messages that do not count as such. Without their number: each would be told anew."""
        counts, bad = (self._reader.malformed, self._reader.repeated), self._reader.last_error
        if counts[0] > self._counts[0] and bad is not None and bad.topic == "reference":
            self._unread = now_s, f"messages cannot be read: {bad}"
        elif counts[1] > self._counts[1]:
            self._unread = now_s, "messages come with a `seq` that had been there: it must count up"
        self._counts = counts

    def _tell(self, text: str, again: bool = False) -> None:
        """Once, unless `again`."""
        if again or text != self._shown:
            self._show(text)
        self._shown = text


def missing(presses: Sequence[Press], found: Calibration) -> str:
    """What presses do not tell yet, for who presses; "" where they are enough."""
    if len(presses) < LEAST_PRESSES:
        return f"{LEAST_PRESSES - len(presses)} more presses at least"
    of_this = sum(p.tip_m == presses[-1].tip_m for p in presses)
    if of_this < OF_A_TIP:
        return f"{OF_A_TIP - of_this} more presses of this tip at least"
    pressed = {(1 if p.seen.x > 0 else -1, 1 if p.seen.y > 0 else -1) for p in presses}
    if left := [name for quarter, name in QUARTERS.items() if quarter not in pressed]:
        return f"presses in the {', '.join(left)} quarter"
    scatter = found.origin["error"]["scatter"]
    return f"the law to {100 * ENOUGH:.1f} %" if scatter > ENOUGH else ""
