"""The tracks of touches: which go on, begin or end with a fit, their numbers, and what they leave in the foam."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from models.measurement.arrays import Array
from models.measurement.course import SUDDEN_REACH_S
from models.measurement.fit import FoundTouches
from models.measurement.response import TouchModel
from models.measurement.touch import ACTION, LOG_RADIUS, RATE, SHAPE_SDS, STATES, TouchPrior, X, Y, is_anywhere
from services.estimation.filter import Memory
from services.estimation.hypotheses.innovation import Observation
from services.estimation.overlap import TrackMotion, gaps
from services.estimation.track import TrackedTouch, disc_of, distance, oddness, same_place
from services.estimation.values import numbers as n


@dataclass
class TouchesState:
    """All that changes."""

    tracks: list[TrackedTouch] = field(default_factory=list)
    dropped: list[TrackedTouch] = field(default_factory=list)  # of late, as vague: what is found there anew is theirs
    next_id: int = 1
    wide: bool = False  # they were explained by a response that is wrong by more than it should be
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
        return bool(tracks) and all(t.confirmed and t.steady and not (t.ended or t.lost) for t in tracks)

    @property
    def lost(self) -> bool:
        """Whether scans were lost, and none has been explained since."""
        return any(track.lost for track in self.now.tracks)

    @property
    def in_doubt(self) -> bool:
        """Whether it is time to ask what each of them is, as is done now and then."""
        return any(track.contact_due for track in self.lasting)

    def claim_recount(self) -> bool:
        """Whether to ask if one is several: while it is new, odder than before, now and then. It counts as asked."""
        due = False
        for track in self.lasting:
            odd = oddness(track.shape)
            again = odd > n.ODDER * track.asked_odd or track.doubt_due
            if (odd > n.ODD_OUTLINE and again) or track.scans in n.COUNT_DOUBTS:
                track.asked_odd, track.askings, due = odd, track.askings + 1, True
        return due

    @property
    def recount_gain(self) -> float:
        """Evidence [nat] of other touches: the more, the oftener it was asked, as each asking errs now and then."""
        askings = max((track.askings for track in self.lasting), default=0)
        return n.RECOUNT_GAIN + 2 * float(np.log(max(askings, 1)))

    def correct(self, fit: FoundTouches, association: Sequence[int]) -> None:
        """Tracks were taken for several touches, or for parts of one: what they pressed, and where, was never so."""
        for place, track in enumerate(self.now.tracks):
            track.held = track.load = 0.0
            if place in association:
                state = fit.states[association.index(place)]
                track.held = track.load = track.peak = float(state[ACTION])
                track.held_at = disc_of(state)

    def lose(self) -> None:
        """Scans were lost: touches may be anywhere, or gone."""
        self.now.watched = False
        for track in self.now.tracks:
            track.lost, track.still = True, 0

    def drop_tentative(self, in_question: Callable[[Array], bool]) -> list[TrackedTouch]:
        """Forget what one part of a scan made of a touch that begins, and is not sure: the next one looks anew.
        in_question: whether a touch of that state may as well be a contact impedance. Returns those.
        """

        def tentative(track: TrackedTouch) -> bool:
            return not track.confirmed and (not track.scans or in_question(track.state))

        vague = [track for track in self.now.tracks if tentative(track)]
        self.now.tracks = [track for track in self.now.tracks if not tentative(track)]
        self.now.dropped += vague
        return vague

    def drop_ended(self, oldest_s: float) -> None:
        """Forget what ended before the oldest value that a window holds, or was dropped and not found again."""
        self.now.tracks = [track for track in self.now.tracks if track.until_s > oldest_s - SUDDEN_REACH_S]
        self.now.dropped = [track for track in self.now.dropped if track.at_s > oldest_s - n.CHANGING_S]

    def forget(self, at_s: float) -> list[Memory]:
        """Nobody knows any more what touches. Returns what those that there were may have left in the foam."""
        memories = [memory for track in self.now.tracks for memory in self.released(track, at_s)]
        self.now.tracks, self.now.dropped = [], []
        return memories

    def expected(self, measured: Observation, manoeuvring: bool = False) -> list[TouchPrior]:
        """What is known of each before a scan. manoeuvring: it may have begun to move or to change."""
        at_s = measured.middle_s
        priors = [track.expected(at_s, measured.span_s, manoeuvring) for track in self.now.tracks]
        for place in () if manoeuvring else self.meeting(measured):
            priors[place] = self.now.tracks[place].course.goes_on(priors[place], at_s)
        return priors

    def meeting(self, measured: Observation) -> list[int]:
        """Which were apart a moment ago, and are near each other."""
        tracks, since_s = self.now.tracks, measured.middle_s
        lasting = [k for k, t in enumerate(tracks) if not (t.ended or t.lost) and since_s - t.course.apart_s < n.MEET_S]
        if len(lasting) < 2:
            return []
        nearest = gaps([tracks[k].state for k in lasting]).min(axis=1)
        return [k for k, gap in zip(lasting, nearest, strict=True) if gap < tracks[k].radius]

    def associated(self, fit: FoundTouches, association: Sequence[int]) -> tuple[int, ...]:
        """association, where touches that were found anew continue tracks in the same places, or parts of one."""
        free = [k for k, track in enumerate(self.now.tracks) if k not in association and not track.ended]
        found = list(association)
        for k, place in enumerate(association):
            near = [(distance(self.now.tracks[f].state, fit.states[k]), f) for f in free]
            if place >= 0 or not near:
                continue
            nearest = min(near)[1]
            if same_place(fit.states[k], self.now.tracks[nearest].state):
                found[k] = nearest
                free.remove(nearest)
        return tuple(found)

    def update(
        self, fit: FoundTouches, association: Sequence[int], measured: Observation, explained: bool
    ) -> list[Memory]:
        """Take over a fit. association: of each of its touches the track that it continues; -1: it is new. explained:
        by the fit; else it is only roughly right. Returns what touches that ended or moved away leave in the foam.
        """
        before = self.now.tracks
        self.now.tracks = [
            before[place] if place >= 0 else self._new(fit, k, measured) for k, place in enumerate(association)
        ]
        memories, meeting = list[Memory](), self.meeting(measured)
        for k, (track, prior) in enumerate(zip(self.now.tracks, fit.priors, strict=True)):
            self._take_prior(track, prior, measured.middle_s)
            track.update(fit, k, measured)
            if measured.whole and k not in meeting:  # what two have in common is no outline of one
                track.learn(fit, k)
            if explained:
                memories += self._follow_load(track, measured)
            memories += self._ending(track, prior, measured)
        if -1 in association:
            self._divide(association, fit.priors[association.index(-1)])
        self.now.tracks = [track for track in self.now.tracks if track.confirmed or not track.ended]
        if measured.whole and explained:
            self._follow_motion(measured.middle_s)
        return memories

    def _take_prior(self, track: TrackedTouch, prior: TouchPrior, at_s: float) -> None:
        """When it began, changed and ended, and whether it is the one that it was, as a fit around at_s took it."""
        if track.confirmed and is_anywhere(prior):  # found anew: it may be another one, or none
            track.scans = 0
        track.since_s, track.turned_s = at_s + prior.since_s, at_s + prior.turns_s
        if not track.ended:
            return
        track.until_s = at_s + prior.until_s
        if not track.ended:  # it goes on after all, and its end was published: it is another one
            track.id, self.now.next_id = self.now.next_id, self.now.next_id + 1

    def _ending(self, track: TrackedTouch, prior: TouchPrior, measured: Observation) -> list[Memory]:
        """Whether a touch ended within the scan, by its fit or by how strongly it acts. Returns what it leaves."""
        span_s = measured.span_s
        if track.ended:
            return []
        if prior.until_s < np.inf:
            track.at_once = True
            return self.released(track, measured.middle_s + prior.until_s)
        if not track.has_ended(span_s):
            return []
        track.at_once = track.turned_s < np.inf or -track.state[RATE] * span_s > n.GOES * track.held
        return self.released(track, measured.end_s)

    def _divide(self, association: Sequence[int], free: TouchPrior) -> None:
        """Those that have just come were taken for what now are two: known no better than a new one, `free`."""
        for track, place in zip(self.now.tracks, association, strict=True):
            if place >= 0 and track.scans <= n.SURE_SCANS:
                track.forget_outline(free)

    def _follow_motion(self, at_s: float) -> None:
        tracks = self.lasting
        if not tracks:
            return
        for track, gap in zip(tracks, gaps([track.state for track in tracks]).min(axis=1), strict=True):
            track.course.follow(track.state, track.sd, at_s)
            if gap > track.radius and track.confirmed and track.scans >= n.SURE_SCANS:  # by what it shows alone
                track.course.apart_s = at_s

    def tell(self, fit: FoundTouches, measured: Observation) -> None:
        """What was taken for a changed contact impedance, until this whole scan, is this touch."""
        track = self._new(fit, 0, measured)
        track.contact_excluded = track.confirmed = True
        track.update(fit, 0, measured)
        self.now.tracks.append(track)

    def released(self, track: TrackedTouch, at_s: float) -> list[Memory]:
        """A touch ended at an instant within the scan; what it leaves."""
        if track.ended:
            return []
        track.until_s = at_s
        return self._memory(track, at_s, 1.0)

    def stay(self, fit: FoundTouches | None, association: Sequence[int]) -> bool:
        """Whether the tracks that a fit goes on with are where they were: one that moved away is another one."""
        if fit is None:
            return True
        found = zip(fit.states, association, strict=True)
        return all(distance(self.now.tracks[place].state, state) < n.SAME_TOUCH for state, place in found)

    def _new(self, fit: FoundTouches, k: int, measured: Observation) -> TrackedTouch:
        prior, state, at_s = fit.priors[k], fit.states[k], measured.middle_s
        again = next((track for track in self.now.dropped if same_place(state, track.state)), None)
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
            held_at=disc_of(state),
            stayed_since_s=at_s,
        )

    def _memory(self, track: TrackedTouch, at_s: float, share: float) -> list[Memory]:
        if not track.confirmed or track.load <= 0:
            return []
        x, y, log_radius = track.held_at
        return [Memory(self._response(x, y, log_radius), share * track.load, at_s, x, y, log_radius)]

    def _follow_load(self, track: TrackedTouch, measured: Observation) -> list[Memory]:
        """Take note of what presses, and where. Of a touch that slid away returns what the place remembers where it
        stayed. A fit that does not explain its scan must not get here: it is anywhere while a touch is released.
        """
        span_s, whole, now_s = measured.span_s, measured.whole, measured.end_s
        if track.ended or (track.jumped and not whole):
            return []
        acts = float(track.state[ACTION])
        goes = min(acts, float(acts + track.state[RATE] * span_s / 2)) <= n.GOES * track.held
        stayed_s = max(0.0, now_s - track.stayed_since_s)
        x, y, log_radius = track.held_at
        if np.hypot(track.state[X] - x, track.state[Y] - y) < n.MEMORY_APART * np.exp(log_radius):
            fades = 1 - float(np.exp((track.load_s - now_s) / n.MEMORY_FADES_S[0]))
            track.load, track.load_s = max(acts, track.load + fades * (acts - track.load)), now_s
            if not goes:
                track.held = acts
                track.average_place(span_s / (stayed_s + span_s) if whole else 0.0)
            return []
        share = 1.0 if goes else 1 - float(np.exp(-stayed_s / n.MEMORY_FADES_S[0]))
        memories = self._memory(track, now_s, share)
        track.stayed_since_s, track.held, track.load, track.load_s = now_s, acts, acts, now_s
        track.average_place(1.0)
        return memories
