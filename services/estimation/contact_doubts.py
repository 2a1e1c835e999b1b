"""What is not sure of contacts yet: which may have changed, for how long that has been so, and which drift."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.estimation.advice import DRIFTING, OK
from services.estimation.saved import shaped

Mask = NDArray[np.bool_]
States = NDArray[np.uint8]

SUSPECTED = 3  # frames in a row after which a change that may be a touch on the electrode is the contact's
STILL_S = 10.0  # for which a contact that drifted must have been well
ASK_AGAIN = 8  # frames in which a contact that was suspected is asked about while nothing explains them
ASK_EVERY = 4  # frames from one question about a contact under a touch to the next: each takes 20 ms


class ContactDoubts:
    """Of E electrodes; states (E,): ELECTRODE_STATES, which whoever uses this keeps."""

    def __init__(self, electrodes: int) -> None:
        self._electrodes = electrodes
        self.reset()

    def reset(self) -> None:
        self.unsure = np.zeros(self._electrodes, dtype=bool)  # drifting, unless somebody presses right on it
        self.suspected = np.zeros(self._electrodes, dtype=np.int64)  # frames in a row
        self._open = np.zeros(self._electrodes, dtype=np.int64)  # frames for which a question may stay without answer
        self._asked = np.zeros(self._electrodes, dtype=np.int64)  # frames until the evidence is asked again
        self._off_s = np.full(self._electrodes, np.nan)  # when a contact that drifts was last seen off; NaN: none does

    def __bool__(self) -> bool:
        return bool(self.unsure.any() or self.suspected.any())

    def named(self, faulty: Mask, states: States, now_s: float) -> None:
        """A frame shows by itself that these electrodes are at fault."""
        self._off_s[faulty & np.isfinite(self._off_s)] = now_s
        self.unsure &= (states == DRIFTING) & ~faulty

    def passed(self, electrode: int | None, states: States) -> NDArray[np.intp]:
        """Electrodes that were suspected until now, or whose question has no answer yet, and that this frame, which
        suspects `electrode`, does not show.
        """
        again = np.arange(self._electrodes) == electrode
        self._open[self.suspected > 0] = ASK_AGAIN
        passed = (self._open > 0) & ~again & (states == OK)
        self._open[passed] -= 1
        return np.flatnonzero(passed)

    @property
    def asks(self) -> bool:
        """Whether an electrode is suspected, or its question has no answer yet."""
        return bool(self.suspected.any() or self._open.any())

    def answered(self, k: int) -> None:
        self._open[k] = 0

    def suspect(self, electrode: int | None, states: States) -> Mask:
        """A frame suspects this electrode, or none. (E,) which have been suspected for so long that they count as
        drifting now.
        """
        again = np.arange(self._electrodes) == electrode
        self.suspected = np.where(again, self.suspected + 1, 0)
        lasts: Mask = (self.suspected >= SUSPECTED) & (states == OK)
        self.unsure[lasts], self._asked[lasts] = True, 0
        self.suspected[(states != OK) & ~lasts & ~self.unsure] = 0
        return lasts

    def drifts(self, k: int, now_s: float) -> None:
        """The contact of electrode k is known to drift."""
        self.sure(k)
        self._off_s[k] = now_s

    def sure(self, k: int) -> None:
        self.unsure[k], self.suspected[k] = False, 0

    def well(self, k: int) -> None:
        self.unsure[k], self._off_s[k] = False, np.nan

    def still_off(self, k: int, now_s: float) -> None:
        """A contact that drifts is not what it was."""
        if self.known_to_drift(k):
            self._off_s[k] = now_s

    def known_to_drift(self, k: int) -> bool:
        return bool(np.isfinite(self._off_s[k]))

    def moves(self, k: int, now_s: float) -> bool:
        """Whether a contact that drifts was off a moment ago: on its way it passes by its old value."""
        return bool(0 <= now_s - self._off_s[k] < STILL_S)  # False for NaN

    def may_ask(self, k: int) -> bool:
        """Whether it is time to ask the evidence; counts the frames."""
        if self._asked[k] > 0:
            self._asked[k] -= 1
            return False
        return True

    def asked(self, k: int) -> None:
        self._asked[k] = ASK_EVERY - 1

    def state(self) -> dict[str, Any]:
        return {
            "unsure": self.unsure.astype(np.uint8),
            "suspected": self.suspected.copy(),
            "asked": self._asked.copy(),
            "open": self._open.copy(),
            "off_s": self._off_s.copy(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings lack some. Raises ValueError where it does not fit."""
        self.reset()
        if "unsure" not in state:
            return
        shape = (self._electrodes,)
        self.unsure = shaped(state["unsure"], shape) > 0
        self.suspected = shaped(state["suspected"], shape).astype(np.int64)
        self._asked = shaped(state.get("asked", self._asked), shape).astype(np.int64)
        self._open = shaped(state.get("open", self._open), shape).astype(np.int64)
        self._off_s = shaped(state.get("off_s", self._off_s), shape, finite=False)
