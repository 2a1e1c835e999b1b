"""The way of one scan, or of the newest values after a part of one: predicted, asked, settled, learnt from, judged."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.whitening import Whitening, leave_out
from models.measurement.responses.tables import SkinTables
from models.measurement.touch import ACTION, SHAPES, STATES
from services.estimation.delayed_update import PendingScan
from services.estimation.faults import advice
from services.estimation.faults.board import BoardView, Explanation, PredictedScan
from services.estimation.faults.wires import WireFault
from services.estimation.gates import Seen
from services.estimation.hypotheses.hypotheses import Hypotheses
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
    StepBudget,
)
from services.estimation.hypotheses.selection import HypothesisSelection
from services.estimation.initialisation.baseline import NoBaseline
from services.estimation.initialisation.tare import (
    AgreedScans,
    BaselineTells,
    LatestScansState,
    Taring,
    TaringState,
)
from services.estimation.tared import KnownBaseline, TaredSkin, TaredState
from services.estimation.touches import TouchTracks, coasted, estimate_of
from services.estimation.track_update import update_tracks
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Estimate, TouchEstimate
from services.estimation.values.judgement import Judgement, Verdict, judge
from services.estimation.values.scan import Scan
from services.estimation.values.state import loaded, saved

Array = NDArray[np.float64]

LAYOUT = 22  # of a kept state


@dataclass
class EstimatorState:
    """All that changes beside what the learners keep."""

    before: Scan | None = None
    whole_us: float = -np.inf  # board's clock at the end of the last whole scan
    wholes: int = 0  # whole scans since the tare
    unexplained_s: float = 0.0  # for how long nothing has explained the scans
    noticed: bool = False  # the part before was the first that was not quiet, and was not asked about
    candidates: list[OpenTouch] = field(default_factory=list)
    published: tuple[TouchEstimate, ...] = ()
    published_ns: int = 0  # `sample` for which that was
    adopted_age_s: float | None = None  # of a baseline that was adopted, before the next scan
    trusted: KnownBaseline | None = None  # too old to go on from: it tells what touches the first scans


class GridInformation(NamedTuple):
    """Of the grid's discs, made now and then and under other wires or measurements."""

    each: NDArray[np.float32]  # (A,)
    wholes: int  # EstimatorState.wholes then
    live: NDArray[np.bool_]
    wire: WireFault | None


@dataclass
class WholeState:
    """All that changes of an estimator."""

    scans: EstimatorState
    taring: TaringState
    latest: LatestScansState
    tared: TaredState | None


class Estimator:
    """Of one skin; tables: of its bundle."""

    def __init__(self, tables: SkinTables, tare_scans: int = int(n.TARE_SCANS)) -> None:
        self._tables = tables
        self.now = EstimatorState()
        self.taring = Taring(tables, tare_scans)
        self.skin: TaredSkin | None = None
        self._information: GridInformation | None = None

    def tare(self, force: bool = False) -> AgreedScans:
        """Take the latest scans for the untouched skin: these. Raises NoBaseline, while something touches unless
        forced.
        """
        if not force and self.wire is not None:
            raise NoBaseline("wires of the board are wrong, expected all as they belong: mend them and try again")
        scans = self.taring.by_command(force, self._tells)
        self._begin(scans)
        return scans

    @property
    def _tells(self) -> BaselineTells:
        """What the baseline's word is worth."""
        if self.skin is None:
            return BaselineTells.NOTHING
        return BaselineTells.LOST if self.now.unexplained_s > n.LOST_S else BaselineTells.TOUCHES

    @property
    def wire(self) -> WireFault | None:
        """What is wrong with the board's wires."""
        return self.taring.now.wire if self.skin is None else self.skin.faults.now.wire

    @property
    def touched(self) -> bool:
        """Whether something touches, or may."""
        return self.skin is not None and (len(self.skin.touches) > 0 or self.now.unexplained_s > 0)

    def use(self, tables: SkinTables) -> None:
        """Of the same skin from the next scan on, as a calibration of its mounting knows it; while nothing touches."""
        self._tables = tables
        self.taring.use(tables)
        self._information = None
        if self.skin is not None:
            self.skin = self.skin.with_tables(tables)

    def saw_untouched(self) -> None:
        """The scan before the next one was untouched, as its source says: what touches then has begun."""
        if self.skin is not None:
            self.skin.touches.now.watched = True

    def adopt(self, baseline: KnownBaseline, age_s: float, contact_per_s: float = n.CONTACT_RATE) -> None:
        """Go on from a baseline that is age_s older than the next scan; nobody watched meanwhile. contact_per_s: by
        which contact impedances of this skin change.
        """
        next_id = 1 if self.skin is None else self.skin.touches.now.next_id
        self.skin = TaredSkin(self._tables, baseline)
        age_s = min(max(age_s, 0.0), float(n.OLDEST_S))
        self.skin.adopt(next_id, contact_per_s, age_s)
        self.now, self._information = EstimatorState(adopted_age_s=age_s), None
        self.taring.adopted(baseline.doubt)

    def trust(self, baseline: KnownBaseline | None) -> None:
        """What the first scans are held against, too old to go on from; None: their bundle alone."""
        self.now.trusted = baseline

    def _begin(self, scans: AgreedScans, wire: WireFault | None = None) -> None:
        next_id = 1 if self.skin is None else self.skin.touches.now.next_id
        baseline = KnownBaseline(scans.log_z0, scans.live, scans.scatter, len(scans.residuals))
        self.skin = TaredSkin(self._tables, baseline)
        self.skin.begin(scans, next_id)
        self.skin.faults.now.wire = wire
        self._information, self.now.wholes, self.now.unexplained_s = None, 0, 0.0
        self.now.trusted = None

    def _first(self) -> None:
        """Begin as soon as the first scans tell an untouched skin, or what touches one that is known."""
        due, trusted = self.taring.latest.due, self.now.trusted
        scans = self.taring.first(None if trusted is None else trusted.after_long(self._tables))
        if scans is not None:
            self._begin(scans, self.taring.now.wire)
        elif due and trusted is not None and self.taring.now.surely:
            latest = self.taring.latest.agreed(self._tables)
            trusted = trusted._replace(live=trusted.live & latest.live, scatter=latest.scatter)
            self.adopt(trusted, float(n.OLDEST_S))

    def state(self) -> dict[str, Any]:
        """All that changes, to be kept; who loads it goes on bit by bit as this one does."""
        self._information = None  # as whitenings of a moment ago
        tared = None if self.skin is None else self.skin.state()
        return {"layout": LAYOUT, **saved(WholeState(self.now, self.taring.now, self.taring.latest.now, tared))}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a state. Raises ValueError where it is of another layout or skin, or damaged: nothing changes."""
        if state.get("layout") != LAYOUT:
            raise ValueError(f"a state of layout {state.get('layout')!r}, expected {LAYOUT}")
        sizes = {
            "K": self._tables.measurements,
            "E": self._tables.electrodes,
            "states": STATES,
            "shapes": SHAPES,
            "said": 4,
        }
        known = loaded(WholeState, {name: value for name, value in state.items() if name != "layout"}, sizes)
        skin = None
        if known.tared is not None:
            skin = TaredSkin(self._tables, known.tared.baseline)
            skin.load(known.tared)
        self.skin, self.now, self.taring.now, self.taring.latest.now = skin, known.scans, known.taring, known.latest
        self._information = None

    # --- one scan ---

    def learn(self) -> None:
        """What scans before the next one teach: at the latest that asks for it, so who calls it while nothing waits is
        answered sooner, and the same.
        """
        if self.skin is not None:
            self.skin.learning.catch_up()

    def step(self, scan: Scan) -> Estimate:
        """What touches, by this scan and those before it."""
        self.learn()
        before, self.now.before = self.now.before, scan
        gap_s = 0.0 if before is None else (scan.at_ns - before.at_ns) * 1e-9
        measured = self._prepared(scan)
        judgements = [judge("believed", float(not scan.believed), 1.0)]
        judgements += self.taring.judgements(self.skin is not None)
        if self.skin is None:
            self._first()
            return self._unknown(measured, judgements)
        self._bridge(self.skin, measured, gap_s)
        if (slowly := self._came_slowly(self.skin, measured)) is not None:
            return self._held(self.skin, measured, *slowly, judgements)
        seen, noticed, self.now.noticed = self._glanced(self.skin, measured), self.now.noticed, False
        if seen is not None and seen.quiet:
            return self._quiet(self.skin, measured, seen, judgements)
        if seen is not None and not (noticed or measured.whole):
            return self._noticed(measured, seen, judgements)
        if (goes_on := self._going_on(self.skin, measured)) is not None:
            return self._held(self.skin, measured, *goes_on, judgements)
        return self._asked(self.skin, measured, max(gap_s, 0.0), judgements)

    def _prepared(self, scan: Scan) -> Observation:
        """A scan as it is looked at; a whole one may be one of a baseline."""
        now, oldest_us = self.now, scan.end_us - 1e6 * scan.duration_s
        whole = not scan.part or oldest_us >= now.whole_us - 1.0 or scan.end_us < now.whole_us
        measurable = np.isfinite(scan.values) & (scan.values > 0) & (scan.status == 0)
        live = measurable if self.skin is None else measurable & self.skin.live
        budget = StepBudget.of(float(scan.new.mean()), scan.separate)
        measured = Observation(scan, np.log(np.where(live, scan.values, 1.0)), live, whole, budget)
        if whole:
            now.whole_us = scan.end_us
            self.taring.offer(scan, measurable, measured.middle_s)
        return measured

    def _bridge(self, skin: TaredSkin, measured: Observation, gap_s: float) -> None:
        """The time since the scan before: that a baseline was kept, or that scans were lost."""
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

    def _glanced(self, skin: TaredSkin, measured: Observation) -> Seen | None:
        """What a first look sees where nothing touched before; None where it cannot tell."""
        scan, oldest_s, known = measured.scan, measured.oldest_s, self._information
        if known is None or len(skin.touches) or not self._complete(skin, measured.live):
            return None
        if not skin.faults.plain(oldest_s) or (measured.whole and skin.drift.remembers(measured.middle_s)):
            return None
        y = self._innovation(skin, measured)
        alike, sure = skin.noise.alike(scan.part), skin.drift.common_mode_variance(measured.middle_s)
        return skin.null_gate.look(alike, scan, measured.middle_s, y, known.each, sure)

    def _came_slowly(self, skin: TaredSkin, measured: Observation) -> tuple[Innovation, ScoredAnswer] | None:
        """A touch where nothing touched, that no drift since a while ago explains: the filter is that of then."""
        middle_s, live = measured.middle_s, measured.live
        if len(skin.touches) or self.now.unexplained_s or not self._complete(skin, live) or not measured.whole:
            return None
        if not (skin.faults.plain(measured.oldest_s) and self._tables.predicted):
            return None
        then = skin.slow_onset.due(middle_s)
        if then is None:
            return None
        predicted = then.predict(middle_s, skin.noise.now.flicker)
        covariance = skin.noise.covariance(measured.scan.part) + predicted.covariance
        covariance += then.inflated_process_noise(n.SLOW_TIMES)
        leave_out(covariance, live)
        y = np.where(live, measured.log_z - skin.log_z0 - predicted.shift, 0.0)
        information = skin.hypotheses.grid.information(Whitening.of(covariance))
        innovation = measured.innovation(y, covariance, live, information, ())
        answer = skin.hypotheses.slow_onset(innovation)
        if answer is None:
            return None
        skin.drift.now = then.now
        skin.learning.doubt()
        skin.forget_gates()
        return innovation, answer

    def _complete(self, skin: TaredSkin, live: NDArray[np.bool_]) -> bool:
        """Whether every measurement that the baseline has counts."""
        return bool((live == skin.live).all())

    def _innovation(self, skin: TaredSkin, measured: Observation) -> Array:
        """(K,) log |Z| over what the filter predicts of the untouched skin on this board; 0 where it does not count."""
        over = measured.log_z - skin.log_z0 - skin.drift.shift(measured.middle_s)
        return np.where(measured.live, skin.faults.taken_off(over), 0.0)

    def _quiet(self, skin: TaredSkin, measured: Observation, seen: Seen, judgements: list[Judgement]) -> Estimate:
        self._explained(skin, measured, AS_IT_IS)
        skin.remember(skin.refused.explained(measured.oldest_s))
        if measured.whole:
            measured = replace(measured, log_z=skin.log_z0 + skin.faults.taken_off(measured.log_z - skin.log_z0))
        self._learn_untouched(skin, measured, seen.weighted_residual, AS_IT_IS)
        self.now.published, self.now.candidates = (), []
        return self._estimate(measured, seen.y, np.zeros(len(seen.y)), judgements, seen.z2, 0.0)

    def _noticed(self, measured: Observation, seen: Seen, judgements: list[Judgement]) -> Estimate:
        """Something begins. Its first few values tell no place that could be shown, and asking what they are takes
        longer than the next part, which tells: it is asked about.
        """
        self.now.noticed = True
        return self._estimate(measured, seen.y, np.zeros(len(seen.y)), judgements, seen.z2, 1.0)

    def _going_on(self, skin: TaredSkin, measured: Observation) -> tuple[Innovation, ScoredAnswer] | None:
        """That touches which stayed as they are do so in a further part of a scan; else None."""
        middle_s, span_s, information = measured.middle_s, measured.span_s, self._information
        if measured.whole or information is None or not skin.touches.steady or self.now.unexplained_s:
            return None
        if not skin.faults.plain(measured.oldest_s) or not self._complete(skin, measured.live):
            return None
        known = skin.null_gate.held(skin.noise.alike(measured.scan.part), middle_s, skin.touches.ids)
        if known is None:
            return None
        y = self._innovation(skin, measured)
        innovation = measured.innovation(y, known.covariance, measured.live, information.each, ())
        answer = skin.hypotheses.goes_on(innovation, skin.touches.expected(middle_s, span_s), known.white, known.turned)
        return (innovation, answer) if answer.explained and answer.next_touch_z2 < n.GLANCE_Z2 else None

    def _held(
        self,
        skin: TaredSkin,
        measured: Observation,
        innovation: Innovation,
        answer: ScoredAnswer,
        judgements: list[Judgement],
    ) -> Estimate:
        update_tracks(skin, innovation, answer, measured, self.now.unexplained_s)
        self._explained(skin, measured, answer.cause)
        return self._publish(skin, measured, innovation, answer, judgements, explained=True)

    def _asked(self, skin: TaredSkin, measured: Observation, passed_s: float, judgements: list[Judgement]) -> Estimate:
        self._drop_tracks(skin, measured)
        asked = self._explain(skin, measured)
        innovation, answer, view = asked.innovation, asked.answer, asked.view
        measured = replace(measured, log_z=view.at.untouched + view.y, live=view.live)  # as sound wires would show it
        if answer.nearly_holds:
            update_tracks(skin, innovation, answer, measured, self.now.unexplained_s)
        transient = answer.fit is not None and not len(skin.touches)  # it came and went within the scan
        self._update_lock(skin, measured, asked, transient)
        self._keep_candidates(skin, measured, answer)
        self._keep_whitening(skin, measured, asked)
        skin.faults.follow(view, answer, passed_s, measured.whole)
        sound = skin.faults.sound
        skin.isolation.decide(asked)
        if sound:
            self._learn(skin, measured, asked)
        if sound and answer.fit is not None:
            innovation = replace(innovation, y=innovation.y - _drifted(asked))
        judgements += self._judged(skin, measured, asked)
        return self._publish(skin, measured, innovation, answer, judgements, answer.holds and not transient)

    def _drop_tracks(self, skin: TaredSkin, measured: Observation) -> None:
        """Those that ended before this scan, and those that a part told badly: it is asked about them anew."""
        skin.touches.drop_ended(measured.oldest_s)
        if vague := skin.touches.drop_tentative(skin.faults.in_question):
            self.now.candidates = [OpenTouch(track.state, track.since_s) for track in vague]

    def _explain(self, skin: TaredSkin, measured: Observation) -> Explanation:
        """What explains a scan, with all that the skin may remember."""
        steps = skin.faults.now.gain_steps
        asked = self._likeliest_age(skin, measured)
        if asked.answer.holds and (pressed := skin.refused.explained(measured.oldest_s)):
            skin.remember(pressed)
            asked = self._explaining(skin, measured)  # again: what is left may be memory
        if skin.faults.now.gain_steps > steps:
            skin.learning.stepped()
        return asked

    def _likeliest_age(self, skin: TaredSkin, measured: Observation) -> Explanation:
        """What explains a scan: the first one after a baseline was adopted tells how far the skin has drifted. In doubt
        further: who takes drift for a touch is worse off than who is unsure.
        """
        if len(skin.aged) < 2:
            return self._explaining(skin, measured)
        found, faults, budget = [], skin.faults.now, measured.budget.left
        for state in skin.aged:
            skin.drift.now, skin.faults.now, self._information = state, deepcopy(faults), None
            measured.budget.left = budget
            found.append((self._explaining(skin, measured), state, skin.faults.now))
        holding = [each for each in found if each[0].answer.holds] or found
        best = max((each[0].answer for each in holding), key=lambda answer: answer.score)
        nearly = [each for each in holding if _nearly_as_likely(each[0].answer, best)]
        asked, skin.drift.now, skin.faults.now = nearly[-1]
        skin.aged = []
        return asked

    def _explaining(self, skin: TaredSkin, measured: Observation) -> Explanation:
        predicted = skin.drift.predict(measured.middle_s, skin.noise.now.flicker)
        own = measured.scan, measured.log_z, measured.live, measured.whole, measured.budget
        selection = HypothesisSelection(self._tables, skin, measured, predicted, self.now.unexplained_s)
        return skin.isolation(
            PredictedScan(*own, predicted, skin.log_z0 + predicted.shift),
            lambda hypotheses, view, covariance: self._scan_innovation(hypotheses, skin, view, covariance, measured),
            selection.answer,
            selection.recounted,
        )

    def _scan_innovation(
        self, hypotheses: Hypotheses, skin: TaredSkin, view: BoardView, covariance: Array, measured: Observation
    ) -> Innovation:
        now, known, wire = self.now, self._information, skin.faults.now.wire
        same = known is not None and np.array_equal(known.live, view.live) and known.wire == wire
        if known is None or not same or now.wholes - known.wholes >= n.LINE_SCANS:
            each = hypotheses.grid.information(Whitening.of(covariance))
            known = self._information = GridInformation(each, now.wholes, view.live, wire)
        candidates = tuple(candidate.begun(measured) for candidate in now.candidates)
        ids = skin.touches.ids
        places = tuple(ids.index(each.id) if each.id in ids else -1 for each in now.candidates)
        innovation = measured.innovation(view.y, covariance, view.live, known.each, candidates, places)
        return innovation.leaving(n.FOR_FAULTS)

    # --- what follows ---

    def _update_lock(self, skin: TaredSkin, measured: Observation, asked: Explanation, transient: bool) -> None:
        """Whether the skin is still followed: explained, or for how long it has not been."""
        innovation, answer = asked.innovation, asked.answer
        if transient or not answer.nearly_holds:
            self._refused(skin, measured, innovation.y)
            if not answer.nearly_holds and _strange(innovation, answer):
                self.now.unexplained_s = max(self.now.unexplained_s, float(n.CHANGING_S))
        elif answer.fit is None or any(track.confirmed for track in skin.touches.now.tracks):
            self._explained(skin, measured, answer.cause, roughly=not answer.holds)
        elif measured.whole:  # a touch that comes again and again, and never for sure, is none
            self.now.unexplained_s += measured.span_s

    def _keep_candidates(self, skin: TaredSkin, measured: Observation, answer: ScoredAnswer) -> None:
        """Touches that nearly explain a scan, for the next one."""
        if answer.nearly_holds:
            self.now.candidates = []
        elif answer.fit is not None:  # else no touch was looked for
            ids = [skin.touches.ids[place] if place >= 0 else 0 for place in answer.association]
            found = zip(answer.fit.states, answer.fit.priors, ids, strict=True)
            self.now.candidates = [OpenTouch(state, measured.middle_s + each.since_s, id) for state, each, id in found]

    def _keep_whitening(self, skin: TaredSkin, measured: Observation, asked: Explanation) -> None:
        """For quick looks at the next scans, where nothing is wrong."""
        plain = asked.answer.holds and not asked.changed and skin.faults.plain(measured.oldest_s)
        if plain and self._complete(skin, measured.live):
            common_mode_variance, alike = (
                skin.drift.common_mode_variance(measured.middle_s),
                skin.noise.alike(measured.scan.part),
            )
            skin.null_gate.keep(
                alike, measured.middle_s, skin.touches.ids, asked.innovation, asked.answer, common_mode_variance
            )

    def _explained(self, skin: TaredSkin, measured: Observation, cause: str, roughly: bool = False) -> None:
        self.now.unexplained_s = 0.0
        skin.touches.now.watched = True
        if not roughly:
            skin.faults.gain_holds(measured.end_s)
        if cause == AS_IT_IS:
            skin.hypotheses.process_noise_scale = 1.0

    def _refused(self, skin: TaredSkin, measured: Observation, y: Array) -> None:
        """Nothing explains it: the longer that lasts, the further the skin may have drifted. y (K,): log |Z| over what
        is predicted of the untouched skin.
        """
        skin.learning.doubt()
        if not measured.whole:
            return
        skin.refused.refuse(y, measured.span_s)
        self.now.unexplained_s += measured.span_s
        if self._tables.predicted and self.now.unexplained_s > n.CHANGING_S:
            skin.hypotheses.process_noise_scale = min(n.MOST_ADRIFT, skin.hypotheses.process_noise_scale * n.ADRIFT)

    def _learn(self, skin: TaredSkin, measured: Observation, asked: Explanation) -> None:
        """From untouched scans all, while touched what the touches leave open, now and then: what their response gets
        wrong is the same from scan to scan. Nothing where a contact or the gain changes: the rest is off by what its
        size was expected to be.
        """
        answer, view, predicted = asked.answer, asked.view, asked.view.at.predicted
        if not answer.holds or asked.changed or view.contact >= 0 or skin.faults.gain_gross(measured.end_s):
            return
        if answer.fit is None:
            self._learn_untouched(skin, measured, answer.weighted_residual, answer.cause)
            return
        skin.learning.doubt()
        if not measured.whole:
            return
        self.now.wholes += 1
        if answer.cause != AS_IT_IS or not measured.scan.believed:
            return
        skin.noise.learn_contacts(answer.weighted_residual, answer.white)
        due = predicted.at_s - skin.drift.now.at_s > n.TOUCHED_LEARNS_S
        same = len(predicted.x) == len(skin.drift.now.x)  # nothing has ended or slid away
        if due and same and not answer.recounted and self._complete(skin, measured.live):
            skin.drift.update_beside_touches(predicted, answer.fit, view.grown)
            skin.forget_gates()

    def _learn_untouched(self, skin: TaredSkin, measured: Observation, weighted_residual: Array, cause: str) -> None:
        if not measured.scan.believed:
            return
        if cause == MEMORY and measured.whole:
            skin.drift.widen_memories()
            skin.forget_gates()
        if self._complete(skin, measured.live):
            odd = cause in (BURST, NOISE)
            skin.noise.hear(weighted_residual, measured.scan.part, odd, measured.middle_s, measured.span_s)
        if not measured.whole:
            return
        self.now.wholes += 1
        if cause in (AS_IT_IS, DRIFT, MEMORY):
            over = measured.log_z - skin.log_z0
            drifts = skin.hypotheses.process_noise_scale if cause == DRIFT else 0.0
            if drifts:
                skin.forget_gates()
            waiting = PendingScan(measured.middle_s, over, measured.live, measured.scan.part, drifts)
            skin.learning.untouched(waiting)
            skin.slow_onset.keep()

    # --- what is said ---

    def _judged(self, skin: TaredSkin, measured: Observation, asked: Explanation) -> list[Judgement]:
        """What the board and lost scans leave of a scan's word."""
        faults, failed = skin.faults, float(asked.view.failed.mean())
        return [
            *advice.judgements_of(faults.states(), measured.scan.status, failed, faults.now.doubt.undecided),
            judge("gap", float(skin.touches.lost), 1.0),
            judge("gain", float(faults.gain_stepped(measured.oldest_s)), 1.0),
            judge("gain_gross", float(faults.gain_gross(measured.end_s)), 1.0),
            judge("seen", n.LEAST_LIVE, max(float(measured.live.mean()), 1e-3)),
        ]

    def _publish(
        self,
        skin: TaredSkin,
        measured: Observation,
        innovation: Innovation,
        answer: ScoredAnswer,
        judgements: list[Judgement],
        explained: bool,
    ) -> Estimate:
        self.now.published = self._touches_published(skin, measured, innovation, answer)
        self.now.published_ns = measured.scan.sample_ns
        unsure = any(not track.confirmed for track in skin.touches.now.tracks)
        sigma = np.sqrt(np.diag(innovation.covariance))
        changing = float(self._tables.predicted and (unsure or not explained))
        felt = max(_felt(skin.touches, answer))
        if answer.fit is not None and not self._tables.predicted:
            felt = max(felt, skin.hypotheses.untouched(innovation).next_touch_z2)
        return self._estimate(measured, innovation.y, sigma, judgements, felt, changing)

    def _touches_published(
        self, skin: TaredSkin, measured: Observation, innovation: Innovation, answer: ScoredAnswer
    ) -> tuple[TouchEstimate, ...]:
        """The confirmed tracks; roughly, those that were said last where nothing tells how they go on, or whether they
        are one.
        """
        sample_ns, now = measured.scan.sample_ns, skin.touches.now
        passed_s = (sample_ns - self.now.published_ns) * 1e-9
        if not answer.nearly_holds:
            return tuple(coasted(touch, passed_s) for touch in self.now.published)
        unexplained = float(np.linalg.norm(answer.left)) / max(float(np.linalg.norm(innovation.y)), 1e-12)
        sample_s = sample_ns * 1e-9
        lasting = [track for track in now.tracks if track.confirmed and track.acts_at(sample_s)]
        open_ids = [track.id for track in (*now.tracks, *now.dropped) if not track.confirmed]
        return (
            *(estimate_of(track, sample_s, measured.span_s, unexplained) for track in lasting),
            *(coasted(touch, passed_s) for touch in self.now.published if touch.id in open_ids),
        )

    def _estimate(
        self,
        measured: Observation,
        difference: Array,
        sigma: Array,
        judgements: list[Judgement],
        z2: float,
        changing: float,
    ) -> Estimate:
        said = self.now.published
        if measured.whole:
            self.taring.saw(bool(said) or z2 >= n.FALSE_ALARM_Z2)
        judgements.append(judge("touch", max([z2, *(touch.z2 for touch in said)]), n.FALSE_ALARM_Z2))
        alone = measured.scan.separate and not said  # no further row tells whether anything touches
        judgements.append(judge("changing", changing, 1.0, turned=Verdict.REFUSE if alone else None))
        told = judge("explained", self.now.unexplained_s, n.CHANGING_S)
        judgements.append(told if self._tables.predicted else told._replace(verdict=Verdict.CANNOT))
        electrodes = np.zeros(self._tables.electrodes, np.uint8) if self.skin is None else self.skin.faults.states()
        return Estimate(
            measured.scan, measured.whole, said, electrodes, measured.live, difference, sigma, tuple(judgements)
        )

    def _unknown(self, measured: Observation, judgements: list[Judgement]) -> Estimate:
        """There is no baseline."""
        nothing, electrodes = np.zeros(self._tables.measurements), np.zeros(self._tables.electrodes, np.uint8)
        if (wire := self.wire) is not None:
            electrodes = advice.states_of(len(electrodes), wire, (), -1, silent=False)
            judgements = judgements + advice.judgements_of(electrodes, measured.scan.status, 0.0, undecided=False)
        return Estimate(
            measured.scan, measured.whole, (), electrodes, measured.live, nothing, nothing, tuple(judgements)
        )


def _nearly_as_likely(older: ScoredAnswer, likeliest: ScoredAnswer) -> bool:
    """Whether an answer of an older baseline is to be preferred: it may be less likely, the more touches it saves."""
    return older.score >= likeliest.score - n.YOUNGER * max(1, likeliest.count - older.count)


def _strange(innovation: Innovation, answer: ScoredAnswer) -> bool:
    """Whether a scan is none of a touch: the likeliest ones leave most of it, whatever they look like."""
    left, whole = (float(np.sum(answer.white(each) ** 2)) for each in (answer.left, innovation.y))
    return left > n.STRANGE * whole


def _drifted(asked: Explanation) -> Array:
    """(K,) what drifted under touches, as far as the scan tells it."""
    view, grown = asked.view, asked.view.grown
    return np.where(view.live, grown * (view.at.predicted.covariance @ (grown * asked.answer.weighted_residual)), 0.0)


def _felt(touches: TouchTracks, answer: ScoredAnswer) -> list[float]:
    """Squared sigmas of what an answer leaves, and of the touches that explain the scan, or would."""
    left = answer.next_touch_z2 / (max(1.0, answer.chi2) if answer.quiet else 1.0)
    if answer.fit is None or answer.nearly_holds:
        return [left, *(track.z2 for track in touches.lasting)]
    variance = np.diag(answer.fit.covariance)[ACTION::STATES]
    return [left, *(answer.fit.states[:, ACTION] ** 2 / np.maximum(variance, 1e-18))]
