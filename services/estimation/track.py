"""One touch from scan to scan: what is expected of it, what a fit made of it, whether it stays or has ended.

A window of a scan in parts holds values that were fitted before, so a touch carries no place nor force from fit to fit,
but where to start. What it carries as knowledge, its radius and its outline, it learns from scans that share no value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from models.measurement.arrays import Array
from models.measurement.fit import FoundTouches
from models.measurement.numbers import MOST_WAY
from models.measurement.touch import (
    ACTION,
    LOG_RADIUS,
    PLACE,
    RATE,
    SHAPE_SDS,
    STATES,
    VELOCITY,
    VX,
    VY,
    TouchPrior,
    X,
    Y,
    acting_steadily,
    anywhere,
    drop_of,
    is_plain,
    within_limits,
)
from services.estimation.hypotheses.innovation import Observation
from services.estimation.overlap import TrackMotion
from services.estimation.values import numbers as n
from services.estimation.values.estimate import TouchEstimate


@dataclass
class TrackedTouch:
    """Times are seconds of the host's clock; `state` is of `at_s`."""

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
    since_step: int = 0  # whole scans since it was elsewhere or otherwise at once
    moves: bool = False
    z2: float = 0.0  # how much it explains: squared sigmas of its action, in the middle of the scan or at its end
    confirmed: bool = False
    contact_excluded: bool = False  # several scans told it from a changed contact impedance
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
    askings: int = 0  # how often it was asked that

    @property
    def doubt_due(self) -> bool:
        """Whether it is time to ask what it is, as every touch is asked now and then."""
        return self.scans % n.DOUBT_SCANS == n.DOUBT_SCANS - 1

    @property
    def in_doubt(self) -> bool:
        """Whether to ask in this whole scan if it is drift, or nothing."""
        return not self.ended and (self.z2 < n.DOUBT_Z2 or not self.confirmed or self.doubt_due)

    @property
    def contact_due(self) -> bool:
        """Whether it is time to ask if it is an electrode's contact impedance: while it is new or was otherwise of
        late, and now and then.
        """
        return (self.scans > 0 and self.since_step <= n.SURE_SCANS) or self.doubt_due

    @property
    def steady(self) -> bool:
        """Whether it has neither moved nor changed of late."""
        return self.still >= n.STILL_SCANS

    @property
    def ended(self) -> bool:
        return self.until_s < np.inf

    @property
    def radius(self) -> float:
        return float(np.exp(self.state[LOG_RADIUS]))

    @property
    def sd(self) -> Array:
        """(7,) of the state."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def place_sd(self) -> float:
        """By the last scan, of the coordinate that is known worse."""
        return float(np.sqrt(max(self.covariance[X, X], self.covariance[Y, Y], 0.0)))

    def acts_at(self, at_s: float, end_s: float) -> bool:
        """Whether it is there at an instant of the scan that it was fitted to. end_s: of the scan: what ended at once
        before is gone, what fades is there as at that instant.
        """
        acts = float(self.state[ACTION] + self.state[RATE] * (at_s - self.at_s))
        return not self.ended or (end_s <= self.until_s and acts > n.ENDED * self.peak)

    def has_ended(self, span_s: float) -> bool:
        """By what acts at the scan's end, never by the drop alone: its sigma is that of the radius."""
        acts, sd = self._action(span_s / 2)
        return acts < n.ENDED * self.peak + (sd if acts < 4 * n.ENDED * self.peak else 0.0)

    def expected(self, at_s: float, span_s: float, manoeuvring: bool) -> TouchPrior:
        """What is known of it before a scan whose middle is at_s."""
        passed_s = at_s - self.at_s
        state = self.state.copy()
        if self.moves:
            state[PLACE] += state[VELOCITY] * min(passed_s, 2 * span_s)
        else:
            state[VELOCITY] = 0.0
        if passed_s > span_s / 2:  # how a ramp goes on after a whole scan nobody knows
            state[ACTION] += state[RATE] * span_s / 2
            state[RATE] = 0.0
        else:
            state[ACTION] += state[RATE] * passed_s
        state[ACTION] = max(state[ACTION], 0.02 * self.peak, 1e-4)
        mean, sd = self._known(state, span_s, manoeuvring)
        shape_sd = np.sqrt(np.minimum(self.shape_variance + (n.SHAPE_WALK * SHAPE_SDS) ** 2, SHAPE_SDS**2))
        state = within_limits(state[None])[0]
        if not self.moves and passed_s <= span_s / 2:  # most of the values are those that told its velocity
            state[VELOCITY] = self.state[VELOCITY]
        since_s, until_s, turns_s = self.since_s - at_s, self.until_s - at_s, self.turned_s - at_s
        prior = TouchPrior(state, mean, sd, self.shape, shape_sd, since_s, until_s, turns_s)
        return acting_steadily(prior, self.held, span_s) if self.at_once and self.held > 0 else prior

    def _known(self, state: Array, span_s: float, manoeuvring: bool) -> tuple[Array, Array]:
        """Mean and standard deviation (7,) about an expected state."""
        free = anywhere(0.0, 0.0, max(float(state[ACTION]), self.peak), span_s)
        mean, sd = free.mean.copy(), free.sd.copy()
        if not self.lost:
            known = n.SIGMAS * float(np.sqrt(self.covariance[X, X] + self.covariance[Y, Y]))
            mean[PLACE], sd[PLACE] = state[PLACE], max(n.PLACE_MOVES * (1 + 3 * manoeuvring), known)
        sd[VELOCITY] = MOST_WAY / span_s
        if self.steady and not manoeuvring:
            sd[VELOCITY] = n.STILL_WAY / span_s
            sd[RATE] = n.STILL_CHANGE * max(float(state[ACTION]), 1e-3) / span_s
        mean[LOG_RADIUS], sd[LOG_RADIUS] = self.log_radius, self.log_radius_sd
        return mean, sd

    def update(self, fit: FoundTouches, k: int, measured: Observation) -> None:
        """Take over the k-th touch of a fit."""
        own, span_s, whole = slice(STATES * k, STATES * (k + 1)), measured.span_s, measured.whole
        state, covariance = fit.states[k], fit.covariance[own, own]
        self.jumped = not (self.lost or self.ended) and distance(self.state, state) > max(n.SAME_TOUCH, self.radius)
        last, last_s = self.state, self.at_s
        self.state, self.covariance, self.at_s, self.lost = state, covariance, measured.middle_s, False
        self.z2 = max((max(action, 0.0) / sd) ** 2 for action, sd in map(self._action, (0.0, span_s / 2)))
        if self.ended:
            return
        sd = self.sd
        way, change = np.hypot(*state[VELOCITY]) * span_s, abs(state[RATE]) * span_s
        self.moves = bool(way > max(n.STILL_WAY, n.SIGMAS * float(np.hypot(*sd[VELOCITY])) * span_s))
        if self.moves or change > max(n.STILL_CHANGE * abs(state[ACTION]), n.SIGMAS * sd[RATE] * span_s):
            self.still = 0
        elif whole:
            self.still += 1
        self.scans += whole
        self.since_step = 0 if self._stepped(last, last_s) else self.since_step + whole
        if whole:
            self._follow_place()
        before, self.surely = self.surely, float(state[ACTION] - 2 * sd[ACTION])
        # The few new values of one part may be explained by any touch, also where none is the reason.
        self.peak = max(self.peak, self.surely if whole else min(before, self.surely))

    def _stepped(self, before: Array, before_s: float) -> bool:
        """Whether the motion of a state (7,) before does not lead to its own: something may have ended, or begun."""
        passed_s, sd = self.at_s - before_s, n.SIGMAS * self.sd
        way = self.state[PLACE] - before[PLACE] - before[VELOCITY] * passed_s
        change = self.state[ACTION] - before[ACTION] - before[RATE] * passed_s
        far = np.hypot(*way) > max(n.STILL_WAY, float(np.hypot(*sd[PLACE])))
        return bool(far or abs(change) > max(n.STILL_CHANGE * abs(before[ACTION]), sd[ACTION]))

    def learn(self, fit: FoundTouches, k: int) -> None:
        """Radius and outline, of a scan that shares no value with the one before."""
        self.log_radius = float(self.state[LOG_RADIUS])
        self.log_radius_sd = float(np.hypot(float(self.sd[LOG_RADIUS]), n.RADIUS_WALK))
        self.shape, self.shape_variance = fit.shapes[k].copy(), fit.shape_variance[k].copy()
        if is_plain(fit.priors[k]):  # that of a disc was not asked
            self.shape_variance = SHAPE_SDS**2

    def forget_outline(self, free: TouchPrior) -> None:
        """Nothing is known of its radius and outline but what `free` knows of any new touch."""
        self.log_radius, self.log_radius_sd = float(free.mean[LOG_RADIUS]), float(free.sd[LOG_RADIUS])
        self.shape, self.shape_variance = np.zeros(len(SHAPE_SDS)), SHAPE_SDS**2

    def average_place(self, share: float) -> None:
        """The place where it stays, a mean: one that followed it would never be left. share: of this scan."""
        if self.scans <= 1:  # it has just come: places of before were rough
            share = 1.0
        x, y, log_radius = (
            then + share * (now - then) for then, now in zip(self.held_at, disc_of(self.state), strict=True)
        )
        self.held_at = x, y, log_radius

    def _follow_place(self) -> None:
        """One that stays is where all its scans say, weighed as they are sure of it."""
        (x, y), sd, known = self.state[PLACE], self.place_sd, np.hypot(self.steady_position[2], n.PLACE_WALK)
        if not self._stays():
            self.steady_position, self.steady_for = (float(x), float(y), sd), 0
            return
        self.steady_for += 1
        share = known**2 / (known**2 + sd**2)
        then_x, then_y, _ = self.steady_position
        by_all = float(np.sqrt(share) * sd)
        self.steady_position = float(then_x + share * (x - then_x)), float(then_y + share * (y - then_y)), by_all

    def _stays(self) -> bool:
        """Whether the last scan has it where it stayed."""
        off = float(np.hypot(*(self.state[PLACE] - self.steady_position[:2])))
        known = np.hypot(self.steady_position[2], n.PLACE_WALK)
        return bool(self.steady and off < n.STAYS_WITHIN * np.hypot(known, self.place_sd))

    def _action(self, after_s: float) -> tuple[float, float]:
        """Action and its standard deviation at an instant, seconds after that of the state."""
        to_then = np.array([1.0, after_s])
        both = self.covariance[np.ix_([ACTION, RATE], [ACTION, RATE])]
        return float(to_then @ self.state[[ACTION, RATE]]), float(np.sqrt(max(to_then @ both @ to_then, n.TINY**2)))

    def estimate(self, sample_s: float, span_s: float, unexplained: float) -> TouchEstimate:
        """It at the instant sample_s, with the covariance of that instant."""
        passed_s = sample_s - self.at_s
        carry = np.eye(STATES)
        carry[X, VX], carry[Y, VY], carry[ACTION, RATE] = passed_s, passed_s, passed_s
        bends = np.zeros(STATES)  # variance of what was linear in the fit and may have bent within the scan
        if not self.steady:
            bends[PLACE] = (n.BENDS * self.state[VELOCITY] * span_s) ** 2
            bends[ACTION] = (n.BENDS * self.state[RATE] * span_s) ** 2
        state, covariance = carry @ self.state, carry @ (self.covariance + np.diag(bends)) @ carry.T
        log_radius, action = float(state[LOG_RADIUS]), max(float(state[ACTION]), 0.0)
        strength = action / (np.pi * np.exp(2 * log_radius))
        drop = drop_of(action, log_radius)
        slopes = np.eye(STATES)[[X, Y, LOG_RADIUS, ACTION]]  # of x, y, log radius and drop
        slopes[-1, ACTION] = drop / max(action, n.TINY) / (1 + strength / 2)
        slopes[-1, LOG_RADIUS] = -2 * drop / (1 + strength / 2)
        x, y = state[PLACE]
        if self.steady_for >= n.STILL_SCANS and self._stays():
            x, y, _ = self.steady_position  # as sure as by one scan: what all of them get wrong is not known
        return TouchEstimate(
            id=self.id,
            began=self.began,
            age_s=sample_s - self.created_s,
            x=float(x),
            y=float(y),
            vx=0.0 if self.steady else float(state[VX]),
            vy=0.0 if self.steady else float(state[VY]),
            log_radius=log_radius,
            drop=drop,
            covariance=slopes @ covariance @ slopes.T,
            z2=self.z2,
            strength=action,
            strength_sd=float(np.sqrt(max(covariance[ACTION, ACTION], 0.0))),
            unexplained=unexplained,
        )


def coasted(touch: TouchEstimate, passed_s: float) -> TouchEstimate:
    """One that a scan changed so that nothing explains it, or that may be several, or another one by now: that it is
    there, where roughly, and not how strongly. passed_s: since that estimate.
    """
    covariance = touch.covariance.copy()
    covariance[0, 0] += n.ROUGH**2
    covariance[1, 1] += n.ROUGH**2
    return replace(touch, age_s=touch.age_s + passed_s, covariance=covariance, strength_sd=touch.strength)


def oddness(shape: Array) -> float:
    """How far an outline is from a disc's, in squared standard deviations of its prior."""
    return float((shape**2 / SHAPE_SDS**2).sum())


def may_be_several(shape: Array) -> bool:
    """Whether an outline is that of several touches which are followed as one, or not known."""
    return oddness(shape) > n.ODD_OUTLINE or not shape.any()


def is_broad(state: Array) -> bool:
    """Whether a touch (7,) that has just come may be two that began together, and is where neither of them is."""
    return bool(state[LOG_RADIUS] > np.log(n.BROAD))


def distance(state: Array, other: Array) -> float:
    """Of the places of two states (7,) [unit]."""
    return float(np.hypot(*(state[PLACE] - other[PLACE])))


def same_place(state: Array, other: Array) -> bool:
    """Whether a touch (7,) that was found anew is in the place of another one."""
    widest = max(state[LOG_RADIUS], other[LOG_RADIUS])
    return distance(state, other) < max(n.SAME_TOUCH, float(np.exp(widest)))


def disc_of(state: Array) -> tuple[float, float, float]:
    """x, y and log radius of a touch (7,)."""
    return float(state[X]), float(state[Y]), float(state[LOG_RADIUS])
