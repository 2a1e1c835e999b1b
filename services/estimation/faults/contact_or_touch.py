"""Is a changed contact impedance a touch right on its electrode? Both explain a scan nearly as well where it is light.

The scans since the change are averaged, touches that stand taken off, and both are asked: a contact of any size, and a
touch there with what discs miss of it at second order. A touch has more figures, so a light one is worth up to 18 nats
less than a contact that is none; a contact that is one gains with each scan. Where the touch would be too light to be
seen elsewhere, less decides for a contact that jumped from one scan to the next. What neither decides stays not valid.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.measurement.arrays import Array
from models.measurement.fit import LEAST_MEAN, FoundTouches
from models.measurement.tables import SkinTables
from models.measurement.touch import ACTION
from models.measurement.whitening import leave_out
from services.estimation.faults.board import BoardFaults, BoardView, Explanation
from services.estimation.faults.contact_state import JUMP
from services.estimation.faults.impedance import Change, Unexplained
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import AS_IT_IS, MEMORY, Innovation, ScoredAnswer, StepBudget
from services.estimation.values import numbers as n

EVERY = 16  # scans from asking to asking, once those since the change have doubled so often: at 2, 4, 8, 16, 32, 48 ...
SETTLES = 3  # whole scans in which a change may go on


class ContactOrTouchTest:
    """A sequential likelihood ratio test over the mean of the scans since a contact impedance began to change."""

    def __init__(self, tables: SkinTables, hypotheses: Hypotheses, faults: BoardFaults) -> None:
        self._tables, self._hypotheses, self._faults = tables, hypotheses, faults

    def __call__(self, found: Explanation, skin: Array, own: Array) -> FoundTouches | None:
        """A whole scan that was explained with a changed contact. skin, own: as for `BoardView.covariance`, what
        touches that stand may do included. Returns the touch that it is.
        """
        view, faults = found.view, self._faults.now
        doubt = faults.doubt
        if not doubt.undecided or found.answer.cause not in (AS_IT_IS, MEMORY) or self._changes(view):
            return None
        mean = doubt.add(self._over(view, found.answer))
        if doubt.scans == 1 or (doubt.scans % EVERY and doubt.scans & (doubt.scans - 1)):
            return None
        y = np.where(view.live, mean, 0.0)
        scale = np.exp(np.where(view.live, view.at.log_z - view.sound - y, 0.0))
        covariance = (skin + own / doubt.scans) * scale[:, None] * scale
        leave_out(covariance, view.live)
        asked = replace(found.innovation, y=y, covariance=covariance, budget=StepBudget(n.MOST_STEPS), keeps=0.0)
        contact = self._contact(asked)
        nothing = asked.white.log_likelihood(y)
        if contact.size < 0 or contact.score - nothing < n.FALSE_ALARM_Z2 / 2:  # no touch would be seen in it
            if faults.size - doubt.decided < doubt.least:
                doubt.end(faults.size)
            else:  # the touches that stand explain all of it
                self._faults.drop_contact()
            return None
        touch = self._touch(asked)
        odds = contact.score - touch.score
        jumped = odds > n.FAULT_SURE and _unseen(found.innovation, touch) and self._jumped(asked, contact)
        if odds > n.CONTACT_DECIDED or jumped:
            self._faults.end_doubt(jumped)
        elif odds < -n.FAULT_SURE and touch.explained:
            return touch.fit
        return None

    def _changes(self, view: BoardView) -> bool:
        """Whether it goes on changing: no mean tells then. Asked of the first scans: a finger may never be still."""
        doubt = self._faults.now.doubt
        if self._faults.began_within(view):
            return True
        sizes = [each.size for each in doubt.sizes[-2:]]
        return doubt.seen <= SETTLES and len(sizes) == 2 and abs(sizes[1] - sizes[0]) > doubt.least

    def _jumped(self, asked: Innovation, contact: Change) -> bool:
        """Whether all of it came from one scan to the next, and stays: a press rises, or is too light to be seen."""
        faults = self._faults.now
        if faults.earlier is None or faults.doubt.seen < 2:
            return False
        before = self._contact(replace(asked, y=np.where(asked.live, faults.earlier, 0.0))).size
        sizes = [each.size for each in faults.doubt.sizes[-faults.doubt.seen :]]
        half = len(sizes) // 2
        later = float(np.mean(sizes[half:]) - np.mean(sizes[:half]))
        return max(before, abs(later)) < JUMP * contact.size

    def _over(self, view: BoardView, answer: ScoredAnswer) -> Array:
        """(K,) log |Z| over a skin with what is decided, touches that stand taken off."""
        faults = self._faults
        known = faults.columns.settled_mean() + faults.columns.mean(faults.now.contact, faults.now.doubt.decided)
        touched = np.exp(view.y) - np.exp(answer.residual)
        left = np.expm1(np.minimum(view.at.log_z - view.sound, n.MISFIT_MOST)) - touched - known
        return np.where(view.live, np.log1p(np.maximum(left, LEAST_MEAN)), 0.0)

    def _contact(self, asked: Innovation) -> Change:
        now = self._faults.now
        columns = self._faults.columns.with_change(now.contact, now.doubt.decided)
        scan = Unexplained(asked.y, np.ones(len(asked.y)), asked.live, asked.times_s, asked.span_s, asked.white)
        return columns.changes(scan, np.array([now.contact]), np.array([-np.inf]))[0]

    def _touch(self, asked: Innovation) -> ScoredAnswer:
        k = self._faults.now.contact
        columns = self._faults.columns
        second = n.TOUCH_SECOND * np.column_stack([columns.series[:, k], columns.shunt[:, k]])
        return self._hypotheses.on_electrode(asked, self._tables.places[k], second)


def _unseen(innovation: Innovation, touch: ScoredAnswer) -> bool:
    """Whether a touch acts by so little that at many places no scan would show it."""
    assert touch.fit is not None
    least = float(np.quantile(innovation.information, n.START_SEEN_SHARE))
    return float(touch.fit.states[0, ACTION]) ** 2 * least < n.FALSE_ALARM_Z2
