"""Scenes: the world between keys, at jumps, round a loop; what a file may not say."""

import itertools

import pytest

from firmware_stub import scene
from firmware_stub.timeline import Timeline, press_track
from firmware_stub.world import Touch, World, steps_between

KEYS = [{"t": 1.0, "x": -0.02, "y": 0.0, "force": 2.0}, {"t": 3.0, "x": 0.02}]
SLIDE = {"loop": True, "duration": 4.0, "touch": [{"radius": 0.01, "keys": KEYS}]}


def test_a_touch_moves_linearly_and_only_between_its_keys():
    timeline = Timeline(scene.parse(SLIDE))
    assert [len(timeline.at(t).touches) for t in (0.5, 1.5, 3.5)] == [0, 1, 0]
    (touch,) = timeline.at(1.5).touches
    assert (touch.x, touch.y, touch.drop) == pytest.approx((-0.01, 0.0, 0.2))
    a, b = (World((Touch("circle", x, 0.0, 0.01, 0.3),)) for x in (0.0, 0.02))
    assert (steps_between(a, a), steps_between(a, b)) == (0, 8)


def test_a_loop_repeats_and_never_stands_still_at_its_seam():
    for start, round_ in ((0.1, 0), (0.1, 7), (12345.678, 1), (12345.678, 1000)):
        timeline, t = Timeline(scene.parse(SLIDE), start), start + 4.0 * round_
        assert timeline.at(t + 2.0).touches[0].x == pytest.approx(0.0, abs=1e-6)
        for near in (t, t - 1e-9, t + 1e-9):
            segment = timeline.segment(near)
            assert near < segment.end <= near + 4.0


def test_a_press_comes_on_top_of_the_scene_and_ends():
    press = press_track(1.0, 1.0, Touch("circle", 0.0, 0.03, 0.005, 0.3), (0.01, 0.03))
    timeline = Timeline(scene.parse(SLIDE), 0.0, (press,))
    assert [len(timeline.at(t).touches) for t in (0.9, 1.0, 1.9, 2.0)] == [0, 2, 2, 1]
    assert timeline.at(1.5).touches[1].x == pytest.approx(0.005)


def test_drift_goes_between_its_keys_and_keeps_its_last_value():
    keys = [[{"t": 0.0, "value": 1.0}, {"t": 10.0, "value": last}] for last in (0.9, 1.5)]
    drift = {"background": keys[0], "contact": [{"electrode": 2, "keys": keys[1]}]}
    timeline = Timeline(scene.parse({"drift": drift}))
    assert [timeline.at(t).background for t in (5.0, 99.0)] == pytest.approx([0.95, 0.9])
    assert list(timeline.at(5.0).contact[2:4]) == pytest.approx([1.25, 1.0])


def test_every_shipped_scene_plays_demo_is_untouched_and_paper_49_has_every_position_with_every_force():
    for name in scene.names():
        timeline, t, most = Timeline(scene.load(name)), 0.0, 0
        while t < min(timeline.script.duration or 1.0, 60.0):
            segment = timeline.segment(t)
            assert segment.start <= t < segment.end
            most, t = max(most, len(segment.first.touches)), segment.end
        assert most <= 3 and (most > 0) == (name != "demo") == bool(timeline.script.tracks)
    tracks = scene.load("paper_49").tracks
    seen = {(round(p.x, 4), round(p.y, 4), round(max(q.drop for q in t.poses), 3)) for t in tracks for p in t.poses}
    assert len(tracks) == 245 and len(seen) == 245
    first = tracks[0].poses[1]
    assert (first.x, first.y, first.radius) == pytest.approx((-0.03, 0.03, 0.005))  # the top left comes first


def test_a_wrong_scene_is_refused_by_name():
    for change, says in (
        ({"touchs": []}, "unknown key touchs"),
        ({"loop": True, "duration": 2.0}, "after the loop's duration"),
        ({"touch": [{"shape": "star", "keys": [{"t": 0.0, "x": 0, "y": 0, "force": 1}]}]}, "expected one of circle"),
        ({"touch": [{"keys": [{"t": 0.0, "x": 20, "y": 0, "force": 1}]}]}, "positions are metres"),
    ):
        with pytest.raises(ValueError, match=says):
            scene.parse({**SLIDE, **change})


def test_a_touch_is_the_force_that_was_asked_for_whatever_its_size():
    kinds = ("circle", "triangle", "rectangle", "L", "hertz")
    for kind, (radius, newton) in itertools.product(kinds, ((0.005, 1.0), (0.01, 3.0), (0.02, 5.0), (0.006, 4.0))):
        made = scene.touch({"shape": kind, "x": 0.0, "y": 0.0, "force": newton, "radius": radius, "aspect": 1.5})
        assert made.force_n == pytest.approx(newton) and 0 < made.drop < 1
    disc = scene.touch({"x": 0.0, "y": 0.0, "force": 1.0, "radius": 0.005})
    assert disc.drop == pytest.approx(0.4) and disc.pressure == pytest.approx(1.0 / (3.14159265 * 0.005**2))
