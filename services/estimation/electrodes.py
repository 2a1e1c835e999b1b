"""Electrode health from the frames: which measurements count, which electrodes are at fault, and what to do about it.

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
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA
from services.estimation.advice import (
    ADVICE,
    DRIFTING,
    NO_ANSWER,
    OK,
    OPEN,
    REASONS,
    SHORT,
    STUCK,
    SWAPPED,
    UNKNOWN,
    listed,
    stuck_bit,
)
from services.estimation.contact_drift import ChangedContacts, Reference
from services.estimation.gain_steps import GainStep
from services.estimation.saved import shaped
from services.estimation.wiring import Exchanged, StuckBit, Wiring

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

QUIET = 5.0  # standard deviations within which a measurement is what it was
FAR = 10.0  # |Z| beyond this multiple of the baseline, or below its inverse, is no touch
MOSTLY = 0.8  # fraction of an electrode's measurements that must have failed for the electrode to be named
NOTHING_ANSWERS = 0.7  # fraction of all measurements that failed where it is not the electrodes
TOO_MANY = 2  # electrodes at fault with which contacts can still be given
WELL_FRAMES = 3  # in a row, after which an electrode counts again
UNDONE = 3.0  # of the untouched |Z|, beyond which a measurement that clips is of an electrode off the skin
LASTING = 23  # frames in a row after which it is, where few touches look so
SUSPECTED = 3  # frames in a row after which a change that may be a touch on the electrode is the contact's
WELL = 0.0015  # relative: how near its baseline a measurement of a well electrode is, and within 6 sigma more
FALLS = 0.03  # relative fall that no touch, warmth or noise makes: the wiring is looked at
FALLS_UNTARED = 0.06  # against the bundle's prediction, contacts unknown


@dataclass
class Verdict:
    """On one frame, its measurements in `order`. live (K,): counts; failed (K,): no value for a baseline either; states
    (E,): ELECTRODE_STATES.
    """

    live: Mask
    failed: Mask
    states: NDArray[np.uint8]
    reasons: list[str]
    usable: bool  # whether contacts can be given
    order: NDArray[np.intp] | None  # (K,) of which measurements the values are, where wires are exchanged; else None
    shift: Array  # (K,) of |Z|: what a changed contact does to pairs of other electrodes; not pressing's


@dataclass
class _Look:
    """What one frame shows by itself; measurements in `order` (None: as they came)."""

    states: NDArray[np.uint8]  # (E,)
    amplitude: Array  # (K,)
    failed: Mask  # (K,)
    order: NDArray[np.intp] | None = None
    fault: str = ""  # of the board as a whole
    likely: bool = False  # that few touches look so
    suspect: int | None = None  # an electrode whose contact changed, if nobody presses right on it


class ElectrodeHealth:
    """For one bundle: K measurements between E electrodes. Keeps which are at fault."""

    def __init__(self, bundle: Bundle) -> None:
        pattern = np.asarray(bundle.pattern)
        self.electrodes = int(pattern.max()) + 1
        self.member = np.zeros((self.electrodes, len(pattern)), dtype=bool)  # (E, K) measurement uses electrode
        for column in range(pattern.shape[1]):
            self.member[pattern[:, column], np.arange(len(pattern))] = True
        # A measurement between the two electrodes that it drives sees nothing but a short between them.
        self.self_sensing = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
        self._pattern = pattern
        self._predicted = np.asarray(bundle.z0, dtype=float) if bundle.matrices.normalisation == "model" else None
        self._wiring = Wiring(pattern)
        self._contacts = ChangedContacts(bundle, self.member)
        k, n = len(pattern), self.electrodes
        self._all_well = Verdict(np.ones(k, bool), np.zeros(k, bool), np.zeros(n, "u1"), [], True, None, np.zeros(k))
        for array in (v for v in vars(self._all_well).values() if isinstance(v, np.ndarray)):
            array.setflags(write=False)  # it is given out again and again
        self.reset()

    def reset(self) -> None:
        self._states = np.zeros(self.electrodes, dtype=np.uint8)
        self._well = np.zeros(self.electrodes, dtype=np.int64)  # frames in a row
        self._unsure = np.zeros(self.electrodes, dtype=bool)  # drifting, unless somebody presses right on it
        self._suspected = np.zeros(self.electrodes, dtype=np.int64)  # frames in a row
        self._shown = self._states
        self._fault = ""  # of the board as a whole
        self._contacts.reset()

    def tared(self) -> None:
        """There is a new baseline: what changed against the old one is forgotten."""
        self._states[(self._states == DRIFTING) | (self._states == UNKNOWN)] = OK
        self._unsure[:], self._suspected[:] = False, 0
        self._contacts.keep(())

    def rescale(self, step: GainStep) -> None:
        """The baseline took this step of the board's gain over."""
        self._contacts.rescale(step.factor)
        if step.lasted:
            self._contacts.forget_past()

    def __call__(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference | None) -> Verdict:
        """(K,) |Z| and status bits of a frame."""
        found = self._judge(amplitude, status, untouched)
        self._contacts.follow(amplitude if found.order is None else amplitude[found.order])
        return found

    def _judge(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference | None) -> Verdict:
        if untouched is not None and self._unchanged(amplitude, status, untouched):
            return self._all_well
        trouble = (status & (STATUS_OPEN | STATUS_RTIA | STATUS_FIFO | STATUS_CLIPPED)) != 0
        failed = ~np.isfinite(amplitude) | (amplitude <= 0) | trouble
        seen = self._look(amplitude, status, failed, self._reference(amplitude, failed, untouched), untouched)
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
        reasons = ["saturated"] if (status & STATUS_CLIPPED).any() else []
        reasons += [reason for state, reason in REASONS.items() if (states == state).any()]
        bad = int((states != OK).sum())
        doubtful = bool(self._unsure.any() or self._suspected.any())
        if doubtful and "electrode_drift" not in reasons:
            reasons.append("electrode_drift")
        usable = bad <= TOO_MANY and not doubtful and bool(live.sum() >= len(live) / 2)
        if bad == TOO_MANY:
            reasons.append("degraded")
        if not usable and not reasons:
            reasons.append("out_of_distribution")
        return Verdict(live, seen.failed | wrong, states, reasons, usable, seen.order, self._shift(seen, untouched))

    def _unchanged(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference) -> bool:
        """Whether a frame without a mark differs from the untouched skin by its noise alone, and nothing was at fault:
        most frames of a skin, and a tenth of the work.
        """
        if status.any() or self._states.any() or self._contacts.felt:
            return False
        with np.errstate(invalid="ignore"):  # what is not finite has changed, also where the baseline knows nothing
            noise = QUIET * untouched.sigma * untouched.normaliser
            quiet = np.abs(amplitude - untouched.z0) <= noise
        self._fault, self._shown = "", self._all_well.states
        return bool(quiet.all() and np.isfinite(noise).all())

    def _nothing_wrong(self, seen: _Look, status: NDArray[np.uint8], untouched: Reference) -> bool:
        """Most touched frames: what follows would find that all is well too, at twice the work."""
        wrong = seen.states.any() or status.any() or seen.failed.any() or self._states.any() or self._suspected.any()
        quiet = seen.suspect is None and not wrong
        return quiet and not self._contacts.felt and bool(np.isfinite(untouched.sigma).all())

    def problems(self) -> list[str]:
        """For a person: which electrodes, and what to do."""
        if self._fault:
            return [self._fault]
        found = []
        for state, text in ADVICE.items():
            named = np.flatnonzero(self._shown == state).tolist()
            if named:
                found.append(text.format(listed(named)) + " (electrodes are numbered from 0)")
        return found

    # one frame

    def _look(
        self,
        amplitude: Array,
        status: NDArray[np.uint8],
        failed: Mask,
        reference: Array | None,
        untouched: Reference | None,
    ) -> _Look:
        """What this frame shows."""
        states = np.zeros(self.electrodes, dtype=np.uint8)
        no_current = ((status & STATUS_OPEN) != 0) | (failed & (status == 0))
        low = np.zeros_like(failed)
        if reference is not None:
            known = ~failed & (reference > 0)
            low = known & (amplitude < reference / FAR)
            no_current |= known & (amplitude > FAR * reference)
            clipped = (status & STATUS_CLIPPED) != 0
            no_current |= clipped & np.isfinite(amplitude) & (amplitude > UNDONE * reference) & (reference > 0)
        failed = failed | low | no_current
        seen = _Look(states, amplitude, failed)
        if (low | no_current).mean() > NOTHING_ANSWERS:
            states[:] = STUCK
            seen.fault = NO_ANSWER
            return seen
        shorted = self._short(low & self.self_sensing)
        if reference is not None and self._predicted is not None and not shorted:
            fault = self._miswired(amplitude, failed, low, reference, untouched)
            if isinstance(fault, StuckBit):
                states[fault.electrodes] = STUCK
                seen.fault = stuck_bit(fault)
                return seen
            if isinstance(fault, Exchanged):
                states[fault.electrodes] = SWAPPED
                if untouched is None:  # nothing tells whether putting them right is right
                    return seen
                order = seen.order = self._wiring.order(fault)
                seen.amplitude, seen.failed = amplitude[order], failed[order]
                low, no_current = low[order], no_current[order]
        states[shorted] = SHORT
        self._open(seen.failed & (low | no_current), seen.failed, states)
        if untouched is not None and not np.isin(states, (SHORT, OPEN)).any():
            well = (self._states == OK) | self._unsure | ((self._states == SWAPPED) & (states == SWAPPED))
            live = ~seen.failed & np.isfinite(untouched.sigma) & ~self.member[~well].any(axis=0)
            changed = self._contacts.changed(seen.amplitude, untouched, live)
            if changed is not None and states[changed.electrode] == OK:
                if changed.sure:
                    states[changed.electrode] = DRIFTING
                else:
                    seen.suspect, seen.likely = changed.electrode, changed.likely
        return seen

    def _short(self, low: Mask) -> list[int]:
        """Electrodes all joined to each other, by their pairs that measure next to nothing."""
        if not low.any():
            return []
        joined = sorted(set(self._pattern[low, :2].ravel().tolist()))
        if low.sum() < len(joined) * (len(joined) - 1) / 2:
            return []  # not each of them with each other: that is no short
        return joined

    def _miswired(
        self, amplitude: Array, failed: Mask, low: Mask, reference: Array, untouched: Reference | None
    ) -> Exchanged | StuckBit | None:
        """Wires exchanged or a multiplexer stuck, where something fell as no touch lets it fall."""
        known = ~failed & (reference > 0)
        noise = 6 * untouched.sigma if untouched else np.zeros(len(amplitude))
        limit = FALLS if untouched else FALLS_UNTARED
        fell = known & (amplitude < (1 - limit) * reference - np.where(known, noise, 0.0) * reference)
        if fell.sum() < 2 and low.sum() < 2:
            return None
        return self._wiring(np.where(failed & ~low, np.nan, amplitude), reference)

    def _open(self, left: Mask, failed: Mask, states: NDArray[np.uint8]) -> None:
        """Sets `states`: the electrode that explains most failures first; its measurements do not count against the
        others.
        """
        gone = self.member[states != OK].any(axis=0)
        left = left & ~gone
        while left.any():
            whole = (self.member & (left | ~failed) & ~gone).sum(axis=1)
            share = (self.member & left).sum(axis=1) / np.maximum(1, whole)
            worst = int(share.argmax())
            if share[worst] < MOSTLY or (self.member[worst] & left).sum() < 2:
                return
            states[worst] = OPEN
            gone |= self.member[worst]
            left &= ~gone

    # over time

    def _remember(self, seen: _Look, untouched: Reference | None) -> None:
        """Faults at once, recovery after WELL_FRAMES."""
        faulty = seen.states != OK
        self._states[faulty] = seen.states[faulty]
        self._well[faulty] = 0
        self._unsure &= (self._states == DRIFTING) & ~faulty
        again = np.arange(self.electrodes) == seen.suspect
        self._suspected = np.where(again, self._suspected + 1, 0)
        lasts = (self._suspected >= SUSPECTED) & (self._states == OK)
        self._states[lasts], self._unsure[lasts] = DRIFTING, True
        self._suspected[(self._states != OK) & ~self._unsure] = 0
        if seen.likely:
            self._unsure &= self._suspected < LASTING
        ailing = (self._states != OK) & ~faulty & ~lasts
        for k in np.flatnonzero(ailing):
            self._well[k] = self._well[k] + 1 if self._is_well(int(k), seen.amplitude, seen.failed, untouched) else 0
            if self._well[k] >= WELL_FRAMES:
                self._states[k], self._unsure[k] = OK, False
                self._contacts.forget(int(k))

    def _is_well(self, k: int, amplitude: Array, failed: Mask, untouched: Reference | None) -> bool:
        """An open wire or a short is seen directly; the others must measure what they did before, untouched."""
        if self._states[k] not in (DRIFTING, SWAPPED) or untouched is None:
            return True
        rows = self.member[k] & ~failed & np.isfinite(untouched.sigma)
        if not rows.any():
            return True
        within = WELL + 6 * untouched.sigma[rows]
        for since in (untouched.z0, self._contacts.before(k)):
            if since is not None:
                off = np.abs(amplitude[rows] - since[rows]) / untouched.normaliser[rows]
                if (off <= within).mean() >= MOSTLY:
                    return True
        return False

    def _shift(self, seen: _Look, untouched: Reference | None) -> Array:
        """What the drifting electrodes do to the pairs of the others."""
        drifting = np.flatnonzero(np.isin(self._states, (DRIFTING, OPEN))).tolist()
        self._contacts.keep(drifting)
        if untouched is None or not drifting:
            return np.zeros(len(seen.amplitude))
        return self._contacts.shift(drifting, seen.amplitude, untouched, ~seen.failed & np.isfinite(untouched.sigma))

    def _reference(self, amplitude: Array, failed: Mask, untouched: Reference | None) -> Array | None:
        """|Z| that a well, untouched skin has: its baseline, else the bundle's prediction times the frame's gain."""
        if self._predicted is None:
            return None if untouched is None else untouched.z0
        if untouched is not None:
            lost = ~(untouched.z0 > 0)
            gain = untouched.normaliser / self._predicted
            return np.where(lost, self._predicted * np.where(np.isfinite(gain), gain, 1.0), untouched.z0)
        if failed.all():
            return self._predicted
        return np.asarray(self._predicted * np.median(amplitude[~failed] / self._predicted[~failed]))

    # state

    def state(self) -> dict[str, Any]:
        return {
            "states": self._states.copy(),
            "well": self._well.copy(),
            "unsure": self._unsure.astype(np.uint8),
            "suspected": self._suspected.copy(),
            **self._contacts.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises ValueError where it is of other electrodes."""
        states, well = np.array(state["states"], dtype=np.uint8), np.array(state["well"], dtype=np.int64)
        if states.shape != self._states.shape or well.shape != self._well.shape:
            raise ValueError(f"the saved health is of {states.size} electrodes, expected {self.electrodes}")
        self.reset()
        self._states, self._well = states, well
        if "unsure" in state:  # older recordings have neither
            self._unsure = shaped(state["unsure"], states.shape) > 0
            self._suspected = shaped(state["suspected"], states.shape).astype(np.int64)
        self._contacts.load(state)
