"""Contacts that changed, over the frames: against the untouched skin, against the frames before, and by their pace."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.contact_drift import Changed, ContactDrift, Reference
from services.estimation.saved import shaped
from services.estimation.steady_change import PastFrames

Array = NDArray[np.floating]

LOOK_BACK = 3  # frames over which a contact that rises under a touch is told from it
LOOK_FAR_BACK = 24  # the same, where it rises slowly
ALIKE = 0.3  # of what is felt: two frames that differ by less say the same
BACK = 2  # frames over which a contact jumps
NEAR = 0.25  # model units from a touch that began, within which an electrode may seem to have jumped by it
JUMP = 3.0  # times the change of the frames before, from which one comes at once


class ChangedContacts:
    """ChangedContacts keeps which contacts changed, and what they do to pairs of other electrodes; members (E, K)."""

    def __init__(self, bundle: Bundle, members: NDArray[np.bool_]) -> None:
        self._drift, self._k = ContactDrift(bundle, members), members.shape[1]
        self._centre = np.asarray(bundle.skin["electrodes"]["centre"], dtype=float)  # (E, 2) model units
        self.reset()

    @property
    def knows(self) -> bool:
        """Whether the bundle predicts what a contact does."""
        return self._drift.knows

    def reset(self) -> None:
        self.felt: dict[int, Array] = {}  # by changed contact: (K,) relative, on pairs of other electrodes
        self._proposed: dict[int, Array] = {}  # the same, as the evidence of the last frame that was asked has it
        self._before: dict[int, Array] = {}  # by contact that rose under a touch: |Z| (K,) from before
        self._past: deque[Array] = deque(maxlen=LOOK_FAR_BACK)  # |Z| (K,) of the frames before, the newest last
        self._second = PastFrames(self._k)
        self._onset: tuple[float, float] | None = None  # where a touch began that no contact's change explains
        self._onset_frames = 0  # to come that are compared with one from before it

    def touch_began(self, at: tuple[float, float] | None) -> None:
        """The next frame is the first one of a touch at (x, y) [model units] that no contact's change explains: others
        told so. None: there is none such.
        """
        self._onset, self._onset_frames = at, 0 if at is None else BACK

    def follow(self, amplitude: Array, now_s: float) -> None:
        """Takes a frame's |Z| (K,), measured at now_s, after it was judged."""
        self._past.append(amplitude.copy())
        self._onset_frames = max(0, self._onset_frames - 1)
        self._second.follow(amplitude, now_s)

    def drifts(self, k: int, amplitude: Array, now_s: float, untouched: Reference, live: NDArray[np.bool_]) -> bool:
        """Returns whether the contact of electrode k has changed steadily for a while, and nothing else has."""
        found = self._second.drifts(self._drift.form(k), amplitude, now_s, untouched, live)
        if found:
            self._before.pop(k, None)  # it was not well then either
        return found

    def rescale(self, factor: float) -> None:
        """Multiplies all |Z| so far by this factor."""
        self._before = {k: row * factor for k, row in self._before.items()}
        self._past = deque((row * factor for row in self._past), maxlen=LOOK_FAR_BACK)
        self._second.rescale(factor)

    def forget_past(self) -> None:
        """The frames so far say nothing of those to come: some had another gain."""
        self._past.clear()
        self._second.clear()

    def changed(self, amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the electrode whose contact this frame shows to have changed."""
        found = self._drift(_difference(amplitude, untouched.z0, untouched, live), untouched.sigma, live)
        if found is not None or len(self._past) < LOOK_BACK:
            return found
        # Under a touch that stays, what changed is the contact's.
        sigma = np.sqrt(2.0) * untouched.sigma
        for past in (*self._before.values(), self._past[-LOOK_BACK], self._past[0]):
            both = live & np.isfinite(past)
            found = self._drift.risen(_difference(amplitude, past, untouched, both), sigma, both)
            if found is not None:
                self._before.setdefault(found.electrode, past)
                return found
        found = self._changed_under_motion(amplitude, untouched, live)
        if found is not None:
            return found
        return self._jumped(amplitude, untouched, live)

    def _jumped(self, amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the electrode whose contact may have jumped while something else moved: a touch that moves onto an
        electrode changes each frame by as much as the one before. BACK frames, since it may jump within a scan.
        """
        if len(self._past) < 2 * BACK:
            return None
        last, before = self._past[-BACK], self._past[-2 * BACK]
        live = live & np.isfinite(last) & np.isfinite(before)
        d, usual = _difference(amplitude, last, untouched, live), _difference(last, before, untouched, live)
        if float(d[live] @ d[live]) < JUMP**2 * float(usual[live] @ usual[live]):
            return None
        found = self._drift.resembles(d, np.sqrt(2.0) * untouched.sigma, live)
        return None if found is not None and self._pressed(found.electrode) else found

    def _pressed(self, k: int) -> bool:
        """Whether what electrode k seems to have jumped by is the touch that just began on it."""
        if not self._onset_frames or self._onset is None:
            return False
        return bool(np.hypot(*(self._centre[k] - self._onset)) < NEAR)

    def _changed_under_motion(self, amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the same under a touch that moves steadily: the frames before say which change is its own."""
        back = 2 * LOOK_BACK
        if len(self._past) < 2 * back + LOOK_BACK:
            return None
        now, middle, first = (self._past[-LOOK_BACK - k * back] for k in range(3))
        live = live & np.isfinite(now) & np.isfinite(middle) & np.isfinite(first)
        velocity = _difference(now, middle, untouched, live)
        bend = velocity - _difference(middle, first, untouched, live)
        aside, _ = np.linalg.qr(np.column_stack([velocity, bend]))
        d = _difference(amplitude, now, untouched, live)
        found = self._drift.risen(d, np.sqrt(2.0) * untouched.sigma, live, aside)
        if found is None:
            return None
        self._before.setdefault(found.electrode, now)
        return found._replace(sure=False)

    def before(self, k: int) -> Array | None:
        """Returns |Z| (K,) of the touch under which the contact of electrode k rose."""
        return self._before.get(k)

    def propose(self, k: int, felt: Array) -> None:
        """Takes what the evidence of one frame says that electrode k's contact does to other pairs (K,): at once where
        nothing is known, else when two frames in a row say so. In a frame in which a touch begins it says anything.
        """
        last, self._proposed[k] = self._proposed.get(k), felt
        again = last is not None and np.linalg.norm(felt - last) <= ALIKE * np.linalg.norm(felt)
        if again or k not in self.felt:
            self.felt[k] = felt

    def forget(self, k: int) -> None:
        """Drops what is kept of electrode k: its contact is what it was."""
        for kept in (self.felt, self._proposed, self._before):
            kept.pop(k, None)

    def keep(self, drifting: Sequence[int], like: Callable[[int, Array], bool] = lambda k, past: True) -> None:
        """Forgets all others. like: whether the measurements of electrode k are what they were in a past |Z| (K,)."""
        for k in drifting:  # what was wrong at once may have begun under a touch too
            if k not in self._before and len(self._past) >= LOOK_BACK and not like(k, self._past[-LOOK_BACK]):
                self._before[k] = self._past[-LOOK_BACK]  # a contact that drifts slowly was not well then either
        self.felt = {k: felt for k, felt in self.felt.items() if k in drifting}
        self._proposed = {k: felt for k, felt in self._proposed.items() if k in drifting}
        self._before = {k: before for k, before in self._before.items() if k in drifting}

    def shift(self, drifting: Sequence[int], amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Array:
        """Returns (K,) the change of |Z|, followed while nothing else changes: untouched, or under the touch it began
        under.
        """
        for k in drifting:
            for since in (untouched.z0, self._before.get(k)):
                if since is not None:
                    both = live & np.isfinite(since)
                    d = _difference(amplitude, since, untouched, both)
                    felt = self._drift.felt_by_others(k, d, untouched.sigma, both)
                    if felt is not None:
                        self.felt[k] = felt
                        break
        return np.asarray(untouched.normaliser * np.sum([*self.felt.values(), np.zeros(self._k)], axis=0))

    def state(self) -> dict[str, Any]:
        kept = {"felt": self.felt, "proposed": self._proposed, "before": self._before}
        rows = {name: [[k, list(row)] for k, row in of.items()] for name, of in kept.items()}
        return {**rows, "past": np.array(self._past), "second": self._second.state(), "onset": self._onset_state()}

    def _onset_state(self) -> dict[str, Any]:
        return {"at": None if self._onset is None else list(self._onset), "frames": self._onset_frames}

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings lack some. Raises ValueError where it does not fit."""
        self.reset()
        shape = (self._k,)
        self.felt = {int(k): shaped(row, shape) for k, row in state.get("felt", [])}
        self._proposed = {int(k): shaped(row, shape) for k, row in state.get("proposed", [])}
        self._before = {int(k): shaped(row, shape, finite=False) for k, row in state.get("before", [])}
        self._past.extend(shaped(row, shape, finite=False) for row in state.get("past", []))
        onset = state.get("onset", {"at": None, "frames": 0})
        self._onset = None if onset["at"] is None else (float(onset["at"][0]), float(onset["at"][1]))
        self._onset_frames = int(onset["frames"])
        if "second" in state:
            self._second.load(state["second"])


def _difference(amplitude: Array, since: Array, untouched: Reference, live: NDArray[np.bool_]) -> Array:
    change = np.where(live, amplitude - np.where(live, since, 0.0), 0.0)
    return change / untouched.normaliser
