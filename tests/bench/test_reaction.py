"""The reaction benchmark: its scene says what its truth says, and what counts as a touch seen in place."""

import numpy as np
import pytest

from bench.speed.reaction_events import KINDS, SIDE_M, SeenFrame, TouchEvent, events, react, scene
from firmware_stub import scene as scenes
from firmware_stub.timeline import Timeline
from protocol.frames import Contact, ContactFrame

STILL = TouchEvent(KINDS[0], 1.0, 1.3, 0.01, 0.0, 0.01, np.inf)


def seen(t, *at, valid=True, reasons=(), sigma=None, state="hold", sampled=None, velocity=(0.0, 0.0)):
    more = {"state": state, "position_sigma": sigma, "velocity": [*velocity, 0.0]}
    contacts = [Contact(id=1, position=[x, y, 0.0], **more) for x, y in at]
    frame = ContactFrame(skin="palm", valid=valid, reasons=list(reasons), contacts=contacts)
    return SeenFrame(t, t - 0.02 if sampled is None else sampled, frame)


def test_the_scene_plays_the_events_one_at_a_time(tmp_path):
    plan = events({kind.name: 4 for kind in KINDS}, 0.35, seed=3)
    (tmp_path / "reaction.toml").write_text(scene(plan))
    timeline = Timeline(scenes.load(tmp_path / "reaction.toml"), 100.0)
    assert len(plan) == 4 * len(KINDS)
    for event in plan:
        for t in (event.onset - 1e-4, event.end + 1e-4):
            assert timeline.at(100.0 + t).touches == ()
        for t in np.linspace(event.onset + 0.06, event.end - 0.06, 5).tolist():
            touches = timeline.at(100.0 + t).touches
            assert len(touches) == event.kind.touches
            for touch, place in zip(touches, event.places(t), strict=True):
                assert (touch.x, touch.y) == pytest.approx(place, abs=1e-9)
                assert touch.force_n == pytest.approx(event.kind.force)
                assert max(abs(touch.x), abs(touch.y)) + touch.radius <= SIDE_M / 2 + 1e-9
    phases = {round(event.onset % 0.0436, 3) for event in plan}
    assert len(phases) > len(plan) / 2


def test_several_at_once_are_in_place_when_all_are():
    pair = TouchEvent(KINDS[6], 1.0, 1.3, 0.01, 0.0, 0.01, np.inf, others=((-0.03, 0.0),))
    assert pair.kind.touches == 2
    one, both, three = [(0.01, 0.0)], [(0.01, 0.0), (-0.031, 0.0)], [(0.01, 0.0), (-0.031, 0.0), (0.0, 0.04)]
    frames = [seen(1.02, *one), seen(1.06, *three), seen(1.11, *both), seen(1.2, *both), seen(1.4), seen(1.5)]
    found = react(pair, 2.0, frames)  # the third is not held against it
    assert (found.near_s, found.contact_s, found.gone_s) == pytest.approx((0.06, 0.11, 0.1))


def test_a_touch_is_seen_with_the_first_of_the_frames_that_all_are_in_place():
    there, off = (0.01, 0.0), (0.02, 0.0)
    frames = [seen(1.02), seen(1.06, off, reasons=["changing"]), seen(1.11, there), seen(1.15, off)]
    found = react(STILL, 2.0, [*frames, seen(1.2, there), seen(1.25, there), seen(1.4, there), seen(1.5), seen(1.6)])
    assert (found.contact_s, found.near_s, found.gone_s) == pytest.approx((0.2, 0.11, 0.2)) and found.wrong == 0


def test_an_early_frame_is_wrong_beyond_three_of_its_own_sigmas_whatever_it_says():
    sigma = [0.002, 0.001, 0.0]
    near, far = (seen(t, (x, 0.0), sigma=sigma, reasons=["coarse"]) for t, x in ((1.03, 0.015), (1.04, 0.017)))
    assert react(STILL, 2.0, [near, far, seen(1.1, (0.01, 0.0))]).wrong == 1
    assert react(STILL, 2.0, [seen(1.04, (0.02, 0.0), sigma=sigma, valid=False)]).wrong == 0


def test_a_slide_is_scored_against_the_truth_at_recv_and_at_the_sample():
    slide = TouchEvent(KINDS[5], 1.0, 1.4, 0.0, 0.0, 0.01, 1.2, (0.3, 0.0))
    found = react(slide, 2.0, [seen(1.3, (0.015, 0.0), sampled=1.25, velocity=(0.27, 0.0))])
    assert found.errors_m == pytest.approx([0.015])
    assert found.contact_s == pytest.approx(0.3)  # where it was when it was measured
