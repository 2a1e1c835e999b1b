"""TouchTracks from scan to scan: what is expected of each, what a fit made of it, when it has ended, and its number.

A window of a scan in parts holds values that were fitted before, so a touch carries no place nor force from fit to fit,
but where to start. What it carries as knowledge, its radius and its outline, it learns from scans that share no value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.course import SUDDEN_REACH_S
from models.measurement.fit import FoundTouches
from models.measurement.numbers import MOST_WAY
from models.measurement.responses.response import TouchModel
from models.measurement.touch import (
    ACTION,
    LOG_RADIUS,
    PLACE,
    RATE,
    SHAPE_SDS,
    STATES,
    VELOCITY,
    TouchPrior,
    X,
    Y,
    acting_steadily,
    anywhere,
    drop_of,
    is_anywhere,
    is_plain,
    within_limits,
)
from services.estimation.filter import Memory
from services.estimation.hypotheses.innovation import Observation
from services.estimation.overlap import TrackMotion, gaps
from services.estimation.values import numbers as n
from services.estimation.values.estimate import TouchEstimate

Array = NDArray[np.float64]


@dataclass
class TrackedTouch:
    """One touch. Times are seconds of the host's clock; `state` is of `at_s`."""

    id: int
    began: bool
    created_s: float
    at_s: float
    state: Annotated[Array, "states"]
    covariance: Annotated[Array, "states", "states"]
    log_radius: float  # as known from scans that share no value
    log_radius_sd: float
    shape: Annotated[Array, "shapes"]
    shape_variance: Annotated[Array, "shapes"]
    course: TrackMotion  # as known from scans that share no value
    steady_position: tuple[float, float, float] = (0.0, 0.0, np.inf)  # x, y while it stays, so known, and their sd
    steady_for: int = 0  # scans that are in it
    since_s: float = -np.inf  # it acts from then on
    until_s: float = np.inf  # it acted until then: it has ended, and the window still holds values of before
    at_once: bool = False  # so it ended
    turned_s: float = np.inf  # when how strongly it acts changed at once
    scans: int = 0  # that it was fitted to and that share no value
    still: int = 0  # of them, in a row: it neither moved nor changed
    moves: bool = False
    z2: float = 0.0  # how much it explains: squared sigmas of its action, in the middle of the scan or at its end
    confirmed: bool = False
    told_from_contact: bool = False  # several scans told it from a changed contact impedance
    lost: bool = False  # scans were lost since: it may be anywhere
    peak: float = 0.0  # action that it surely had
    surely: float = 0.0  # action that it has, at least, by the last fit
    jumped: bool = False  # the last fit has it elsewhere
    held: float = 0.0  # action before it began to go
    load: float = 0.0  # action that foam has felt of late
    load_s: float = 0.0  # by then
    held_at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y, log radius then
    stayed_since_s: float = 0.0  # at held_at
    asked_odd: float = 0.0  # how odd its outline was when it was asked last whether it is several

    @property
    def doubt_due(self) -> bool:
        """Whether it is time to ask what it is, as every touch is asked now and then."""
        return self.scans % n.DOUBT_SCANS == n.DOUBT_SCANS - 1

    @property
    def contact_due(self) -> bool:
        """Whether it is time to ask if it is an electrode's contact impedance: while it is new, and now and then."""
        return 0 < self.scans <= n.SURE_SCANS or self.doubt_due

    @property
    def weakened(self) -> bool:
        """Whether it is weak, and has changed: it may have gone, and left something else."""
        return self.z2 < n.DOUBT_Z2 and not self.still

    @property
    def ended(self) -> bool:
        return self.until_s < np.inf

    @property
    def place_sd(self) -> float:
        """By the last scan, of the coordinate that is known worse."""
        return float(np.sqrt(max(self.covariance[X, X], self.covariance[Y, Y], 0.0)))

    def acts_at(self, at_s: float) -> bool:
        """Whether it is there at an instant of the scan that it was fitted to: it may have ended after that."""
        left = float(self.state[ACTION] + self.state[RATE] * (at_s - self.at_s))
        return not self.ended or (at_s < self.until_s and left > n.ENDED * self.peak)


@dataclass
class TouchesState:
    """All that changes."""

    tracks: list[TrackedTouch] = field(default_factory=list)
    dropped: list[TrackedTouch] = field(default_factory=list)  # of late, as vague: what is found there anew is theirs
    next_id: int = 1
    watched: bool = True  # the scan before was looked at: what a scan shows now began meanwhile


class TouchTracks:
    """The tracks of one skin's touches: tentative, confirmed or ended."""

    def __init__(self, response: TouchModel) -> None:
        self._response = response
        self.now = TouchesState()

    def __len__(self) -> int:
        return len(self.now.tracks)

    @property
    def lasting(self) -> list[TrackedTouch]:
        return [track for track in self.now.tracks if not track.ended]

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(track.id for track in self.now.tracks)

    @property
    def steady(self) -> bool:
        """Whether there are touches, and all stay as they are."""
        tracks = self.now.tracks
        return bool(tracks) and all(
            t.confirmed and t.still >= n.STILL_SCANS and not (t.ended or t.lost) for t in tracks
        )

    @property
    def lost(self) -> bool:
        """Whether scans were lost, and none has been explained since."""
        return any(track.lost for track in self.now.tracks)

    @property
    def in_doubt(self) -> bool:
        """Whether it is time to ask what stands, as is done now and then."""
        return any(track.contact_due for track in self.lasting)

    @property
    def odd(self) -> bool:
        """Whether a touch may be several: while it is new, each time its outline became odder, and now and then.
        Asking makes it known.
        """
        found = False
        for track in self.lasting:
            odd = oddness(track.shape)
            again = odd > n.ODDER * track.asked_odd or track.doubt_due
            if (odd > n.ODD_OUTLINE and again) or track.scans in n.COUNT_DOUBTS:
                track.asked_odd, found = odd, True
        return found

    def correct(self, fit: FoundTouches, association: Sequence[int]) -> None:
        """Tracks stood for several touches, or for parts of one: they were never where they were held."""
        for place, track in enumerate(self.now.tracks):
            track.held = track.load = 0.0
            if place in association:
                state = fit.states[association.index(place)]
                track.held = track.load = track.peak = float(state[ACTION])
                track.held_at = (float(state[X]), float(state[Y]), float(state[LOG_RADIUS]))

    def lose(self) -> None:
        """Scans were lost: touches may be anywhere, or gone."""
        self.now.watched = False
        for track in self.now.tracks:
            track.lost, track.still = True, 0

    def drop_tentative(self, in_question: Callable[[Array], bool]) -> list[TrackedTouch]:
        """Forget what one part of a scan made of a touch that begins, and is not sure: the next one looks anew.
        in_question: whether a touch of that state may as well be a contact impedance. Returns those.
        """
        tracks = self.now.tracks
        self.now.tracks = [t for t in tracks if t.confirmed or (t.scans and not in_question(t.state))]
        vague = [t for t in tracks if all(t is not other for other in self.now.tracks)]
        self.now.dropped += vague
        return vague

    def forget(self, at_s: float) -> list[Memory]:
        """Nobody knows any more what touches. Returns what those that there were may have left in the foam."""
        memories = [memory for place in range(len(self)) for memory in self.released(place, at_s)]
        self.now.tracks, self.now.dropped = [], []
        return memories

    def drop_ended(self, oldest_s: float) -> None:
        """Forget what ended before the oldest value that a window holds, or was dropped and not found again."""
        self.now.tracks = [track for track in self.now.tracks if track.until_s > oldest_s - SUDDEN_REACH_S]
        self.now.dropped = [track for track in self.now.dropped if track.at_s > oldest_s - n.CHANGING_S]

    def expected(self, at_s: float, span_s: float, loose: bool = False) -> list[TouchPrior]:
        """What is known of each before a scan whose middle is at_s. loose: it may have begun to move or to change."""
        priors = [_expected(track, at_s, span_s, loose) for track in self.now.tracks]
        for place in () if loose else self.meeting(at_s):
            priors[place] = self.now.tracks[place].course.goes_on(priors[place], at_s)
        return priors

    def meeting(self, at_s: float) -> list[int]:
        """Which stood apart a moment ago, and are near each other."""
        tracks = self.now.tracks
        lasting = [
            k
            for k, track in enumerate(tracks)
            if not (track.ended or track.lost) and at_s - track.course.apart_s < n.MEET_S
        ]
        if len(lasting) < 2:
            return []
        reach = gaps([tracks[k].state for k in lasting]).min(axis=1)
        return [k for k, gap in zip(lasting, reach, strict=True) if gap < _radius(tracks[k])]

    def associated(self, fit: FoundTouches, association: Sequence[int]) -> tuple[int, ...]:
        """association, where touches that were found anew are those that were there before in the same places: also a
        part of one that is several by now.
        """
        free = [k for k, track in enumerate(self.now.tracks) if k not in association and not track.ended]
        found = list(association)
        for k, place in enumerate(association):
            near = [(_apart(self.now.tracks[f].state, fit.states[k]), f) for f in free]
            if place >= 0 or not near:
                continue
            nearest = min(near)[1]
            if _same_place(fit.states[k], self.now.tracks[nearest].state):
                found[k] = nearest
                free.remove(nearest)
        return tuple(found)

    def update(
        self, fit: FoundTouches, association: Sequence[int], measured: Observation, explained: bool
    ) -> list[Memory]:
        """Take over a fit. association: of each of its touches the track that it continues; -1: it is new. explained:
        by the fit; else it is only roughly right. Returns what touches that ended or moved away leave in the foam.
        """
        at_s, span_s, whole = measured.middle_s, measured.span_s, measured.whole
        before = self.now.tracks
        self.now.tracks = [
            before[place] if place >= 0 else self._new(fit, k, at_s) for k, place in enumerate(association)
        ]
        memories, meeting = list[Memory](), self.meeting(at_s)
        for k, track in enumerate(self.now.tracks):
            own = slice(STATES * k, STATES * (k + 1))
            self._take_prior(track, fit.priors[k], at_s)
            _update(track, fit.states[k], fit.covariance[own, own], at_s, span_s, whole)
            if whole and k not in meeting:  # what two have in common is no outline of one
                _learn(track, fit, k)
            if explained:
                memories += self._held(track, at_s, span_s, whole)
            memories += self._ending(k, fit.priors[k], at_s, span_s)
        if -1 in association:
            self._divide(association, fit.priors[association.index(-1)])
        self.now.tracks = [track for track in self.now.tracks if track.confirmed or not track.ended]
        if whole and explained:
            self._follow(at_s)
        return memories

    def _take_prior(self, track: TrackedTouch, prior: TouchPrior, at_s: float) -> None:
        """When it began, changed and ended, and whether it is the one that it was, as a fit around at_s took it."""
        if track.confirmed and is_anywhere(prior):  # found anew: it may be another one, or none
            track.scans = 0
        track.since_s, track.turned_s = at_s + prior.since_s, at_s + prior.turns_s
        if not track.ended:
            return
        track.until_s = at_s + prior.until_s
        if not track.ended:  # it goes on after all: that it ended was said
            track.id, self.now.next_id = self.now.next_id, self.now.next_id + 1

    def _ending(self, place: int, prior: TouchPrior, at_s: float, span_s: float) -> list[Memory]:
        """Whether a touch ended within the scan, by its fit or by what is left of it. Returns what it leaves."""
        track = self.now.tracks[place]
        if track.ended:
            return []
        if prior.until_s < np.inf:
            track.at_once = True
            return self.released(place, at_s + prior.until_s)
        if not _has_ended(track, span_s):
            return []
        track.at_once = track.turned_s < np.inf or -track.state[RATE] * span_s > n.GOES * track.held
        return self.released(place, at_s + span_s / 2)

    def _divide(self, association: Sequence[int], free: TouchPrior) -> None:
        """Those that have just come were taken for what now are two: of their radius and outline nothing is known but
        what any touch has, as a new one, `free`, has it.
        """
        for track, place in zip(self.now.tracks, association, strict=True):
            if place >= 0 and track.scans <= n.SURE_SCANS:
                track.log_radius, track.log_radius_sd = float(free.mean[LOG_RADIUS]), float(free.sd[LOG_RADIUS])
                track.shape, track.shape_variance = np.zeros(len(SHAPE_SDS)), SHAPE_SDS**2

    def _follow(self, at_s: float) -> None:
        tracks = self.lasting
        if not tracks:
            return
        for track, gap in zip(tracks, gaps([track.state for track in tracks]).min(axis=1), strict=True):
            track.course.follow(track.state, np.sqrt(np.maximum(np.diag(track.covariance), 0.0)), at_s)
            if gap > _radius(track) and track.confirmed and track.scans >= n.SURE_SCANS:  # by what it shows alone
                track.course.apart_s = at_s

    def tell(self, fit: FoundTouches, at_s: float, span_s: float) -> None:
        """What was taken for a changed contact impedance is this touch."""
        track = self._new(fit, 0, at_s)
        track.told_from_contact = track.confirmed = True
        _update(track, fit.states[0], fit.covariance[:STATES, :STATES], at_s, span_s, whole=True)
        self.now.tracks.append(track)

    def released(self, place: int, at_s: float) -> list[Memory]:
        """A touch ended at an instant within the scan; what it leaves."""
        track = self.now.tracks[place]
        if track.ended:
            return []
        track.until_s = at_s
        return self._memory(track, at_s, 1.0)

    def stay(self, fit: FoundTouches | None, association: Sequence[int]) -> bool:
        """Whether the tracks that a fit goes on with are where they were: one that moved away is another one."""
        if fit is None:
            return True
        found = zip(fit.states, association, strict=True)
        return all(_apart(self.now.tracks[place].state, state) < n.SAME_TOUCH for state, place in found)

    def remove(self, place: int) -> None:
        """It was none."""
        del self.now.tracks[place]

    def _new(self, fit: FoundTouches, k: int, at_s: float) -> TrackedTouch:
        prior, state = fit.priors[k], fit.states[k]
        again = next((track for track in self.now.dropped if _same_place(state, track.state)), None)
        if again is None:
            number, began, created_s = self.now.next_id, self.now.watched, at_s
            self.now.next_id += 1
        else:
            number, began, created_s = again.id, again.began, again.created_s
            self.now.dropped = [track for track in self.now.dropped if track is not again]
        return TrackedTouch(
            id=number,
            began=began,
            created_s=created_s,
            at_s=at_s,
            state=state,
            covariance=np.eye(STATES),
            log_radius=float(prior.mean[LOG_RADIUS]),
            log_radius_sd=float(prior.sd[LOG_RADIUS]),
            shape=np.zeros(len(SHAPE_SDS)),
            shape_variance=SHAPE_SDS**2,
            course=TrackMotion.begun(state, np.sqrt(np.diag(fit.covariance)[STATES * k : STATES * (k + 1)]), at_s),
            since_s=at_s + prior.since_s,
            held_at=(float(state[X]), float(state[Y]), float(state[LOG_RADIUS])),
            stayed_since_s=at_s,
        )

    def _memory(self, track: TrackedTouch, at_s: float, share: float) -> list[Memory]:
        if not track.confirmed or track.load <= 0:
            return []
        x, y, log_radius = track.held_at
        return [Memory(self._response(x, y, log_radius), share * track.load, at_s, x, y, log_radius)]

    def _held(self, track: TrackedTouch, at_s: float, span_s: float, whole: bool) -> list[Memory]:
        """Take note of what presses, and where. Of a touch that slid away returns what the place remembers where it
        stayed. A fit that does not explain its scan must not get here: it is anywhere while a touch is released.
        """
        if track.ended or (track.jumped and not whole):
            return []
        acts, now_s = float(track.state[ACTION]), at_s + span_s / 2
        goes = min(acts, float(acts + track.state[RATE] * span_s / 2)) <= n.GOES * track.held
        stayed_s = max(0.0, now_s - track.stayed_since_s)
        x, y, log_radius = track.held_at
        if np.hypot(track.state[X] - x, track.state[Y] - y) < n.MEMORY_APART * np.exp(log_radius):
            fades = 1 - float(np.exp((track.load_s - now_s) / n.MEMORY_FADES_S[0]))
            track.load, track.load_s = max(acts, track.load + fades * (acts - track.load)), now_s
            if not goes:
                track.held = acts
                _stay(track, span_s / (stayed_s + span_s) if whole else 0.0)
            return []
        share = 1.0 if goes else 1 - float(np.exp(-stayed_s / n.MEMORY_FADES_S[0]))
        memories = self._memory(track, now_s, share)
        track.stayed_since_s, track.held, track.load, track.load_s = now_s, acts, acts, now_s
        _stay(track, 1.0)
        return memories


def oddness(shape: Array) -> float:
    """How far an outline is from a disc's, in squared standard deviations of its prior."""
    return float((shape**2 / SHAPE_SDS**2).sum())


def _same_place(state: Array, other: Array) -> bool:
    """Whether a touch (7,) that was found anew is in the place of another one."""
    widest = max(state[LOG_RADIUS], other[LOG_RADIUS])
    return _apart(state, other) < max(n.SAME_TOUCH, float(np.exp(widest)))


def _apart(state: Array, other: Array) -> float:
    """Distance of the places of two states (7,) [unit]."""
    return float(np.hypot(*(state[PLACE] - other[PLACE])))


def _radius(track: TrackedTouch) -> float:
    return float(np.exp(track.state[LOG_RADIUS]))


def _stay(track: TrackedTouch, share: float) -> None:
    """The place where it stays is the mean of where it was since it came: one that followed it would never be left."""
    if track.scans <= 1:  # it has just come: places of before were rough
        share = 1.0
    here = (float(track.state[X]), float(track.state[Y]), float(track.state[LOG_RADIUS]))
    x, y, log_radius = (then + share * (now - then) for then, now in zip(track.held_at, here, strict=True))
    track.held_at = x, y, log_radius


def _expected(track: TrackedTouch, at_s: float, span_s: float, loose: bool) -> TouchPrior:
    passed_s = at_s - track.at_s
    state = track.state.copy()
    steady = track.still >= n.STILL_SCANS and not loose
    if track.moves:
        state[PLACE] += state[VELOCITY] * min(passed_s, 2 * span_s)
    else:
        state[VELOCITY] = 0.0
    if passed_s > span_s / 2:  # how a ramp goes on after a whole scan nobody knows
        state[ACTION] += state[RATE] * span_s / 2
        state[RATE] = 0.0
    else:
        state[ACTION] += state[RATE] * passed_s
    state[ACTION] = max(state[ACTION], 0.02 * track.peak, 1e-4)
    free = anywhere(0.0, 0.0, max(float(state[ACTION]), track.peak), span_s)
    mean, sd = free.mean.copy(), free.sd.copy()
    if not track.lost:
        known = 3 * float(np.sqrt(track.covariance[X, X] + track.covariance[Y, Y]))
        mean[PLACE], sd[PLACE] = state[PLACE], max(n.PLACE_MOVES * (1 + 3 * loose), known)
    sd[VELOCITY] = MOST_WAY / span_s
    if steady:
        sd[VELOCITY] = n.STILL_WAY / span_s
        sd[RATE] = n.STILL_CHANGE * max(float(state[ACTION]), 1e-3) / span_s
    mean[LOG_RADIUS], sd[LOG_RADIUS] = track.log_radius, track.log_radius_sd
    shape_sd = np.sqrt(np.minimum(track.shape_variance + (n.SHAPE_WALK * SHAPE_SDS) ** 2, SHAPE_SDS**2))
    state = within_limits(state[None])[0]
    if not track.moves and passed_s <= span_s / 2:  # most of the values are those that told its velocity
        state[VELOCITY] = track.state[VELOCITY]
    since_s, until_s, turns_s = track.since_s - at_s, track.until_s - at_s, track.turned_s - at_s
    prior = TouchPrior(state, mean, sd, track.shape, shape_sd, since_s, until_s, turns_s)
    return acting_steadily(prior, track.held, span_s) if track.at_once and track.held > 0 else prior


def _update(track: TrackedTouch, state: Array, covariance: Array, at_s: float, span_s: float, whole: bool) -> None:
    track.jumped = not (track.lost or track.ended) and _apart(track.state, state) > max(n.SAME_TOUCH, _radius(track))
    track.state, track.covariance, track.at_s, track.lost = state, covariance, at_s, False
    acts = [_action_at(state, covariance, after_s) for after_s in (0.0, span_s / 2)]
    track.z2 = max((max(action, 0.0) / sd) ** 2 for action, sd in acts)
    if track.ended:
        return
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    way, change = np.hypot(*state[VELOCITY]) * span_s, abs(state[RATE]) * span_s
    moves = way > max(n.STILL_WAY, 3 * float(np.hypot(*sd[VELOCITY])) * span_s)
    changes = change > max(n.STILL_CHANGE * abs(state[ACTION]), 3 * sd[RATE] * span_s)
    track.moves = bool(moves)
    if moves or changes:
        track.still = 0
    elif whole:
        track.still += 1
    track.scans += whole
    if whole:
        _follow_place(track)
    before, track.surely = track.surely, float(state[ACTION] - 2 * sd[ACTION])
    # The few new values of one part may be explained by any touch, also where none is the reason.
    track.peak = max(track.peak, track.surely if whole else min(before, track.surely))


def _follow_place(track: TrackedTouch) -> None:
    """One that stays is where all its scans say, weighed as they are sure of it."""
    (x, y), sd, known = track.state[PLACE], track.place_sd, np.hypot(track.steady_position[2], n.PLACE_WALK)
    if not _stays(track):
        track.steady_position, track.steady_for = (float(x), float(y), sd), 0
        return
    track.steady_for += 1
    share = known**2 / (known**2 + sd**2)
    (then_x, then_y), left = track.steady_position[:2], float(np.sqrt(share) * sd)
    track.steady_position = float(then_x + share * (x - then_x)), float(then_y + share * (y - then_y)), left


def _stays(track: TrackedTouch) -> bool:
    """Whether the last scan has it where it stayed."""
    off = float(np.hypot(*(track.state[PLACE] - track.steady_position[:2])))
    known = np.hypot(track.steady_position[2], n.PLACE_WALK)
    return bool(track.still >= n.STILL_SCANS and off < n.STAYS_WITHIN * np.hypot(known, track.place_sd))


def _learn(track: TrackedTouch, fit: FoundTouches, k: int) -> None:
    """Radius and outline, of a scan that shares no value with the one before."""
    sd = float(np.sqrt(max(fit.covariance[STATES * k + LOG_RADIUS, STATES * k + LOG_RADIUS], 0.0)))
    track.log_radius = float(fit.states[k, LOG_RADIUS])
    track.log_radius_sd = float(np.hypot(sd, n.RADIUS_WALK))
    track.shape, track.shape_variance = fit.shapes[k].copy(), fit.shape_variance[k].copy()
    if is_plain(fit.priors[k]):  # that of a disc was not asked
        track.shape_variance = SHAPE_SDS**2


def _action_at(state: Array, covariance: Array, after_s: float) -> tuple[float, float]:
    """Action and its standard deviation at an instant."""
    to_then = np.array([1.0, after_s])
    both = covariance[np.ix_([ACTION, RATE], [ACTION, RATE])]
    return float(to_then @ state[[ACTION, RATE]]), float(np.sqrt(max(to_then @ both @ to_then, 1e-18)))


def _has_ended(track: TrackedTouch, span_s: float) -> bool:
    """By what acts at the scan's end, never by the drop alone: its sigma is that of the radius."""
    left, sd = _action_at(track.state, track.covariance, span_s / 2)
    return left < n.ENDED * track.peak + (sd if left < 4 * n.ENDED * track.peak else 0.0)


def _bends(track: TrackedTouch, span_s: float) -> Array:
    """(7, 7) variance of what was linear in the fit and may have bent within the scan."""
    variance = np.zeros(STATES)
    if track.still < n.STILL_SCANS:
        variance[PLACE] = (n.BENDS * track.state[VELOCITY] * span_s) ** 2
        variance[ACTION] = (n.BENDS * track.state[RATE] * span_s) ** 2
    return np.diag(variance)


def estimate_of(track: TrackedTouch, sample_s: float, span_s: float, unexplained: float) -> TouchEstimate:
    """A touch as it is said: at the instant sample_s, with the covariance of that instant."""
    passed_s = sample_s - track.at_s
    carry = np.eye(STATES)
    carry[X, VELOCITY.start], carry[Y, VELOCITY.start + 1], carry[ACTION, RATE] = passed_s, passed_s, passed_s
    state, covariance = carry @ track.state, carry @ (track.covariance + _bends(track, span_s)) @ carry.T
    log_radius, action = float(state[LOG_RADIUS]), max(float(state[ACTION]), 0.0)
    strength = action / (np.pi * np.exp(2 * log_radius))
    drop = drop_of(action, log_radius)
    by_action = drop / max(action, 1e-12) / (1 + strength / 2)
    to_said = np.zeros((4, STATES))
    to_said[0, X] = to_said[1, Y] = to_said[2, LOG_RADIUS] = 1.0
    to_said[3, ACTION], to_said[3, LOG_RADIUS] = by_action, -2 * drop / (1 + strength / 2)
    said, place = to_said @ covariance @ to_said.T, state[PLACE]
    if track.steady_for >= n.STILL_SCANS and _stays(track):
        place = np.array(track.steady_position[:2])  # as sure as by one scan: what all of them get wrong is not known
    return TouchEstimate(
        id=track.id,
        began=track.began,
        age_s=sample_s - track.created_s,
        x=float(place[0]),
        y=float(place[1]),
        vx=0.0 if track.still >= n.STILL_SCANS else float(state[VELOCITY][0]),
        vy=0.0 if track.still >= n.STILL_SCANS else float(state[VELOCITY][1]),
        log_radius=log_radius,
        drop=drop,
        covariance=said,
        z2=track.z2,
        strength=action,
        strength_sd=float(np.sqrt(max(covariance[ACTION, ACTION], 0.0))),
        unexplained=unexplained,
    )


def coasted(touch: TouchEstimate, passed_s: float) -> TouchEstimate:
    """One that a scan changed so that nothing explains it, or that may be another one or several by now: that it is
    there, where roughly, and not how strongly.
    passed_s: since it was said last.
    """
    covariance = touch.covariance.copy()
    covariance[0, 0] += n.ROUGH**2
    covariance[1, 1] += n.ROUGH**2
    return replace(touch, age_s=touch.age_s + passed_s, covariance=covariance, strength_sd=touch.strength)
