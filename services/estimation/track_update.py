"""What follows from an answer for the touches: which go on, which are new, which were none, and what they leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.measurement.fit import FoundTouches
from models.measurement.touch import LOG_RADIUS
from services.estimation.filter import Memory
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, Observation, ScoredAnswer, started_from
from services.estimation.tared import TaredSkin
from services.estimation.touches import TouchTracks, TrackedTouch
from services.estimation.values import numbers as n


def update_tracks(
    skin: TaredSkin, innovation: Innovation, answer: ScoredAnswer, measured: Observation, unexplained_s: float
) -> None:
    """Take over what an answer says of the touches. unexplained_s: for how long nothing has explained the scans."""
    if answer.fit is None:
        memories = skin.touches.forget(measured.oldest_s)
    else:
        memories = _associate(skin, answer, answer.fit, measured)
        _confirm(skin, answer, measured)
        if measured.whole and not (answer.recounted or measured.scan.separate):
            rest = replace(innovation, keeps=0.0)
            _doubt(skin, rest, answer, measured, strange=unexplained_s > n.CHANGING_S)
        if answer.explained and all(track.confirmed for track in skin.touches.now.tracks):
            skin.touches.now.dropped = []
    skin.remember(memories)
    wide = answer.fit is not None and answer.wide
    if answer.explained and wide != skin.hypotheses.wide:
        skin.hypotheses.wide = wide
        skin.forget_gates()


def _associate(skin: TaredSkin, answer: ScoredAnswer, fit: FoundTouches, measured: Observation) -> list[Memory]:
    """Tracks go on, begin or end with the touches of a fit. Returns what those that ended leave in the foam."""
    touches = skin.touches
    association = touches.associated(fit, answer.association)
    if answer.recounted:
        touches.correct(fit, association)
    gone = [k for k in range(len(touches)) if k not in association]
    memories = [memory for k in gone for memory in touches.released(k, measured.oldest_s)]
    skin.slow_onset.forget()
    return memories + touches.update(fit, association, measured, answer.explained)


def _confirm(skin: TaredSkin, answer: ScoredAnswer, measured: Observation) -> None:
    """A touch is shown at once where its scan is explained with it: a rough start may be anything. One that stands by
    itself (separate) is the end, too.
    """
    if not (answer.explained or measured.scan.separate) or 2 * answer.over < n.SURE_Z2:
        return
    least = _least_z2(skin, answer, measured)
    place_tells = not measured.whole and answer.cause == AS_IT_IS
    may_wait = skin.tables.predicted and not measured.scan.separate
    for track in skin.touches.now.tracks:
        told = track.z2 > least or (place_tells and _placed(track))
        track.confirmed = track.confirmed or (told and not skin.faults.in_question(track.state))
        if may_wait and (_broad(track) or (track.jumped and not measured.whole)):
            track.confirmed = False


def _least_z2(skin: TaredSkin, answer: ScoredAnswer, measured: Observation) -> float:
    """Squared sigmas of its action from which a touch is shown at once."""
    if not skin.tables.predicted:  # its strength is known badly: that scans are not quiet without it was asked
        return 0.0
    if measured.scan.separate:  # how many press was asked of evidence
        return float(n.ACTS_Z2)
    return float(n.SURE_Z2 if answer.cause == AS_IT_IS else n.DOUBT_Z2)


def _placed(track: TrackedTouch) -> bool:
    """How strongly it presses a first part hardly tells: its place and that it is there, it does."""
    return track.place_sd < n.PLACED and track.z2 > n.PLACED_Z2


def _broad(track: TrackedTouch) -> bool:
    """Whether it may be two that began together, and is where neither of them is."""
    return bool(track.state[LOG_RADIUS] > np.log(n.BROAD)) and track.scans < n.SURE_SCANS


def _doubt(skin: TaredSkin, innovation: Innovation, answer: ScoredAnswer, measured: Observation, strange: bool) -> None:
    """Is one of the touches drift, or nothing? What was shown once must not stay because nothing is learnt under
    it, nor because it costs nothing: a touch that is doubted counts as a new one. strange: nothing has explained the
    scans of late, so that one which only lasts is no touch yet.
    """
    touches, none = skin.touches, list[tuple[float, int]]()
    meeting = touches.meeting(measured.middle_s)
    for k in reversed(range(len(touches))):
        track = touches.now.tracks[k]
        if not _doubted(track):
            continue
        standing, least = touches.expected(measured.middle_s, measured.span_s), float(n.LOG_PRIOR_TOUCH)
        if answer.fit is not None and k in meeting and len(touches) == len(answer.fit):
            standing, least = started_from(answer.fit), -least  # it is known by itself: it would have ended
        other = skin.hypotheses.without(innovation, standing, k)
        if other.quiet and other.score > answer.score + least and touches.stay(other.fit, other.association):
            none.append((other.score - least, k))
        elif not track.confirmed and not skin.faults.in_question(track.state):
            track.confirmed = _lasts(track, touches, strange) or _needed(track, touches, answer, other)
    if none:
        touches.remove(max(none)[1])


def _doubted(track: TrackedTouch) -> bool:
    return not track.ended and (track.z2 < n.DOUBT_Z2 or not track.confirmed or track.doubt_due)


def _needed(track: TrackedTouch, touches: TouchTracks, answer: ScoredAnswer, other: ScoredAnswer) -> bool:
    """Whether it stood before anybody looked, and the scan needs it. other: the answer without it."""
    if touches.now.watched or track.z2 <= n.ACTS_Z2:  # what began while somebody watched may be how others begin
        return False
    return answer.explained and answer.cause == AS_IT_IS and 2 * (answer.score - other.score) > n.SURE_Z2


def _lasts(track: TrackedTouch, touches: TouchTracks, strange: bool) -> bool:
    alone = len(touches) == 1  # then something touches, be its strength known or not
    return track.scans >= n.SURE_SCANS and (alone or track.z2 > n.ACTS_Z2) and not strange
