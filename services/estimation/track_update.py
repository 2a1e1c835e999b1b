"""What follows from an answer for the touches: which go on, which are new, which were none, and what they leave."""

from __future__ import annotations

from dataclasses import replace

from models.measurement.fit import FoundTouches
from services.estimation.filter import Memory
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, Observation, ScoredAnswer, started
from services.estimation.tared import TaredSkin
from services.estimation.track import TrackedTouch, is_broad
from services.estimation.values import numbers as n


def update_tracks(
    skin: TaredSkin, innovation: Innovation, answer: ScoredAnswer, measured: Observation, unexplained_s: float
) -> None:
    """Take over what an answer says of the touches. unexplained_s: for how long nothing has explained the scans."""
    touches = skin.touches
    if answer.fit is None:
        memories = touches.forget(measured.oldest_s)
    else:
        memories = _associate(skin, answer, answer.fit, measured)
        _confirm(skin, answer, measured)
        if measured.whole and not (answer.recounted or measured.scan.separate):
            _doubt(skin, replace(innovation, keeps=0.0), answer, measured, strange=unexplained_s > n.CHANGING_S)
        if answer.explained and all(track.confirmed for track in touches.now.tracks):
            touches.now.dropped = []  # what is found where one was dropped is a new one
    skin.remember(memories)
    wide = answer.fit is not None and answer.wide
    if answer.explained and wide != skin.touches.now.wide:
        skin.touches.now.wide = wide
        skin.null_gate.forget()


def _associate(skin: TaredSkin, answer: ScoredAnswer, fit: FoundTouches, measured: Observation) -> list[Memory]:
    """Tracks go on, begin or end with the touches of a fit. Returns what those that ended leave in the foam."""
    touches = skin.touches
    association = touches.associated(fit, answer.association)
    if answer.recounted:
        touches.correct(fit, association)
    gone = [track for k, track in enumerate(touches.now.tracks) if k not in association]
    memories = [memory for track in gone for memory in touches.released(track, measured.oldest_s)]
    skin.slow_onset.forget()
    return memories + touches.update(fit, association, measured, answer.explained)


def _confirm(skin: TaredSkin, answer: ScoredAnswer, measured: Observation) -> None:
    """Show at once what explains its scan (a rough start may be anything), or what no other scan follows."""
    separate, whole = measured.scan.separate, measured.whole
    if not (answer.explained or separate) or 2 * answer.over < n.SURE_Z2:
        return
    may_wait = skin.tables.predicted and not separate
    least_z2 = _least_z2(skin, answer, separate)
    place_tells = answer.cause == AS_IT_IS and not any(map(_may_be_two, skin.touches.now.tracks))
    for track in skin.touches.now.tracks:
        # Its place tells it: how strongly it presses the values since it began hardly say.
        placed = place_tells and track.place_sd < n.PLACED and track.z2 > n.ACTS_Z2
        surely = (track.z2 > least_z2 or placed) and not skin.faults.in_question(track.state)
        waits = may_wait and (_may_be_two(track) or (track.jumped and not whole))
        track.confirmed = (track.confirmed or surely) and not waits


def _may_be_two(track: TrackedTouch) -> bool:
    """Whether it is new and broad."""
    return is_broad(track.state) and track.scans < n.SURE_SCANS


def _least_z2(skin: TaredSkin, answer: ScoredAnswer, separate: bool) -> float:
    """Squared sigmas of its action from which a touch is shown at once."""
    if not skin.tables.predicted:  # its strength is known badly: that scans are not quiet without it was asked
        return 0.0
    if separate:  # how many press was asked of evidence
        return float(n.ACTS_Z2)
    return float(n.SURE_Z2 if answer.cause == AS_IT_IS else n.DOUBT_Z2)


def _doubt(skin: TaredSkin, innovation: Innovation, answer: ScoredAnswer, measured: Observation, strange: bool) -> None:
    """Is one of the touches drift, or nothing? What was shown once must not stay because nothing is learnt under
    it, nor because it costs nothing: a touch that is doubted counts as a new one. strange: nothing has explained the
    scans of late, so that one which only lasts is no touch yet.
    """
    touches, none = skin.touches, list[tuple[float, int]]()
    same = len(touches) == answer.count
    meeting = touches.meeting(measured) if same else []
    # As they were known before this scan: what it told counts once.
    tracked = started(answer.fit) if same else touches.expected(measured)
    for k, track in reversed([*enumerate(touches.now.tracks)]):
        if not track.in_doubt:
            continue
        least = float(-n.LOG_PRIOR_TOUCH if k in meeting else n.LOG_PRIOR_TOUCH)  # who meet would have ended
        other = skin.hypotheses.without(innovation, tracked, k)
        if other.quiet and other.score > answer.score + least and touches.stay(other.fit, other.association):
            none.append((other.score - least, k))
        elif not track.confirmed and not skin.faults.in_question(track.state):
            acts = len(touches) == 1 or track.z2 > n.ACTS_Z2  # alone: something touches, be its strength known or not
            track.confirmed = track.scans >= n.SURE_SCANS and acts and not strange  # several scans need it
    if none:
        del touches.now.tracks[max(none)[1]]
