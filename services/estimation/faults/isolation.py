"""The order in which a scan is asked about the board: its wires, what touches, contact impedances and gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from models.measurement.course import TouchCourse
from models.measurement.covariance.noise import NoiseModel
from models.measurement.fit import LEAST_MEAN
from models.measurement.responses.tables import SkinTables
from models.measurement.touch import TouchPrior
from services.estimation.faults.board import BoardFaults, BoardView, Explanation, PredictedScan, standing_covariance
from services.estimation.faults.contact_or_touch import ContactOrTouchTest
from services.estimation.faults.wires import WireFault
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, ScoredAnswer, begun_as
from services.estimation.touches import TouchTracks
from services.estimation.values import numbers as n

Array = NDArray[np.float64]
MakeInnovation = Callable[[Hypotheses, BoardView, Array], Innovation]
Selecting = Callable[[Hypotheses, Innovation], ScoredAnswer]
Recounting = Callable[[Hypotheses, Innovation, ScoredAnswer], ScoredAnswer]


class FaultIsolation:
    """Which fault of the board, if any, explains a scan better than touches alone."""

    def __init__(
        self, tables: SkinTables, noise: NoiseModel, touches: TouchTracks, hypotheses: Hypotheses, faults: BoardFaults
    ) -> None:
        self._tables, self._noise, self._touches = tables, noise, touches
        self._hypotheses, self._faults = hypotheses, faults
        self._contact_or_touch = ContactOrTouchTest(tables, hypotheses, faults)
        self._through: tuple[WireFault, Hypotheses] | None = None

    def __call__(
        self, at: PredictedScan, innovation_of: MakeInnovation, selecting: Selecting, recounting: Recounting
    ) -> Explanation:
        """innovation_of: of hypotheses, a view and a covariance; selecting: the likeliest touches of an innovation;
        recounting: rather others than those of an answer.
        """
        faults = self._faults
        skin, own = self._covariances(at)
        standing = self._touches.expected(at)

        def rewired(view: BoardView) -> bool:
            if not faults.suspects_wires(view):
                return False
            touched, _ = self._standing_change(standing, at)
            return faults.wires_changed(view, touched, skin + self._hypotheses.inflated_drift(), own)

        def asked(view: BoardView) -> Explanation:
            hypotheses = self._through_wires(view)
            innovation = innovation_of(hypotheses, view, view.covariance(skin, own))
            return Explanation(view, innovation, recounting(hypotheses, innovation, selecting(hypotheses, innovation)))

        before = faults.now.wire, faults.now.wire_since_s
        view = faults.look(at)
        if faults.now.wire is None and rewired(view):
            view = faults.look(at)
        found = asked(view)
        odd = _doubtful(found.answer) or -1 in found.answer.association
        if faults.now.wire is not None and odd and rewired(view):
            found = asked(faults.look(at))
        if faults.now.opens and faults.now.wire is None and (odd or (at.whole and self._touches.in_doubt)):
            found = self._lifted(found, lambda: asked(faults.look(at)))
        if faults.asks(found.answer):
            found = self._faulty(found, at, *self._standing_change(standing, at), selecting)
        if not found.answer.nearly_holds:  # what does not explain its scan would stand beside any touch in the next one
            faults.now.wire, faults.now.wire_since_s = before
        return self._doubted(found, at)

    def _lifted(self, found: Explanation, ask: Callable[[], Explanation]) -> Explanation:
        """Electrodes that are open may be off the skin, or on it and cut off: whichever explains the scan better. A
        touch that has just come is not known well enough to decide by little: the scans that follow ask again.
        """
        now = self._faults.now
        before, now.lifted = now.lifted, () if now.lifted else now.opens
        other = ask()
        sure = n.WIRE_SURE if -1 in found.answer.association else n.FAULT_SURE
        if (other.answer.holds, other.answer.score) > (found.answer.holds, found.answer.score + sure):
            return other
        now.lifted = before
        return found

    def _faulty(
        self, found: Explanation, at: PredictedScan, touched: Array, nearby: Array, selecting: Selecting
    ) -> Explanation:
        hypotheses, fit = self._through_wires(found.view), found.answer.fit
        likely = () if fit is None else begun_as(fit, at.span_s)

        def ask(other: Innovation) -> ScoredAnswer:
            return selecting(hypotheses, replace(other, candidates=likely, places=found.answer.association))

        if found.view.slopes is not None:
            touched = np.maximum(found.view.slopes @ touched, LEAST_MEAN)
        nearby = found.view.through(nearby)
        return self._faults.explained_by_fault(found, touched, nearby, ask) or found

    def _doubted(self, found: Explanation, at: PredictedScan) -> Explanation:
        """Is a touch on an electrode its contact impedance? Asked at some ages, when a weak one changes, and when it
        does not plainly explain a scan: a contact that changes under a touch is left when the touch goes.
        """
        if self._faults.now.wire is not None or not at.whole:
            return found
        doubtful = _doubtful(found.answer)
        for k, track in enumerate(self._touches.now.tracks):
            due = (track.contact_due or track.weakened) and not track.told_from_contact
            if not (due or doubtful) or track.ended or not self._faults.on_electrode(track.state):
                continue
            standing = self._touches.expected(at)
            loose = self._touches.expected(at, manoeuvring=True)
            del standing[k], loose[k]
            touched, nearby = self._standing_change(standing, at, but=k)
            ask = partial(self._given, standing, loose)
            other = self._faults.explained_by_fault(found, touched, nearby, ask, doubted=track.state)
            if other is not None:
                self._touches.remove(k)
                return other
        return found

    def decide(self, found: Explanation) -> None:
        """Whether a contact that has changed is a touch on its electrode, once a whole scan is explained with it: one
        that is new, or that stands by now.
        """
        at = found.view.at
        if not (found.answer.holds and at.whole) or found.changed:
            return
        if not self._faults.now.doubt.undecided or self._faults.now.wire is not None:
            return
        skin, own = self._covariances(at)
        touched, nearby = self._standing_change(self._touches.expected(at), at)
        misfit = self._tables.misfit_of(float(touched @ touched))
        touch = self._contact_or_touch(found, skin + nearby + misfit, own)
        if touch is not None:
            self._faults.drop_contact()
            self._touches.tell(touch, at)
        elif self._faults.now.contact < 0:
            for track in self._touches.now.tracks:
                track.told_from_contact = self._faults.on_electrode(track.state)
                track.confirmed = track.confirmed or track.told_from_contact

    def _covariances(self, at: PredictedScan) -> tuple[Array, Array]:
        """(K, K) of what changes with the skin, and of what the measurements add."""
        contact = self._tables.contact
        flicker = (contact * self._noise.now.flicker) @ contact.T
        return at.predicted.covariance + flicker, self._noise.covariance(at.scan.part) - flicker

    def _given(self, standing: list[TouchPrior], loose: list[TouchPrior], innovation: Innovation) -> ScoredAnswer:
        if not standing:
            return self._hypotheses.untouched(innovation)
        return self._hypotheses.ask(replace(innovation, candidates=(), places=()), standing, loose)

    def _standing_change(self, priors: Sequence[TouchPrior], at: PredictedScan, but: int = -1) -> tuple[Array, Array]:
        """(K,) what touches that stand do to each |Z|, and (K, K) the covariance of what they may have changed by: a
        strong one's outline and misfit are more than a contact impedance that begins to change. But: a track that is
        left out. The outline of a touch that has just come is not known: what is odd about it is no contact.
        """
        k = len(at.times_s)
        if not priors:
            return np.zeros(k), np.zeros((k, k))
        states = np.stack([prior.start for prior in priors])
        course = TouchCourse(self._tables.response, at.times_s, at.span_s)
        columns = course.columns(states, priors, course.directions(states))
        known = [t.scans >= n.DOUBT_SCANS for k, t in enumerate(self._touches.now.tracks) if k != but]
        nearby = standing_covariance(columns.slopes, states)
        if not all(known):
            return np.maximum(columns.mean, LEAST_MEAN), nearby
        outlines = columns.shapes * np.concatenate([prior.shape_sd for prior in priors])
        change = columns.mean + columns.shapes @ np.concatenate([prior.shape for prior in priors])
        nearby += outlines @ outlines.T + self._tables.misfit_of(float(change @ change))
        return np.maximum(change, LEAST_MEAN), nearby

    def _through_wires(self, view: BoardView) -> Hypotheses:
        """The skin through what is wrong with the board's wires."""
        wire = self._faults.now.wire
        if wire is None or view.slopes is None:
            self._through = None
            return self._hypotheses
        if self._through is None or self._through[0] != wire:
            self._through = wire, self._hypotheses.through(view.slopes)
        return self._through[1]


def _doubtful(answer: ScoredAnswer) -> bool:
    return answer.cause != AS_IT_IS or not (answer.quiet or answer.explained)
