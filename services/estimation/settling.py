"""What follows from an answer for the touches: which go on, which are new, which were none, and what they leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.measurement.touch import LOG_RADIUS
from services.estimation.asked.looked_at import LookedAt
from services.estimation.asked.question import AS_IT_IS, Question, ScoredAnswer, started_from
from services.estimation.tared import TaredSkin
from services.estimation.values import numbers as n


def settle(skin: TaredSkin, question: Question, answer: ScoredAnswer, measured: LookedAt, unexplained_s: float) -> None:
    """Take over what an answer says of the touches. unexplained_s: for how long nothing has explained the scans."""
    touches, middle_s, span_s = skin.touches, measured.middle_s, measured.span_s
    kept = answer.kept if answer.fit is None else touches.recognised(answer.fit, answer.kept)
    if answer.recounted and answer.fit is not None:
        touches.correct(answer.fit, kept)
    gone = [k for k in range(len(touches)) if k not in kept]
    memories = [memory for k in gone for memory in touches.released(k, measured.oldest_s)]
    if answer.fit is None:
        touches.forget(measured.oldest_s)
    else:
        skin.slow.forget()
        memories += touches.settle(answer.fit, kept, middle_s, span_s, whole=measured.whole, explained=answer.explained)
        _make_sure(skin, answer, measured)
        rest = replace(question, keeps=0.0)
        if measured.whole and not (answer.recounted or measured.scan.separate):
            _doubt(skin, rest, answer, measured, strange=unexplained_s > n.CHANGING_S)
    skin.remember(memories)
    wide = answer.fit is not None and answer.wide
    if answer.explained and wide != skin.hypotheses.wide:
        skin.hypotheses.wide = wide
        skin.forget_looks()


def _make_sure(skin: TaredSkin, answer: ScoredAnswer, measured: LookedAt) -> None:
    """A touch is shown at once where its scan is explained with it: a rough start may be anything. One that stands by
    itself (separate) is the end, too.
    """
    if not (answer.explained or measured.scan.separate) or 2 * answer.over < n.SURE_Z2:
        return
    least = float(n.SURE_Z2 if answer.cause == AS_IT_IS else n.DOUBT_Z2)
    if measured.scan.separate:  # how many press was asked of evidence
        least = float(n.ACTS_Z2)
    if not skin.tables.predicted:  # its strength is known badly: that scans are not quiet without it was asked
        least = 0.0
    may_wait = skin.tables.predicted and not measured.scan.separate
    for track in skin.touches.now.tracks:
        # How strongly it presses a first part hardly tells: its place and that it is there, it does.
        placed = track.place_sd < n.PLACED and track.z2 > n.PLACED_Z2
        told = track.z2 > least or (placed and not measured.whole and answer.cause == AS_IT_IS)
        track.sure = track.sure or (told and not skin.faults.in_question(track.state))
        broad = track.state[LOG_RADIUS] > np.log(n.BROAD) and track.scans < n.SURE_SCANS
        if broad and may_wait:  # it may be two that began together, and is where neither of them is
            track.sure = False


def _doubt(skin: TaredSkin, question: Question, answer: ScoredAnswer, measured: LookedAt, strange: bool) -> None:
    """Is one of the touches drift, or nothing? What was shown once must not stay because nothing is learnt under
    it, nor because it costs nothing: a touch that is doubted counts as a new one. strange: nothing has explained the
    scans of late, so that one which only lasts is no touch yet.
    """
    touches, none = skin.touches, list[tuple[float, int]]()
    meeting = touches.meeting(measured.middle_s)
    for k in reversed(range(len(touches))):
        track = touches.now.tracks[k]
        often = track.z2 < n.DOUBT_Z2 or not track.sure
        if track.ended or not (often or track.doubt_due):
            continue
        standing, least = touches.expected(measured.middle_s, measured.span_s), float(n.COST_TOUCH)
        if answer.fit is not None and k in meeting and len(touches) == len(answer.fit):
            standing, least = started_from(answer.fit), -least  # it is known by itself: it would have ended
        other = skin.hypotheses.without(question, standing, k)
        if other.quiet and other.score > answer.score + least:
            none.append((other.score - least, k))
            continue
        needed = answer.explained and answer.cause == AS_IT_IS and 2 * (answer.score - other.score) > n.SURE_Z2
        acts = track.z2 > n.ACTS_Z2
        stood = needed and acts and not touches.now.watched  # what began while somebody watched may be how others begin
        alone = len(touches) == 1  # then something touches, be its strength known or not
        lasts = track.scans >= n.SURE_SCANS and (alone or acts) and not strange
        track.sure = track.sure or ((stood or lasts) and not skin.faults.in_question(track.state))
    if none:
        touches.remove(max(none)[1])
