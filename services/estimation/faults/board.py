"""What is wrong with the board of one skin, from scan to scan: what it makes of the values, and how it is found out.

Wires show what a map makes of the sound skin; a changed contact impedance and the gain are part of the prediction, with
columns for what is not known of them. Each has a way back: the wires are asked again whenever a scan is not explained,
a contact walks, and a fault that explains nothing is dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.arrays import Array, Mask
from models.measurement.fit import LEAST_MEAN
from models.measurement.noise import NoiseModel
from models.measurement.numbers import SCAN_S
from models.measurement.tables import SkinTables
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, RATE, STATES, VELOCITY
from models.measurement.whitening import Whitening, leave_out
from services.estimation.faults import advice, wires
from services.estimation.faults.contact_state import JUMP, ContactState
from services.estimation.faults.impedance import MOST_LOG, Change, ContactColumns, Unexplained, gain_changes
from services.estimation.faults.wires import BoardScan, WireFault, WireKind, WireMaps
from services.estimation.filter import Prediction
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, Observation, ScoredAnswer
from services.estimation.values import numbers as n

Ask = Callable[[Innovation, Change, bool], ScoredAnswer]


@dataclass
class FaultState:
    """All that changes. Times are seconds of the host's clock."""

    settled: Annotated[Array, "E"]  # changes of contact impedances that the skin has for good
    wire: WireFault | None = None
    wire_since_s: float = -np.inf
    opens: tuple[int, ...] = ()
    lifted: tuple[int, ...] = ()  # of them those that are off the skin, where nothing leads past them any more
    silent: bool = False  # no electrode answers
    contact: int = -1  # electrode whose contact impedance is changed
    size: float = 0.0
    variance: float = 0.0
    size_before: float = 0.0  # of what was measured before
    contact_since_s: float = -np.inf
    still_s: float = 0.0  # for which it has been as `still_size`
    still_size: float = 0.0
    back_scans: int = 0
    log_gain: float = 0.0  # since the tare
    log_gain_before: float = 0.0  # of what was measured before
    gain_since_s: float = -np.inf
    gain_found_s: float = -np.inf  # end of the scan in which it was found
    gain_steps: int = 0
    log_gain_held: float = 0.0  # with which a scan was last explained that did not change it itself
    log_gain_sound: float = 0.0  # before a gross step
    gross_since_s: float = np.inf  # no sound board's gain is as this one since then; inf: it is
    unexplained_scans: int = 0
    doubt: ContactState = field(default_factory=ContactState)  # of the changed contact
    earlier: Annotated[Array | None, "K"] = None  # what was left of log |Z| two full scans before what is in doubt
    before: Annotated[Array | None, "K"] = None  # in the scan before: it may have begun in it


@dataclass(frozen=True)
class BoardView:
    """One scan through the board."""

    at: Observation
    predicted: Prediction
    untouched: Array  # (K,) log |Z| as the filter predicts it
    sound: Array  # (K,) what a board with sound wires would show, untouched
    failed: Mask
    live: Mask
    shown: Array  # (K,) what this one shows
    slopes: Array | None  # (K, K) of that to `sound`; None: the same
    mean: Array  # (K,) relative change by contact impedances
    spread: Array  # (K, n) columns of unit variance of what is not known of it, the changed contact's own first
    contact: int  # electrode whose contact impedance is changed, as far as is known before; -1: none
    apart: bool  # `shown` is without contact impedances that changed
    opens: tuple[int, ...]  # as in FaultState, of this scan
    lifted: tuple[int, ...]
    silent: bool

    @property
    def y(self) -> Array:
        """(K,) log |Z| over what is predicted without touches."""
        left = self.at.log_z - self.shown
        if self.apart:
            left = np.log1p(np.maximum(np.expm1(np.minimum(left, MOST_LOG)) - self.mean, LEAST_MEAN))
        return np.where(self.live, left, 0.0)

    def covariance(self, skin: Array, own: Array) -> Array:
        """(K, K) of y. skin: of what changes with the skin; own: of what the measurements add."""
        made: Array = self.through(skin) + own
        if self.apart:
            made = made * self.grown[:, None] * self.grown + self.spread @ self.spread.T
            made[np.diag_indices_from(made)] += (n.CONTACT_MISFIT * self.mean) ** 2
        leave_out(made, self.live)
        return made

    @property
    def grown(self) -> Array:
        """(K,) times what the skin changes by, in y."""
        return 1 + self.mean if self.apart else np.ones_like(self.mean)

    def through(self, covariance: Array) -> Array:
        """(K, K) of the skin's log |Z|, as the wires show it."""
        return covariance if self.slopes is None else np.asarray(self.slopes @ covariance @ self.slopes.T)


@dataclass(frozen=True)
class Explanation:
    """What explains a scan."""

    view: BoardView
    innovation: Innovation
    answer: ScoredAnswer
    changed: bool = False  # a fault was found: the next scan is the first that it is taken off


class BoardFaults:
    """Of one skin."""

    def __init__(self, tables: SkinTables, any_touch: Array, known: Mask, noise: NoiseModel) -> None:
        """any_touch (K, K): covariance of log |Z| over touches that may be anywhere. known (K,): measurements that the
        baseline has; the others count not, whatever they show. noise: of the same skin, contacts that jump included.
        """
        self._any_touch, self._known, self._noise = any_touch, known, noise
        self.member = wires.members(tables.pattern)
        self.maps = WireMaps(tables.pattern)
        self._columns = ContactColumns.of(tables)
        self._predicted, self._tells = tables.predicted, tables.tells
        self._places = tables.places
        self.now = FaultState(np.zeros(tables.electrodes))

    @property
    def columns(self) -> ContactColumns:
        return replace(self._columns, settled=self.now.settled)

    @property
    def exchanged(self) -> bool:
        """Whether wires are exchanged: every measurement is there, in another's place."""
        return self.now.wire is not None and self.now.wire.kind is WireKind.EXCHANGED

    def plain(self, oldest_s: float) -> bool:
        """Whether nothing is wrong but what the skin has for good, since the oldest value of a scan."""
        now = self.now
        if not self.sound or self.gain_gross(oldest_s):
            return False
        return oldest_s > max(now.gain_since_s, now.gain_found_s, now.wire_since_s)

    def taken_off(self, over: Array) -> Array:
        """(K,) log |Z| over an untouched skin without what the board and contacts have for good. over (K,)."""
        left = over - self.now.log_gain
        if self.now.settled.any():
            left = np.log1p(np.maximum(np.expm1(left) - self.columns.settled_mean(), LEAST_MEAN))
        return np.asarray(left)

    # --- what it makes of a scan ---

    def look(self, at: Observation, predicted: Prediction, untouched: Array, lifted: tuple[int, ...]) -> BoardView:
        """untouched (K,): log |Z| as the filter predicts it; lifted: of open electrodes those that are off the skin."""
        now, at_s = self.now, at.middle_s + at.times_s
        sound = untouched + np.where(at_s >= now.gain_since_s, now.log_gain, now.log_gain_before)
        mean, spread = self._contacts(at_s, 2 * at.times_s / at.span_s)
        shown, slopes, apart = sound, None, True
        if now.wire is None:
            failed = dead = self._known & (~at.live | (np.abs(at.log_z - sound - np.log1p(mean)) > MOST_LOG))
            silent = bool(failed.mean() >= n.SILENT)
            opens = () if silent else wires.open_electrodes(failed, self.member)
            lifted = tuple(k for k in lifted if k in opens)
            unshunted = self._columns.shunt[:, list(lifted)] * n.SHORT_WAY  # (K, n) no electrode shunts the sheet
            mean, spread = mean + unshunted.sum(axis=1), np.hstack([spread, n.SHORT_WAY_SD * unshunted])
        else:
            apart = self.exchanged  # each measurement is another's then, its contacts as well
            found = self.maps.one(now.wire, np.exp(sound if apart else sound + np.log1p(mean)))
            failed, dead = self._known & ~at.live, found.blind
            shown, slopes = np.log(np.maximum(found.values, n.TINY)), found.slopes
            if apart:
                mean, spread = found.slopes @ mean, found.slopes @ spread
            opens, lifted, silent = (), (), False  # what fails is left out: a wire that is wrong may be why
        dead = dead | (at_s < now.wire_since_s)  # measured by wires that were otherwise
        live = at.live & ~dead & ~self.member[:, list(opens)].any(axis=1)
        return BoardView(
            at=at,
            predicted=predicted,
            untouched=untouched,
            opens=opens,
            lifted=lifted,
            silent=silent,
            sound=sound,
            failed=failed,
            live=live,
            shown=shown,
            slopes=slopes,
            mean=mean,
            spread=spread,
            contact=now.contact,
            apart=apart,
        )

    def _contacts(self, at_s: Array, course: Array) -> tuple[Array, Array]:
        now, columns = self.now, self.columns
        mean = columns.settled_mean()
        if now.contact < 0:
            return mean, np.zeros((len(mean), 0))
        since = at_s >= now.contact_since_s
        after, before = columns.mean(now.contact, now.size), columns.mean(now.contact, now.size_before)
        spread = columns.spread(now.contact, now.size, np.sqrt(now.variance), course)
        begins = columns.begins(now.contact, now.size - now.size_before, now.contact_since_s, at_s)
        spread = np.hstack([spread * since[:, None], np.diag(begins)[:, begins > 0]])
        return mean + np.where(since, after, before), spread

    # --- wires ---

    def suspects_wires(self, view: BoardView) -> bool:
        """Whether it is worth asking if the wires have changed."""
        return view.failed.mean() < n.SILENT and self.maps.suspicious(self._wire_scan(view), self.now.wire)

    def wires_changed(self, view: BoardView, touched: Array, skin: Array, own: Array) -> bool:
        """Whether they changed. touched (K,): relative change by touches that stand; skin, own: as for `covariance`."""
        now, untouched = self.now, self._wire_scan(view)
        scan = replace(untouched, predicted=untouched.predicted + np.log1p(touched))
        found = self.maps.guesses(scan, now.wire, skin + self._any_touch, own)
        best, stands = found[0], next(guess for guess in found if guess.fault == now.wire)
        rival = max(guess.score for guess in found if guess.fault != best.fault)
        if best.fault == now.wire or best.score < max(stands.score + n.WIRE_SURE, rival + n.WIRE_APART):
            return False
        few = (self._known & (view.at.times_s >= best.since_s)).sum() < n.CHANGE_ROWS  # anything explains them
        if few or (now.wire is None and best.score < self._by_gain(view, touched, skin + own) + n.WIRE_APART):
            return False
        now.wire, now.wire_since_s = best.fault, view.at.middle_s + best.since_s
        return True

    def _by_gain(self, view: BoardView, touched: Array, covariance: Array) -> float:
        """Log evidence and prior of a step of the gain, before the scan or within it, whatever touches."""
        white = Whitening.of(covariance + self._any_touch)
        y = np.where(view.live, view.y - np.log1p(touched), 0.0)
        scan = Unexplained(y, np.ones_like(y), view.live, view.at.times_s, view.at.span_s, white)
        return max(change.score + change.log_prior for change in gain_changes(scan))

    def _wire_scan(self, view: BoardView) -> BoardScan:
        """As the wires are asked about it: what open electrodes explain tells nothing of the others' wires."""
        opens = wires.open_electrodes(view.failed, self.member)
        known = self._known & ~self.member[:, list(opens)].any(axis=1)
        return BoardScan(view.at.log_z, view.sound + np.log1p(view.mean), view.failed & known, known, view.at.times_s)

    # --- contact impedances and gain ---

    def asks(self, answer: ScoredAnswer) -> bool:
        """Whether what explains a scan may as well be a fault."""
        if self.now.wire is not None and not self.exchanged:
            return False
        if self.may_be_contacts(answer) or not answer.holds or answer.cause != AS_IT_IS:
            return True
        common = np.ones(len(answer.weighted_residual))
        return float(answer.weighted_residual.sum()) ** 2 / answer.information(common) > n.GAIN_Z2

    def explained_by_fault(
        self, without: Explanation, touched: Array, nearby: Array, ask: Ask, doubted: Array | None = None
    ) -> Explanation | None:
        """A contact or the gain that has changed, if that is likelier than what explains a scan without. touched (K,):
        relative change by touches that stand; nearby (K, K): covariance of what they may have changed by; ask: the
        likeliest touches beside a change, by an innovation that knows it; with all that there are only if it adds to
        what they explain. doubted (7,): a touch that stands and lies on an electrode: without it.
        """
        view, innovation, answer = without.view, without.innovation, without.answer
        if innovation.budget.left <= 0 or innovation.live.sum() < n.CHANGE_ROWS:
            return None  # what is left open is asked again with the scans that follow
        columns = self.columns
        if self.now.contact >= 0:  # about the contact that stands changed
            columns = columns.with_change(self.now.contact, self.now.size)
        if view.slopes is not None:
            columns = columns.through(view.slopes)
        changes = self._likeliest_changes(without, columns, touched, nearby)
        innovation = replace(innovation, keeps=0.0)
        odds = self._least_odds(answer) if doubted is None else n.LOG_PRIOR_TOUCH + n.LOG_PRIOR_SMALL * _small(doubted)
        best, least = None, answer.score + odds
        for k, change in enumerate(changes, 1):
            asked, column = self._given(innovation.leaving(1 - k / len(changes)), columns, change)
            goes_on = not change.is_gain and change.electrode == self.now.contact and self.began_within(view)
            log_prior = 0.0 if goes_on else change.log_prior
            found = ask(asked, change, _evidence_of(column, answer) + log_prior > 0)
            score = found.score + log_prior
            if score >= least and self._believed(change, column, found, score, answer):
                best, least = (change, column, asked, found), score
        if best is None:
            return None
        change, column, asked, found = best
        self._adopt(view, change, float(column @ found.weighted_residual), found)
        if not change.is_gain:
            self.now.doubt.beside = self._beside(change, found) or not found.holds
        return Explanation(view, asked, found, changed=True)

    def _believed(self, change: Change, column: Array, found: ScoredAnswer, score: float, answer: ScoredAnswer) -> bool:
        """Whether a change may be believed that is likely enough. column (K,): of unit variance of its size; found: the
        answer with it, and its score; answer: the one without.
        """
        if not self._apart(change, found):
            return False
        if self._beside(change, found) and score < answer.score + n.FAULT_SURE:
            return False  # a touch takes the contact along: both are not likelier for being seldom touches
        sigmas = abs(float(column @ found.weighted_residual))  # of its prior
        left = max(1 - found.information(column), 0.0)  # of the prior's variance
        least = n.GAIN_LEAST / n.GAIN_CHANGES if change.is_gain else n.SIGMAS * left**0.5
        if sigmas < least:  # the touches of the answer explain all of it
            return False
        return found.holds or (self._tells and found.chi2 < n.MOST and score > answer.score + n.WIRE_SURE)

    def _beside(self, change: Change, answer: ScoredAnswer) -> bool:
        """Whether a touch of the answer may change the contact impedance that is said to change."""
        if change.is_gain or answer.fit is None:
            return False
        return any(self._reaches(state, change.electrode) for state in answer.fit.states)

    def began_within(self, view: BoardView) -> bool:
        """Whether the contact's change began after the oldest value of a scan."""
        return self.now.contact_since_s > view.at.oldest_s

    def _least_odds(self, answer: ScoredAnswer) -> float:
        """By how much a fault must be likelier than an answer: small new touches on electrodes are seldom touches."""
        doubtful = 0
        if answer.fit is not None:
            for state, place in zip(answer.fit.states, answer.association, strict=True):
                doubtful += place < 0 and _small(state) and self.on_electrode(state)
        return n.LOG_PRIOR_SMALL * doubtful if doubtful else n.FAULT_SURE

    def on_electrode(self, state: Array) -> bool:
        """Whether the middle of a touch (7,) lies on an electrode."""
        return bool(self._distances(state).min() < n.ON_ELECTRODE)

    def in_question(self, state: Array) -> bool:
        """Whether a touch (7,) lies on an electrode whose contact impedance has changed, or is the touch."""
        now = self.now
        return now.contact >= 0 and now.doubt.undecided and self._reaches(state, now.contact)

    def _reaches(self, state: Array, electrode: int) -> bool:
        """Whether a touch (7,) may change the contact impedance of an electrode."""
        return bool(self._gaps(state)[electrode] < n.ON_ELECTRODE)

    def _distances(self, state: Array) -> Array:
        """(E,) from the middle of a touch (7,) to that of each electrode."""
        return np.asarray(np.hypot(*(state[PLACE] - self._places).T))

    def _gaps(self, state: Array) -> Array:
        """(E,) from the edge of a touch (7,) to the middle of each electrode."""
        return np.asarray(self._distances(state) - np.exp(state[LOG_RADIUS]))

    def may_be_contacts(self, answer: ScoredAnswer, electrodes: slice = slice(None)) -> list[int]:
        """New touches of an answer so near one of these electrodes that its contact impedance may look like them."""
        found = list[int]()
        for k, place in enumerate(answer.association):
            if place >= 0 or answer.fit is None:
                continue
            variance = np.diag(answer.fit.covariance)[STATES * k :][PLACE].sum()
            near = n.ON_ELECTRODE + n.SIGMAS * float(np.sqrt(max(variance, 0.0)))
            if (self._gaps(answer.fit.states[k])[electrodes] < near).any():
                found.append(k)
        return found

    def _likeliest_changes(
        self, without: Explanation, columns: ContactColumns, touched: Array, nearby: Array
    ) -> list[Change]:
        """At most three changes that may explain a scan: with the touches as they stand, with any touches, or, where
        nothing explains it, without those that stood; and whatever touches: a gain changes all measurements alike.
        """
        found, innovation, unexplained = list[Change](), without.innovation, not without.answer.holds
        any_touch = without.view.through(self._any_touch)
        tried = [(touched, nearby, float(n.MOST)), (touched, nearby + any_touch, np.inf)]
        if unexplained and touched.any():
            tried.insert(0, (np.zeros_like(touched), np.zeros_like(nearby), float(n.MOST)))
        for touched, more, most_chi2 in tried:
            y = np.where(innovation.live, innovation.y - np.log1p(touched), 0.0)
            white = Whitening.of(innovation.covariance + more) if more.any() else innovation.white
            scan = Unexplained(y, 1 / (1 + touched), innovation.live, innovation.times_s, innovation.span_s, white)
            best = max(self._changes(scan, columns), key=lambda change: change.score + change.log_prior)
            if (not best.is_gain and abs(best.size) > n.CONTACT_MOST) or scan.since(best.since_s).sum() < n.CHANGE_ROWS:
                continue
            likelier = best.score + best.log_prior > white.log_likelihood(y) and best.chi2 < most_chi2
            if likelier and best.electrode not in [change.electrode for change in found]:
                found.append(best)
        if unexplained and len(found) < 2 and not any(change.is_gain for change in found):
            found += gain_changes(scan)[:1]
        return found

    def _changes(self, scan: Unexplained, columns: ContactColumns) -> list[Change]:
        gains = gain_changes(scan)
        found = [gain for gain in gains if abs(gain.size) > n.GAIN_LEAST]
        if not self._predicted:
            return found or gains[:1]
        return [*found, *columns.likeliest(scan)]

    def _given(self, innovation: Innovation, of_contacts: ContactColumns, change: Change) -> tuple[Innovation, Array]:
        """The innovation beside a change of any size, and its column (K,) of unit variance."""
        acts = np.asarray(innovation.live & (innovation.times_s >= change.since_s), float)
        if change.is_gain:
            column = n.GAIN_CHANGES * acts
            return replace(innovation, covariance=innovation.covariance + np.outer(column, column)), column
        course = 2 * innovation.times_s / innovation.span_s
        y, columns = of_contacts.taken_off(innovation.y, acts, course, change)
        wider = innovation.covariance + columns @ columns.T
        begins = of_contacts.begins(change.electrode, change.size, change.since_s, innovation.times_s)
        misfit = n.CONTACT_MISFIT * acts * of_contacts.mean(change.electrode, change.size)
        wider[np.diag_indices_from(wider)] += misfit**2 + begins**2
        return replace(innovation, y=np.where(innovation.live, y, 0.0), covariance=wider), columns[:, 0]

    def _apart(self, change: Change, answer: ScoredAnswer) -> bool:
        """An electrode under a touch that changes is not named: what it does is the touch's. One that stood may change
        from now on where a scan is not explained.
        """
        if change.is_gain or answer.fit is None:
            return True
        acts = answer.fit.states[:, ACTION] ** 2 > n.ACTS_Z2 * np.diag(answer.fit.covariance)[ACTION::STATES]
        priors = answer.fit.priors
        for state, place, prior, there in zip(answer.fit.states, answer.association, priors, acts, strict=True):
            still = place >= 0 and float(prior.sd[VELOCITY].max()) * SCAN_S <= 2 * n.STILL_WAY and answer.holds
            if there and self._reaches(state, change.electrode) and not still:
                return False
        return True

    def _adopt(self, view: BoardView, change: Change, sigmas: float, found: ScoredAnswer) -> None:
        """sigmas: of its prior, by which it is off; found: the answer with it, and with what stood."""
        now, since_s = self.now, view.at.middle_s + change.since_s
        if change.is_gain:
            now.log_gain_before, now.gain_since_s = now.log_gain, since_s
            now.log_gain += n.GAIN_CHANGES * sigmas
            now.gain_found_s = view.at.end_s
            now.gain_steps += 1
            self._note_gross(max(since_s, view.at.oldest_s))
            return
        before = now.size if change.electrode == now.contact else 0.0
        if now.contact not in (-1, change.electrode):
            walk = n.CONTACT_BACK + n.CONTACT_WALK_CHANGED * abs(now.size)
            self._update_size(view, found)
            if well := abs(now.size - self._home) < walk:
                now.size = self._home
            if well or not (now.doubt.undecided or self.began_within(view)):  # else no scan confirmed it
                self._settle()
        if now.contact != change.electrode:
            now.doubt = ContactState(jumps=float(np.sqrt(self._noise.now.jumps[change.electrode])))
        now.contact, now.contact_since_s, now.size_before = change.electrode, since_s, before
        now.size = max(before + n.CONTACT_CHANGES * sigmas, self._least_size)
        if now.size > before and not now.doubt.undecided:
            now.doubt.change(before, now.size)
        elif self._impedance < 1 - n.CONTACT_STILL and 0 < before - now.size < n.TARE_JUMPS:  # as no touch makes it
            self._note_jump(before - now.size)
        now.variance = 4 * change.variance + (n.CONTACT_UNSURE * (1 + abs(now.size))) ** 2
        now.still_s, now.still_size, now.back_scans = 0.0, now.size, 0

    def _note_gross(self, since_s: float) -> None:
        """Whether a step of the gain is one that no sound board's makes, or the end of such a one."""
        now = self.now
        if abs(now.log_gain - now.log_gain_sound) < n.GAIN_BACK:
            now.gross_since_s = np.inf
        elif abs(now.log_gain - now.log_gain_before) > n.GAIN_GROSS:
            now.log_gain_sound, now.gross_since_s = now.log_gain_before, since_s
        elif now.gross_since_s == np.inf:
            now.log_gain_sound = now.log_gain

    # --- what follows ---

    def follow(self, view: BoardView, answer: ScoredAnswer, passed_s: float, whole: bool) -> None:
        """A changed contact goes on changing, is well again, or is the skin's own; what explains nothing goes."""
        now = self.now
        if not answer.holds:
            now.unexplained_scans += whole
            if now.unexplained_scans >= n.UNEXPLAINED_SCANS:
                now.wire, now.unexplained_scans = None, 0
                self.drop_contact()
                self._revert_gain()
            return
        now.unexplained_scans = 0
        self.remember(answer.residual, whole)
        if now.contact < 0:
            return
        self._update_size(view, answer)
        sd = float(np.sqrt(now.variance))
        unsure = n.CONTACT_BACK + n.SIGMAS * sd
        if whole and abs(now.size) < unsure and now.doubt.falls(now.size):  # a touch took it over, or it is well
            self.drop_contact()
            return
        home = self._home
        if whole:
            now.doubt.follow(view.at.middle_s, now.size, sd, home)
        self._time_still(passed_s)
        now.back_scans = (now.back_scans + whole) if abs(now.size - home) < unsure else 0
        now.variance += (n.CONTACT_WALK_CHANGED * self._impedance) ** 2 * min(passed_s / SCAN_S, 1.0)
        if view.at.middle_s < now.doubt.drifts_until_s:
            return
        settles_s = n.UNDECIDED_SETTLES_S if now.doubt.undecided else n.CONTACT_SETTLES_S
        if now.back_scans >= n.BACK_SCANS or now.doubt.stays(home):
            self._come_back(home)
        elif now.still_s > settles_s:
            now.size = now.doubt.lately(view.at.middle_s)  # one scan's is off by its noise, and nothing takes that back
            self._settle()

    def remember(self, residual: Array, whole: bool) -> None:
        """(K,) what is left of log |Z| in a scan that is explained."""
        if whole and not self.now.doubt.undecided:
            self.now.earlier, self.now.before = self.now.before, residual

    def gain_holds(self, end_s: float) -> None:
        """A scan that ends then is explained for sure with the gain as it is."""
        if self.now.gain_found_s < end_s:
            self.now.log_gain_held = self.now.log_gain

    def _revert_gain(self) -> None:
        """A step of the gain is taken back that no scan after it confirmed."""
        now = self.now
        if now.log_gain != now.log_gain_held:
            now.log_gain = now.log_gain_before = now.log_gain_held
            now.gain_since_s = -np.inf
            self._note_gross(now.gain_since_s)

    def _time_still(self, passed_s: float) -> None:
        """For how long it has been still: by its way, as steps from part to part are small however it drifts."""
        now = self.now
        now.still_s += passed_s
        moves = max(n.CONTACT_STILL * self._impedance, now.doubt.unsure) + n.PACE_UNSEEN * now.still_s
        if abs(now.size - now.still_size) > moves:
            now.still_s, now.still_size = 0.0, now.size

    def _update_size(self, view: BoardView, answer: ScoredAnswer) -> None:
        """The size of a contact that was known before this scan, by what the scan leaves."""
        now = self.now
        if view.contact == now.contact:
            column, sd = view.spread[:, 0], float(np.sqrt(now.variance))
            now.size = max(now.size + sd * float(column @ answer.weighted_residual), self._least_size)
            now.variance *= max(1 - answer.information(column), 1e-4)

    @property
    def _home(self) -> float:
        """The size nearest to its own with which it is well: as the skin has it, or as it was at the tare."""
        return min(0.0, -float(self.now.settled[self.now.contact]), key=lambda size: abs(self.now.size - size))

    @property
    def _impedance(self) -> float:
        """Of the changed contact, over that at the tare."""
        return 1 + float(self.now.settled[self.now.contact]) + self.now.size

    @property
    def _least_size(self) -> float:
        """Change of a contact that leaves hardly anything of its impedance."""
        return LEAST_MEAN * (1 + float(self.now.settled[self.now.contact]))

    def end_doubt(self, jumped: bool) -> None:
        """What has changed is the contact's, all of it. jumped: from one scan to the next."""
        if jumped:
            self._note_jump(self.now.size - self.now.doubt.decided)
        self.now.doubt.end(self.now.size)

    def _note_jump(self, size: float) -> None:
        """The changed contact jumped by so much."""
        self.now.doubt.jumps = max(self.now.doubt.jumps, size)
        self._noise.now.jumps[self.now.contact] = self.now.doubt.jumps**2

    def _come_back(self, home: float) -> None:
        """A contact is well again by itself. It jumps, if it did so at once, and by no more than a baseline's may."""
        sizes = [each.size - home for each in self.now.doubt.sizes] or [0.0]
        if max(sizes) * (1 - JUMP) < sizes[0] and max(sizes) < n.TARE_JUMPS:
            self._note_jump(max(sizes))
        self.now.size = home
        self._settle()

    def drop_contact(self) -> None:
        """No contact has changed."""
        now = self.now
        now.contact, now.size, now.variance, now.doubt = -1, 0.0, 0.0, ContactState()

    def _settle(self) -> None:
        """A changed contact is the skin's own from now on, be it as it was at the tare."""
        now = self.now
        now.settled = now.settled.copy()
        now.settled[now.contact] += now.size
        self.drop_contact()

    def states(self) -> NDArray[np.uint8]:
        """(E,) of the wire format."""
        now = self.now
        plain = abs(now.size) > n.CONTACT_PLAIN and not now.doubt.beside
        named = plain or not now.doubt.undecided or now.doubt.seen >= n.SURE_SCANS
        contact = now.contact if named else -1
        return advice.states_of(len(now.settled), now.wire, now.opens, contact, now.silent)

    def gain_stepped(self, oldest_s: float) -> bool:
        """Whether a scan whose oldest value is of then holds a step of the gain, or shows it first."""
        return oldest_s < max(self.now.gain_since_s, self.now.gain_found_s)

    def gain_gross(self, at_s: float) -> bool:
        """Whether the gain is as no sound board's, and has not lasted."""
        return self.now.gross_since_s <= at_s < self.now.gross_since_s + n.LOST_S

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong but what the skin has for good."""
        return self.now.wire is None and self.now.contact < 0 and not self.now.opens and not self.now.silent


def _small(state: Array) -> bool:
    """Whether a touch (7,) is as small as an electrode's contact impedance may look."""
    return bool(state[LOG_RADIUS] < np.log(n.SMALL))


def _evidence_of(column: Array, answer: ScoredAnswer) -> float:
    """[nat] that a column (K,) of unit variance adds to what an answer explains, all else linear."""
    information = answer.information(column)
    along = float(column @ answer.weighted_residual)
    return 0.5 * (along**2 / (1 + information) - float(np.log1p(information)))


def standing_covariance(slopes: Array, states: Array) -> Array:
    """(K, K) covariance of what touches that stand may have changed by since; slopes (K, 7 T), states (T, 7)."""
    sds = np.zeros_like(states)
    sds[:, PLACE] = n.STANDS_WAY
    sds[:, LOG_RADIUS] = n.STANDS_SHARE
    sds[:, ACTION] = n.STANDS_SHARE * np.abs(states[:, ACTION])
    sds[:, RATE] = n.STANDS_SHARE * np.abs(states[:, ACTION]) / SCAN_S
    sds[:, VELOCITY] = n.STANDS_WAY / SCAN_S
    scaled = slopes * sds.ravel()
    return np.asarray(scaled @ scaled.T)
