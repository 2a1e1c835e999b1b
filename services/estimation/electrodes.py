"""Electrode health over the frames: which electrodes are at fault, which measurements count, and what a person can do.

A fault is named in the frame that shows it and taken back once the electrode has been well for some frames, so that
neither a loose wire flaps nor the baseline follows a fault: what is at fault has weight zero throughout. Electrodes are
numbered from 0, as on the board's link (protocol/WIRE.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.advice import ADVICE, DRIFTING, OK, OPEN, REASONS, SHORT, SWAPPED, UNKNOWN, listed
from services.estimation.changed_contacts import ChangedContacts
from services.estimation.contact_doubts import ContactDoubts
from services.estimation.contact_drift import Reference
from services.estimation.contact_evidence import ContactEvidence, ContactOpinion
from services.estimation.coverage import Coverage
from services.estimation.frame_check import MOSTLY, FrameCheck, FrameFindings
from services.estimation.gain_steps import GainStep
from services.estimation.status_bits import reasons_of

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

QUIET = 5.0  # standard deviations within which a measurement is what it was
TOO_MANY = 2  # electrodes at fault with which contacts can still be given
WELL_FRAMES = 3  # in a row, after which an electrode counts again
WELL = 0.0015  # relative: how near its baseline a measurement of a well electrode is, and within 6 sigma more
WELL_AGAIN = 0.0005  # the same, where the contact drifted: it passes by its old value on its way


@dataclass
class ElectrodeVerdict:
    """The verdict on one frame, its measurements in `order`. live (K,): counts; failed (K,): no value for a baseline
    either; states (E,): ELECTRODE_STATES.
    """

    live: Mask
    failed: Mask
    states: NDArray[np.uint8]
    reasons: list[str]
    usable: bool  # whether contacts can be given
    order: NDArray[np.intp] | None  # (K,) of which measurements the values are, where wires are exchanged; else None
    shift: Array  # (K,) of |Z|: what a changed contact does to pairs of other electrodes; not pressing's


class ElectrodeHealth:
    """ElectrodeHealth keeps which of a bundle's E electrodes are at fault; K measurements."""

    def __init__(self, bundle: Bundle) -> None:
        self.check = FrameCheck(bundle)
        self.electrodes, self.member = self.check.electrodes, self.check.member
        self._contacts = ChangedContacts(bundle, self.member)
        self._bundle = bundle
        self._doubts = ContactDoubts(self.electrodes)
        self._evidence: ContactEvidence | None = None  # made when it is first asked
        self._coverage: Coverage | None = None
        k, n = len(bundle.pattern), self.electrodes
        self._all_well = ElectrodeVerdict(
            np.ones(k, bool), np.zeros(k, bool), np.zeros(n, "u1"), [], True, None, np.zeros(k)
        )
        for array in (v for v in vars(self._all_well).values() if isinstance(v, np.ndarray)):
            array.setflags(write=False)  # it is given out again and again
        self.reset()

    def reset(self) -> None:
        self._states = np.zeros(self.electrodes, dtype=np.uint8)
        self._well = np.zeros(self.electrodes, dtype=np.int64)  # frames in a row
        self._shown = self._states
        self._fault = ""  # of the board as a whole
        self._now_s = 0.0
        self._doubts.reset()
        self._contacts.reset()

    def tared(self) -> None:
        """Takes note of a new baseline: what changed against the old one is forgotten."""
        self._states[(self._states == DRIFTING) | (self._states == UNKNOWN)] = OK
        self._doubts.reset()
        self._contacts.keep(())
        self._contacts.touch_began(None)

    def touch_began(self, at: tuple[float, float]) -> None:
        """The next frame is the first one of a touch at (x, y) [model units] that no contact's change explains, as its
        parts told.
        """
        self._contacts.touch_began(at)

    def rescale(self, step: GainStep) -> None:
        """The baseline took this step of the board's gain over."""
        self._contacts.rescale(step.factor)
        if step.lasted:
            self._contacts.forget_past()

    def __call__(
        self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference | None, now_s: float = 0.0
    ) -> ElectrodeVerdict:
        """Judges a frame: (K,) |Z| and status bits. now_s: when it was measured; 0 where nobody says."""
        self._now_s = now_s
        found = self._judge(amplitude, status, untouched)
        self._contacts.follow(amplitude if found.order is None else amplitude[found.order], now_s)
        return found

    def _judge(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference | None) -> ElectrodeVerdict:
        if untouched is not None and self._unchanged(amplitude, status, untouched):
            return self._all_well
        seen = self.check(amplitude, status, untouched)
        self._contact_changes(seen, untouched)
        self._fault = seen.fault
        if untouched is not None and self._nothing_wrong(seen, status, untouched):
            self._shown = self._all_well.states
            return self._all_well
        self._remember(seen, untouched)
        known = np.isfinite(untouched.sigma) if untouched else np.ones(len(amplitude), dtype=bool)
        states = self._states.copy()
        lost = (self.member & ~known).sum(axis=1) >= MOSTLY * self.member.sum(axis=1)
        states[(states == OK) & lost] = UNKNOWN
        self._shown = states
        out = (states != OK) & (states != UNKNOWN)
        if seen.order is not None:  # what exchanged wires measure is that of each other
            out &= states != SWAPPED
        at_fault = self.member[out].any(axis=0)
        wrong = self.member[out & (states != DRIFTING)].any(axis=0)
        live = ~seen.failed & ~at_fault & known
        reasons = [reason for state, reason in REASONS.items() if (states == state).any()]
        bad = int((states != OK).sum())
        doubtful = bool(self._doubts)
        if doubtful and "electrode_drift" not in reasons:
            reasons.append("electrode_drift")
        enough = bool(live.sum() >= len(live) / 2) and self._sees_enough(seen, live, ~at_fault & known, untouched)
        usable = bad <= TOO_MANY and not doubtful and enough
        if bad == TOO_MANY:
            reasons.append("degraded")
        if not usable and not reasons and not reasons_of(status):
            reasons.append("out_of_distribution")
        return ElectrodeVerdict(
            live, seen.failed | wrong, states, reasons, usable, seen.order, self._shift(seen, untouched)
        )

    def _sees_enough(self, seen: FrameFindings, live: Mask, all_of: Mask, untouched: Reference | None) -> bool:
        """Returns whether measurements that only this frame lacks leave enough of the skin in sight."""
        if untouched is None or live.sum() == all_of.sum():
            return True
        self._coverage = self._coverage or Coverage(self._bundle)
        d = np.where(live, seen.amplitude - untouched.z0, 0.0) / untouched.normaliser
        return self._coverage.enough(d, live, all_of)

    def _unchanged(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference) -> bool:
        """Returns whether a frame without a mark differs from the untouched skin by its noise alone, and nothing was at
        fault: most frames of a skin, and a tenth of the work.
        """
        if status.any() or self._states.any() or self._contacts.felt:
            return False
        with np.errstate(invalid="ignore"):  # what is not finite has changed, also where the baseline knows nothing
            noise = QUIET * untouched.sigma * untouched.normaliser
            quiet = np.abs(amplitude - untouched.z0) <= noise
        self._fault, self._shown = "", self._all_well.states
        return bool(quiet.all() and np.isfinite(noise).all())

    def _nothing_wrong(self, seen: FrameFindings, status: NDArray[np.uint8], untouched: Reference) -> bool:
        """Returns whether nothing is wrong, as in most touched frames: what follows would find the same at twice the
        work.
        """
        wrong = seen.states.any() or status.any() or seen.failed.any() or self._states.any() or self._doubts.asks
        quiet = seen.suspect is None and not wrong
        return quiet and not self._contacts.felt and bool(np.isfinite(untouched.sigma).all())

    def problems(self) -> list[str]:
        """Says to a person which electrodes are at fault, and what to do."""
        if self._fault:
            return [self._fault]
        found = []
        for state, text in ADVICE.items():
            named = np.flatnonzero(self._shown == state).tolist()
            if named:
                found.append(text.format(listed(named)) + " (electrodes are numbered from 0)")
        return found

    # over time

    def _contact_changes(self, seen: FrameFindings, untouched: Reference | None) -> None:
        """Adds to what a frame shows an electrode whose contact changed."""
        if untouched is None or seen.fault or np.isin(seen.states, (SHORT, OPEN)).any():
            return
        well = (self._states == OK) | self._doubts.unsure | ((self._states == SWAPPED) & (seen.states == SWAPPED))
        changed = self._contacts.changed(seen.amplitude, untouched, self._live(seen, untouched, well))
        if changed is not None and seen.states[changed.electrode] == OK:
            if changed.sure:
                seen.states[changed.electrode] = DRIFTING
            else:
                seen.suspect = changed.electrode

    def _live(self, seen: FrameFindings, untouched: Reference, counts: Mask) -> Mask:
        """Returns (K,) which measurements are between electrodes that count."""
        return ~seen.failed & np.isfinite(untouched.sigma) & ~self.member[~counts].any(axis=0)

    def _live_with(self, k: int, seen: FrameFindings, untouched: Reference) -> Mask:
        """Returns (K,) which measurements are between electrode k and those that are well."""
        return self._live(seen, untouched, (self._states == OK) | (np.arange(self.electrodes) == k))

    def _remember(self, seen: FrameFindings, untouched: Reference | None) -> None:
        """Takes faults over at once, recovery after WELL_FRAMES."""
        faulty = seen.states != OK
        self._states[faulty] = seen.states[faulty]
        self._well[faulty] = 0
        doubts = self._doubts
        doubts.named(faulty, self._states, self._now_s)
        for k in doubts.passed(seen.suspect, self._states):
            self._no_longer_suspected(int(k), seen, untouched)
        self._states[doubts.suspect(seen.suspect, self._states)] = DRIFTING
        for k in np.flatnonzero(doubts.unsure | (doubts.suspected > 0)):
            if untouched is None:
                break
            live = self._live_with(int(k), seen, untouched)
            if self._contacts.drifts(int(k), seen.amplitude, self._now_s, untouched, live):
                self._states[k], self._well[k] = DRIFTING, 0
                doubts.drifts(int(k), self._now_s)
        for k in np.flatnonzero((self._states != OK) & ~faulty):
            self._look_again(int(k), seen, untouched)

    def _no_longer_suspected(self, k: int, seen: FrameFindings, untouched: Reference | None) -> None:
        """Asks whether the contact of electrode k changed at once and stays so: then no frame differs from the few
        before by it any more. Once, where contact and touches explain the frame: they do not while a touch comes.
        """
        opinion = None if untouched is None else self._ask(k, seen, untouched)
        if opinion is None or opinion.fits:
            self._doubts.answered(k)
        if opinion is not None and (opinion.changed() or opinion.jumped):
            self._states[k], self._well[k] = DRIFTING, 0
            self._doubts.asked(k)
            self._contacts.propose(k, opinion.felt)

    def _look_again(self, k: int, seen: FrameFindings, untouched: Reference | None) -> None:
        """Looks at an electrode at fault whose fault this frame does not show by itself."""
        if self._is_well(k, seen.amplitude, seen.failed, untouched):
            self._well[k] += 1
        elif self._states[k] not in (DRIFTING, SWAPPED) or untouched is None:
            self._well[k] = 0
        elif self._doubts.may_ask(k) and (opinion := self._ask(k, seen, untouched)) is not None:
            self._doubts.asked(k)
            self._well[k] = self._well[k] + 1 if opinion.well else 0
            if not opinion.well:
                self._doubts.still_off(k, self._now_s)
            drifts = self._doubts.known_to_drift(k)
            if self._states[k] == DRIFTING and (opinion.changed() or (drifts and opinion.elsewhere)):
                self._doubts.sure(k)
                if opinion.fits:
                    self._contacts.propose(k, opinion.felt)
        if self._well[k] >= WELL_FRAMES and not self._doubts.moves(k, self._now_s):
            self._states[k] = OK
            self._doubts.well(k)
            self._contacts.forget(k)

    def _ask(self, k: int, seen: FrameFindings, untouched: Reference) -> ContactOpinion | None:
        """Asks whether the contact of electrode k is changed, whatever touches; None where nothing tells."""
        live = self._live_with(k, seen, untouched)
        if not self._contacts.knows or live.sum() < len(live) / 2 or not live[self.member[k]].any():
            return None
        self._evidence = self._evidence or ContactEvidence(self._bundle)
        d = np.where(live, seen.amplitude - untouched.z0, 0.0) / untouched.normaliser
        return self._evidence(k, np.asarray(d, dtype=float), np.asarray(untouched.sigma, dtype=float), live)

    def _is_well(self, k: int, amplitude: Array, failed: Mask, untouched: Reference | None) -> bool:
        """Returns whether electrode k is well. An open wire or a short is seen directly; the others must measure what
        they did before.
        """
        if self._states[k] not in (DRIFTING, SWAPPED) or untouched is None:
            return True
        return any(
            since is not None and self._like(k, amplitude, since, failed, untouched)
            for since in (untouched.z0, self._contacts.before(k))
        )

    def _like(self, k: int, amplitude: Array, since: Array, failed: Mask, untouched: Reference) -> bool:
        """Whether the measurements of electrode k are what they were, or none of them tells."""
        rows = self.member[k] & ~failed & np.isfinite(untouched.sigma)
        if not rows.any():
            return True
        off = np.abs(amplitude[rows] - since[rows]) / untouched.normaliser[rows]
        near = WELL_AGAIN if self._doubts.known_to_drift(k) else WELL
        return bool((off <= near + 6 * untouched.sigma[rows]).mean() >= MOSTLY)

    def _shift(self, seen: FrameFindings, untouched: Reference | None) -> Array:
        """Returns (K,) what the drifting electrodes do to the pairs of the others."""
        drifting = np.flatnonzero(np.isin(self._states, (DRIFTING, OPEN))).tolist()
        if untouched is None or not drifting:
            self._contacts.keep(drifting)
            return np.zeros(len(seen.amplitude))

        def like(k: int, past: Array) -> bool:
            if self._doubts.known_to_drift(k):  # a contact that drifts was not well a few frames ago either
                return True
            tells = bool((self.member[k] & ~seen.failed).any())
            return tells and self._like(k, seen.amplitude, past, seen.failed, untouched)

        self._contacts.keep(drifting, like)
        return self._contacts.shift(drifting, seen.amplitude, untouched, ~seen.failed & np.isfinite(untouched.sigma))

    # state

    def state(self) -> dict[str, Any]:
        return {
            "states": self._states.copy(),
            "well": self._well.copy(),
            **self._doubts.state(),
            **self._contacts.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises ValueError where it is of other electrodes."""
        states, well = np.array(state["states"], dtype=np.uint8), np.array(state["well"], dtype=np.int64)
        if states.shape != self._states.shape or well.shape != self._well.shape:
            raise ValueError(f"the saved health is of {states.size} electrodes, expected {self.electrodes}")
        self.reset()
        self._states, self._well = states, well
        self._doubts.load(state)
        self._contacts.load(state)
