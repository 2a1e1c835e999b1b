"""One scan's way, once there is a baseline: predicted, asked about, learnt from, judged."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace

import numpy as np

from models.measurement.arrays import Array
from models.measurement.touch import ACTION, STATES
from models.measurement.whitening import Whitening, leave_out
from services.estimation.faults import advice
from services.estimation.faults.board import Explanation
from services.estimation.faults.isolation import FaultIsolation
from services.estimation.gates import Seen
from services.estimation.hypotheses.innovation import (
    AS_IT_IS,
    BURST,
    DRIFT,
    MEMORY,
    NOISE,
    Innovation,
    Observation,
    OpenTouch,
    ScoredAnswer,
)
from services.estimation.hypotheses.selection import HypothesisSelection
from services.estimation.initialisation.tare import Taring
from services.estimation.learning import PendingScan
from services.estimation.tared import KnownBaseline, TaredSkin
from services.estimation.track import coasted
from services.estimation.track_update import update_tracks
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Estimate, Judgement, TouchEstimate, Verdict, judge
from services.estimation.values.scan import NANOSECOND, PER_S, Scan


@dataclass
class EstimatorState:
    """All that changes beside what the learners keep."""

    before: Scan | None = None
    whole_us: float = -np.inf  # board's clock at the end of the last whole scan
    wholes: int = 0  # whole scans since the tare
    unexplained_s: float = 0.0  # for how long nothing has explained the scans
    quiet: bool = False  # the scan before was what noise makes
    candidates: list[OpenTouch] = field(default_factory=list)
    published: tuple[TouchEstimate, ...] = ()
    published_ns: int = 0  # `sample` for which that was
    adopted_age_s: float | None = None  # of a baseline that was adopted, before the next scan
    trusted: KnownBaseline | None = None  # too old to go on from: it tells what touches the first scans


@dataclass
class ScanStep:
    """One scan against a skin as it is known, which it changes."""

    now: EstimatorState
    taring: Taring
    skin: TaredSkin
    measured: Observation
    judgements: list[Judgement]  # of the scan so far

    def estimate(self, gap_s: float) -> Estimate:
        """What touches. gap_s: since the scan before."""
        self._bridge(gap_s)
        if (slow := self._slow_onset()) is not None:
            return self._conclude(*slow)
        seen, was_quiet, self.now.quiet = self._glance(), self.now.quiet, False
        if seen is not None and seen.quiet:
            return self._quiet(seen)
        if seen is not None and self.measured.scan.part and was_quiet:
            # Something begins. Its first few values tell no place that could be shown, and asking what they are takes
            # longer than the next part, which tells: it is asked about. A whole scan is the one after that.
            if self.measured.whole:
                self.now.whole_us -= PER_S * self.measured.span_s * (1 - 2 * float(self.measured.scan.new.mean()))
            return self._estimate(seen.y, np.zeros(len(seen.y)), seen.z2, 1.0)
        if (goes_on := self._going_on()) is not None:
            return self._conclude(*goes_on)
        return self._test_hypotheses(max(gap_s, 0.0))

    def _bridge(self, gap_s: float) -> None:
        """The time since the scan before: that a baseline was kept, or that scans were lost."""
        skin, measured = self.skin, self.measured
        if self.now.adopted_age_s is not None:
            for state in skin.aged:
                state.at_s += measured.middle_s
            skin.drift.now = skin.aged[-1]
            self.now.adopted_age_s = None
        skin.noise.lines.ordered(measured.scan.part, measured.order)
        if not 0 <= gap_s <= n.GAP_S:
            skin.touches.lose()
        if gap_s < 0:
            skin.learning.doubt()  # else it was no touch that had begun, if nothing touches now

    @property
    def _complete(self) -> bool:
        """Whether every measurement that the baseline has counts."""
        return bool((self.measured.live == self.skin.live).all())

    @property
    def _plain(self) -> bool:
        """Whether nothing is wrong with the board either."""
        return self._complete and self.skin.faults.plain(self.measured.oldest_s)

    @property
    def _y(self) -> Array:
        """(K,) log |Z| over what the filter predicts of the untouched skin on this board; 0 where it does not count."""
        skin, measured = self.skin, self.measured
        over = measured.log_z - skin.log_z0 - skin.drift.shift(measured.middle_s)
        return np.where(measured.live, skin.faults.taken_off(over), 0.0)

    # --- gates ---

    def _glance(self) -> Seen | None:
        """What a first look sees where nothing touched before; None where it cannot tell."""
        skin, measured, known = self.skin, self.measured, self.skin.grid_information
        if known is None or len(skin.touches) or not self._plain:
            return None
        seen = skin.null_gate.look(measured, self._y, known.each)
        memory = measured.whole and skin.drift.remembers(measured.middle_s)  # it may hide what presses again
        return None if seen is not None and seen.quiet and memory else seen

    def _slow_onset(self) -> tuple[Innovation, ScoredAnswer] | None:
        """A touch where nothing touched, that no drift since a while ago explains: the filter is that of then."""
        skin, measured, middle_s = self.skin, self.measured, self.measured.middle_s
        if len(skin.touches) or self.now.unexplained_s or not (measured.whole and skin.tables.predicted):
            return None
        if not self._plain or (then := skin.slow_onset.due(middle_s)) is None:
            return None
        predicted = then.predict(middle_s, skin.noise.now.flicker)
        covariance = skin.noise.covariance(measured.scan.part) + predicted.covariance
        covariance += then.inflated_process_noise(n.SLOW_TIMES)
        leave_out(covariance, measured.live)
        y = skin.faults.taken_off(measured.log_z - skin.log_z0 - predicted.shift)
        y = np.where(measured.live, y, 0.0)
        information = skin.hypotheses.grid.information(Whitening.of(covariance))
        innovation = Innovation(*measured.fields, y, covariance, information)
        answer = skin.hypotheses.slow_onset(innovation)
        if answer is None:
            return None
        skin.drift.now = then.now
        skin.learning.doubt()
        skin.null_gate.forget()
        return innovation, answer

    def _going_on(self) -> tuple[Innovation, ScoredAnswer] | None:
        """That touches which stayed as they are do so in a further part of a scan; else None."""
        skin, measured, information = self.skin, self.measured, self.skin.grid_information
        if measured.whole or information is None or not skin.touches.steady or self.now.unexplained_s:
            return None
        if not self._plain or (known := skin.null_gate.steady(measured, skin.touches.ids)) is None:
            return None
        wide = skin.touches.now.wide
        innovation = Innovation(*measured.fields, self._y, known.covariance, information.each, wide=wide)
        expected = skin.touches.expected(measured)
        answer = skin.hypotheses.fitted(innovation, expected, most_steps=1, before=known.fit)
        return (innovation, answer) if answer.explained and answer.next_touch_z2 < n.GLANCE_Z2 else None

    # --- answers ---

    def _quiet(self, seen: Seen) -> Estimate:
        skin, measured, self.now.quiet = self.skin, self.measured, True
        self._explained(AS_IT_IS)
        skin.remember(skin.refused.explained(measured.oldest_s))
        skin.faults.remember(seen.y, measured.whole)
        if measured.whole:
            log_z = skin.log_z0 + skin.faults.taken_off(measured.log_z - skin.log_z0)
            self.measured = replace(measured, log_z=log_z)
        self._learn_untouched(seen.weighted_residual, AS_IT_IS)
        self.now.published, self.now.candidates = (), []
        return self._estimate(seen.y, np.zeros(len(seen.y)), seen.z2, 0.0)

    def _conclude(self, innovation: Innovation, answer: ScoredAnswer) -> Estimate:
        update_tracks(self.skin, innovation, answer, self.measured, self.now.unexplained_s)
        self._explained(answer.cause)
        return self._publish(innovation, answer, explained=True)

    def _test_hypotheses(self, passed_s: float) -> Estimate:
        skin, now = self.skin, self.now
        skin.touches.drop_ended(self.measured.oldest_s)
        if vague := skin.touches.drop_tentative(skin.faults.in_question):
            now.candidates = [OpenTouch(track.state, track.since_s) for track in vague]
        found = self._explain()
        innovation, answer, view = found.innovation, found.answer, found.view
        now.quiet = answer.quiet
        # as sound wires would show it
        self.measured = replace(self.measured, log_z=view.untouched + view.y, live=view.live)
        if answer.nearly_holds:
            update_tracks(skin, innovation, answer, self.measured, now.unexplained_s)
        transient = answer.fit is not None and not len(skin.touches)  # it came and went within the scan
        self._update_lock(innovation, answer, transient)
        self._keep_candidates(answer)
        if answer.holds and not found.changed and self._plain:
            skin.null_gate.keep(self.measured, skin.touches.ids, innovation, answer)
        skin.faults.follow(view, answer, passed_s, self.measured.whole)
        sound = skin.faults.sound
        FaultIsolation(skin, view.at, view.predicted).decide(found)
        if sound:
            self._learn(found)
        if sound and answer.fit is not None:
            drifted = view.grown * (view.predicted.covariance @ (view.grown * answer.weighted_residual))
            innovation = replace(innovation, y=innovation.y - np.where(view.live, drifted, 0.0))
        self.judgements += self._judged(found)
        return self._publish(innovation, answer, answer.holds and not transient)

    def _explain(self) -> Explanation:
        """What explains a scan, with all that the skin may remember."""
        skin, steps = self.skin, self.skin.faults.now.gain_steps
        found = self._likeliest_age()
        if found.answer.holds and (pressed := skin.refused.explained(self.measured.oldest_s)):
            skin.remember(pressed)
            found = self._explanation()  # again: what is left may be memory
        if skin.faults.now.gain_steps > steps:
            skin.learning.stepped()
        return found

    def _likeliest_age(self) -> Explanation:
        """The first scan after adopting tells how far the skin drifted. In doubt further: else drift is a touch."""
        skin, budget = self.skin, self.measured.budget
        if len(skin.aged) < 2:
            return self._explanation()
        tried, faults, steps = [], skin.faults.now, budget.left
        for state in skin.aged:
            skin.drift.now, skin.faults.now, skin.grid_information = state, deepcopy(faults), None
            budget.left = steps
            tried.append((self._explanation(), state, skin.faults.now))
        holding = [each for each in tried if each[0].answer.holds] or tried
        best = max((each[0].answer for each in holding), key=lambda answer: answer.score)
        # An older one may be less likely, the more touches it saves.
        nearly = [
            each
            for each in holding
            if each[0].answer.score >= best.score - n.YOUNGER * max(1, best.count - each[0].answer.count)
        ]
        found, skin.drift.now, skin.faults.now = nearly[-1]
        skin.aged = []
        return found

    def _explanation(self) -> Explanation:
        skin, measured, now = self.skin, self.measured, self.now
        predicted = skin.drift.predict(measured.middle_s, skin.noise.now.flicker)
        selection = HypothesisSelection(skin, measured, predicted, now.unexplained_s, now.candidates, now.wholes)
        return FaultIsolation(skin, measured, predicted).explain(selection)

    # --- what follows ---

    def _update_lock(self, innovation: Innovation, answer: ScoredAnswer, transient: bool) -> None:
        """Whether the skin is still followed: explained, or for how long it has not been."""
        now, tracks = self.now, self.skin.touches.now.tracks
        if transient or not answer.nearly_holds:
            self._refused(innovation, answer)
        elif answer.fit is None or any(track.confirmed for track in tracks):
            self._explained(answer.cause, roughly=not answer.holds)
        elif self.measured.whole:  # a touch that comes again and again, and never for sure, is none
            now.unexplained_s += self.measured.span_s

    def _keep_candidates(self, answer: ScoredAnswer) -> None:
        """Touches that nearly explain a scan, for the next one."""
        if answer.nearly_holds:
            self.now.candidates = []
        elif answer.fit is not None:  # else no touch was looked for
            ids = [self.skin.touches.ids[place] if place >= 0 else 0 for place in answer.association]
            found = zip(answer.fit.states, answer.fit.priors, ids, strict=True)
            middle_s = self.measured.middle_s
            self.now.candidates = [OpenTouch(state, middle_s + prior.since_s, id) for state, prior, id in found]

    def _explained(self, cause: str, roughly: bool = False) -> None:
        skin, measured = self.skin, self.measured
        self.now.unexplained_s = 0.0
        skin.touches.now.watched = True
        if not roughly:
            skin.faults.gain_holds(measured.end_s)
        if cause == AS_IT_IS:
            skin.drift.now.process_noise_scale = 1.0

    def _refused(self, innovation: Innovation, answer: ScoredAnswer) -> None:
        """Nothing explains it: the longer that lasts, the further the skin may have drifted."""
        now, skin, span_s = self.now, self.skin, self.measured.span_s
        skin.learning.doubt()
        if self.measured.whole:
            skin.refused.refuse(innovation.y, span_s)
            now.unexplained_s += span_s
            if skin.tables.predicted and now.unexplained_s > n.CHANGING_S:
                skin.drift.now.process_noise_scale = min(n.MOST_ADRIFT, skin.drift.now.process_noise_scale * n.ADRIFT)
        unexplained, change = (float(np.sum(innovation.white(each) ** 2)) for each in (answer.residual, innovation.y))
        if not answer.nearly_holds and unexplained > n.STRANGE * change:  # the likeliest touches leave most of it
            now.unexplained_s = max(now.unexplained_s, float(n.CHANGING_S))

    def _learn(self, found: Explanation) -> None:
        """From untouched scans all, while touched what the touches leave open, now and then: what their response gets
        wrong is the same from scan to scan. Nothing where a contact or the gain changes: the rest is off by what its
        size was expected to be.
        """
        skin, measured, answer, view = self.skin, self.measured, found.answer, found.view
        if not answer.holds or found.changed or view.contact >= 0 or skin.faults.gain_gross(measured.end_s):
            return
        if answer.fit is None:
            self._learn_untouched(answer.weighted_residual, answer.cause)
            return
        skin.learning.doubt()
        if not measured.whole:
            return
        self.now.wholes += 1
        if answer.cause != AS_IT_IS or not measured.scan.believed:
            return
        skin.noise.learn_contacts(answer.weighted_residual, answer.white)
        predicted = view.predicted
        due = predicted.at_s - skin.drift.now.at_s > n.TOUCHED_LEARNS_S
        same = len(predicted.x) == len(skin.drift.now.x)  # nothing has ended or slid away
        if due and same and not answer.recounted and self._complete:
            skin.drift.update_beside_touches(predicted, answer.fit, view.grown)
            skin.null_gate.forget()

    def _learn_untouched(self, weighted_residual: Array, cause: str) -> None:
        skin, measured, scan = self.skin, self.measured, self.measured.scan
        if not scan.believed:
            return
        if cause == MEMORY and measured.whole:
            skin.drift.widen_memories()
            skin.null_gate.forget()
        odd = cause in (BURST, NOISE)
        if self._complete:
            skin.noise.update(weighted_residual, scan.part, odd, measured.middle_s, measured.span_s)
        if not measured.whole:
            return
        self.now.wholes += 1
        if odd:
            return
        drifts = skin.drift.now.process_noise_scale if cause == DRIFT else 0.0
        if drifts:
            skin.null_gate.forget()
        over = measured.log_z - skin.log_z0
        skin.learning.untouched(PendingScan(measured.middle_s, over, measured.live, scan.part, drifts))
        skin.slow_onset.keep()

    # --- what comes out ---

    def _judged(self, found: Explanation) -> list[Judgement]:
        """What the board and lost scans leave of a scan's word."""
        skin, measured, faults, failed = self.skin, self.measured, self.skin.faults, float(found.view.failed.mean())
        return [
            *advice.judgements_of(faults.states(), measured.scan.status, failed, faults.now.doubt.undecided),
            judge("gap", float(skin.touches.lost), 1.0),
            judge("gain", float(faults.gain_stepped(measured.oldest_s)), 1.0),
            judge("gain_gross", float(faults.gain_gross(measured.end_s)), 1.0),
            judge("seen", n.LEAST_LIVE, max(float(measured.live.mean()), 1e-3)),
        ]

    def _publish(self, innovation: Innovation, answer: ScoredAnswer, explained: bool) -> Estimate:
        skin, touches = self.skin, self.skin.touches
        self.now.published = self._touches_published(innovation, answer)
        self.now.published_ns = self.measured.scan.sample_ns
        unsure = not all(track.confirmed for track in touches.now.tracks)
        # Squared sigmas of what the answer leaves, and of the touches that explain the scan, or would.
        z2 = [answer.next_touch_z2 / (max(1.0, answer.chi2) if answer.quiet else 1.0)]
        if answer.fit is None or answer.nearly_holds:
            z2 += [track.z2 for track in touches.lasting]
        else:
            variance = np.diag(answer.fit.covariance)[ACTION::STATES]
            z2 += list(answer.fit.states[:, ACTION] ** 2 / np.maximum(variance, n.TINY**2))
        if answer.fit is not None and not skin.tables.predicted:
            z2.append(skin.hypotheses.untouched(innovation).next_touch_z2)
        changing = float(skin.tables.predicted and (unsure or not explained))
        return self._estimate(innovation.y, np.sqrt(np.diag(innovation.covariance)), max(z2), changing)

    def _touches_published(self, innovation: Innovation, answer: ScoredAnswer) -> tuple[TouchEstimate, ...]:
        """Confirmed tracks; roughly, those published last where nothing tells how they go on, or if they are one."""
        sample_s, published, now = self.measured.sample_s, self.now.published, self.skin.touches.now
        passed_s = (self.measured.scan.sample_ns - self.now.published_ns) * NANOSECOND
        if not answer.nearly_holds:
            return tuple(coasted(touch, passed_s) for touch in published)
        unexplained = float(np.linalg.norm(answer.residual)) / max(float(np.linalg.norm(innovation.y)), n.TINY)
        lasting = [track for track in now.tracks if track.confirmed and track.acts_at(sample_s, self.measured.end_s)]
        open_ids = [track.id for track in (*now.tracks, *now.dropped) if not track.confirmed]
        found = [track.estimate(sample_s, self.measured.span_s, unexplained) for track in lasting]
        told = [self.measured.middle_s + self.measured.times_s >= track.since_s for track in lasting]
        return (
            *(each if acts.sum() >= n.TOLD else coasted(each, 0.0) for each, acts in zip(found, told, strict=True)),
            *(coasted(touch, passed_s) for touch in published if touch.id in open_ids),
        )

    def _estimate(self, y: Array, sigma: Array, z2: float, changing: float) -> Estimate:
        """y, sigma (K,): log |Z| over what was predicted, and its standard deviation."""
        measured, touches, judgements = self.measured, self.now.published, self.judgements
        if measured.whole:
            self.taring.observe(bool(touches) or z2 >= n.FALSE_ALARM_Z2)
        judgements.append(judge("touch", max([z2, *(touch.z2 for touch in touches)]), n.FALSE_ALARM_Z2))
        alone = measured.scan.separate and not touches  # no further row tells whether anything touches
        judgements.append(judge("changing", changing, 1.0, turned=Verdict.REFUSE if alone else None))
        explained = judge("explained", self.now.unexplained_s, n.CHANGING_S)
        predicted = self.skin.tables.predicted
        judgements.append(explained if predicted else explained._replace(verdict=Verdict.CANNOT))
        electrodes = self.skin.faults.states()
        return Estimate(measured.scan, measured.whole, touches, electrodes, measured.live, y, sigma, tuple(judgements))
