"""The order in which a scan is asked about the board: its wires, what touches, contact impedances and gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from models.measurement.arrays import Array
from models.measurement.course import TouchCourse
from models.measurement.fit import LEAST_MEAN
from models.measurement.touch import TouchPrior
from services.estimation.faults.board import BoardView, Explanation, standing_covariance
from services.estimation.faults.contact_or_touch import ContactOrTouchTest
from services.estimation.faults.impedance import Change
from services.estimation.filter import Prediction
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, Observation, ScoredAnswer, begun_as
from services.estimation.hypotheses.selection import HypothesisSelection
from services.estimation.tared import TaredSkin
from services.estimation.values import numbers as n


class FaultIsolation:
    """Which fault of the board, if any, explains one scan better than touches alone."""

    def __init__(self, skin: TaredSkin, at: Observation, predicted: Prediction) -> None:
        self._skin, self._faults, self._touches = skin, skin.faults, skin.touches
        self._at, self._predicted = at, predicted

    @cached_property
    def _covariances(self) -> tuple[Array, Array]:
        """(K, K) of what changes with the skin, and of what the measurements add."""
        contact, noise = self._skin.tables.contact, self._skin.noise
        flicker = (contact * noise.now.flicker) @ contact.T
        return self._predicted.covariance + flicker, noise.covariance(self._at.scan.part) - flicker

    def explain(self, selection: HypothesisSelection) -> Explanation:
        """selection: of what touches may do."""
        faults, before = self._faults, (self._faults.now.wire, self._faults.now.wire_since_s)
        standing = self._touches.expected(self._at)
        view = self._look(faults.now.lifted)
        if faults.now.wire is None and self._rewire(view, standing):
            view = self._look(view.lifted)
        found = self._explain_view(selection, view)
        odd = _doubtful(found.answer) or -1 in found.answer.association
        if faults.now.wire is not None and odd and self._rewire(view, standing):
            found = self._explain_view(selection, self._look(view.lifted))
        if found.view.opens and faults.now.wire is None and (odd or (self._at.whole and self._touches.in_doubt)):
            found = self._try_lifted(found, selection)
        faults.now.opens, faults.now.lifted, faults.now.silent = found.view.opens, found.view.lifted, found.view.silent
        if faults.asks(found.answer):
            found = self._try_faults(found, selection, standing)
        if not found.answer.nearly_holds:  # what does not explain its scan would stand beside any touch in the next one
            faults.now.wire, faults.now.wire_since_s = before
        return self._doubt_touches(found)

    def _look(self, lifted: tuple[int, ...]) -> BoardView:
        return self._faults.look(self._at, self._predicted, self._skin.log_z0 + self._predicted.shift, lifted)

    def _rewire(self, view: BoardView, standing: Sequence[TouchPrior]) -> bool:
        if not self._faults.suspects_wires(view):
            return False
        touched, _ = self._standing_change(standing)
        skin, own = self._covariances
        return self._faults.wires_changed(view, touched, skin + self._skin.hypotheses.inflated_drift(), own)

    def _explain_view(self, selection: HypothesisSelection, view: BoardView) -> Explanation:
        hypotheses = self._through_wires(view)
        innovation = selection.innovation(hypotheses, view, view.covariance(*self._covariances))
        answer = selection.recounted(hypotheses, innovation, selection.answer(hypotheses, innovation))
        return Explanation(view, innovation, answer)

    def _try_lifted(self, found: Explanation, selection: HypothesisSelection) -> Explanation:
        """Electrodes that are open may be off the skin, or on it and cut off: whichever explains the scan better. A
        touch that has just come is not known well enough to decide by little: the scans that follow ask again.
        """
        other = self._explain_view(selection, self._look(() if found.view.lifted else found.view.opens))
        sure = n.WIRE_SURE if -1 in found.answer.association else n.FAULT_SURE
        better = (other.answer.holds, other.answer.score) > (found.answer.holds, found.answer.score + sure)
        return other if better else found

    def _try_faults(
        self, found: Explanation, selection: HypothesisSelection, standing: Sequence[TouchPrior]
    ) -> Explanation:
        hypotheses, fit = self._through_wires(found.view), found.answer.fit
        likely = begun_as(fit, self._at.span_s)
        touched, nearby = self._standing_change(standing)

        def ask(other: Innovation, change: Change, adds: bool) -> ScoredAnswer:
            # New touches were just searched for; what a fault hid of them the next scan tells, where one follows.
            if found.answer.explained and -1 in found.answer.association and not self._at.scan.separate:
                doubted = self._faults.may_be_contacts(found.answer, slice(change.electrode, change.electrode + 1))
                return hypotheses.of_fewer(other, found.answer, doubted, adds)
            again = replace(other, candidates=likely, places=found.answer.association)
            return selection.answer(hypotheses, again)

        if found.view.slopes is not None:
            touched = np.maximum(found.view.slopes @ touched, LEAST_MEAN)
        nearby = found.view.through(nearby)
        return self._faults.explained_by_fault(found, touched, nearby, ask) or found

    def _doubt_touches(self, found: Explanation) -> Explanation:
        """Is a touch on an electrode its contact impedance? Asked at some ages, when a weak one changes, and when it
        does not plainly explain a scan: a contact that changes under a touch is left when the touch goes.
        """
        if self._faults.now.wire is not None or not self._at.whole:
            return found
        doubtful = _doubtful(found.answer)
        for k, track in enumerate(self._touches.now.tracks):
            weakened = track.z2 < n.DOUBT_Z2 and not track.still  # it may have gone, and left something else
            due = (track.contact_due or weakened) and not track.contact_excluded
            if not (due or doubtful) or track.ended or not self._faults.on_electrode(track.state):
                continue
            other = self._explain_without(found, k)
            if other is not None:
                del self._touches.now.tracks[k]
                return other
        return found

    def _explain_without(self, found: Explanation, k: int) -> Explanation | None:
        """A scan explained by a fault instead of the k-th track."""
        standing, loose = self._touches.expected(self._at), self._touches.expected(self._at, manoeuvring=True)
        del standing[k], loose[k]
        touched, nearby = self._standing_change(standing, but=k)

        def ask(other: Innovation, _change: Change, _adds: bool) -> ScoredAnswer:
            if not standing:
                return self._skin.hypotheses.untouched(other)
            return self._skin.hypotheses.ask(replace(other, candidates=(), places=()), standing, loose)

        doubted = self._touches.now.tracks[k].state
        return self._faults.explained_by_fault(found, touched, nearby, ask, doubted)

    def decide(self, found: Explanation) -> None:
        """Whether a contact that changed is a touch on its electrode, once a whole scan is explained with it."""
        skin, faults, touches = self._skin, self._faults, self._touches
        if not (found.answer.holds and self._at.whole) or found.changed:
            return
        if not faults.now.doubt.undecided or faults.now.wire is not None:
            return
        touched, nearby = self._standing_change(touches.expected(self._at))
        misfit = skin.tables.misfit_of(float(touched @ touched))
        changes, own = self._covariances
        touch = ContactOrTouchTest(skin.tables, skin.hypotheses, faults)(found, changes + nearby + misfit, own)
        if touch is not None:
            faults.drop_contact()
            touches.tell(touch, self._at)
        elif faults.now.contact < 0:
            for track in touches.now.tracks:
                track.contact_excluded = faults.on_electrode(track.state)
                track.confirmed = track.confirmed or track.contact_excluded

    def _standing_change(self, priors: Sequence[TouchPrior], but: int = -1) -> tuple[Array, Array]:
        """(K,) what touches that stand do to each |Z|, and (K, K) the covariance of what they may have changed by: a
        strong one's outline and misfit are more than a contact impedance that begins to change. But: a track that is
        left out. The outline of a touch that has just come is not known: what is odd about it is no contact.
        """
        at, tables = self._at, self._skin.tables
        if not priors:
            return np.zeros(len(at.times_s)), np.zeros((len(at.times_s), len(at.times_s)))
        states = np.stack([prior.start for prior in priors])
        course = TouchCourse(tables.response, at.times_s, at.span_s)
        columns = course.columns(states, priors, course.directions(states))
        known = [t.scans >= n.DOUBT_SCANS for k, t in enumerate(self._touches.now.tracks) if k != but]
        nearby = standing_covariance(columns.slopes, states)
        if not all(known):
            return np.maximum(columns.mean, LEAST_MEAN), nearby
        outlines = columns.shapes * np.concatenate([prior.shape_sd for prior in priors])
        change = columns.mean + columns.shapes @ np.concatenate([prior.shape for prior in priors])
        nearby += outlines @ outlines.T + tables.misfit_of(float(change @ change))
        return np.maximum(change, LEAST_MEAN), nearby

    def _through_wires(self, view: BoardView) -> Hypotheses:
        """The skin through what is wrong with the board's wires."""
        return self._skin.hypotheses.through(self._faults.now.wire, view.slopes)


def _doubtful(answer: ScoredAnswer) -> bool:
    return answer.cause != AS_IT_IS or not (answer.quiet or answer.explained)
