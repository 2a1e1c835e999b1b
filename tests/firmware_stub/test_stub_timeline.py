"""Scenes: the world between keys, at jumps, round a loop; what a file may not say."""

import pytest

from firmware_stub import scene
from firmware_stub.timeline import Timeline, press_track
from firmware_stub.world import Touch, World, steps_between

SLIDE = {
    "loop": True,
    "duration": 4.0,
    "touch": [{"radius": 0.01, "keys": [{"t": 1.0, "x": -0.02, "y": 0.0, "force": 2.0}, {"t": 3.0, "x": 0.02}]}],
}


def test_a_touch_moves_linearly_and_only_between_its_keys():
    timeline = Timeline(scene.parse(SLIDE))
    assert timeline.at(0.5).touches == ()
    assert timeline.at(3.5).touches == ()
    (touch,) = timeline.at(1.5).touches
    assert (touch.x, touch.y, touch.drop) == pytest.approx((-0.01, 0.0, 0.2))


@pytest.mark.parametrize("start", [0.0, 0.1, 12345.678])
def test_a_loop_repeats_and_never_stands_still_at_its_seam(start):
    timeline = Timeline(scene.parse(SLIDE), start)
    for round_ in (0, 1, 7, 1000):
        t = start + 4.0 * round_
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
    script = scene.parse(
        {
            "drift": {
                "background": [{"t": 0.0, "value": 1.0}, {"t": 10.0, "value": 0.9}],
                "contact": [{"electrode": 2, "keys": [{"t": 0.0, "value": 1.0}, {"t": 10.0, "value": 1.5}]}],
            }
        }
    )
    timeline = Timeline(script)
    assert timeline.at(5.0).background == pytest.approx(0.95)
    assert timeline.at(99.0).background == pytest.approx(0.9)
    assert timeline.at(5.0).contact[2] == pytest.approx(1.25)
    assert timeline.at(5.0).contact[3] == 1.0


@pytest.mark.parametrize("name", scene.names())
def test_every_shipped_scene_plays(name):
    timeline = Timeline(scene.load(name))
    t, most = 0.0, 0
    while t < min(timeline.script.duration or 1.0, 60.0):
        segment = timeline.segment(t)
        assert segment.start <= t < segment.end
        most = max(most, len(segment.first.touches))
        t = segment.end
    assert most <= 3
    assert (most > 0) == (name != "demo")


def test_demo_is_untouched():
    assert scene.load("demo").tracks == ()


def test_paper_49_presses_every_position_with_every_force():
    tracks = scene.load("paper_49").tracks
    seen = {(round(p.x, 4), round(p.y, 4), round(max(q.drop for q in t.poses), 3)) for t in tracks for p in t.poses}
    assert len(tracks) == 245 and len(seen) == 245
    first = tracks[0].poses[1]
    assert (first.x, first.y) == pytest.approx((-0.03, 0.03))  # the top left comes first
    assert first.radius == 0.005


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"touchs": []}, "unknown key touchs"),
        ({"loop": True, "duration": 2.0}, "after the loop's duration"),
        ({"touch": [{"keys": [{"t": 0.0, "x": 0, "y": 0, "force": 1}]}]}, "at least two times"),
        ({"touch": [{"shape": "star", "keys": [{"t": 0.0, "x": 0, "y": 0, "force": 1}]}]}, "expected one of circle"),
        ({"touch": [{"keys": [{"t": 0.0, "x": 0, "y": 0, "force": 200}]}]}, "expected 0 to .* N on this patch"),
        ({"touch": [{"keys": [{"t": 0.0, "x": 20, "y": 0, "force": 1}]}]}, "positions are metres"),
    ],
)
def test_a_wrong_scene_is_refused_by_name(change, says, tmp_path):
    with pytest.raises(ValueError, match=says):
        scene.parse({**SLIDE, **change})


def test_a_missing_scene_names_those_there_are(tmp_path):
    with pytest.raises(scene.SceneError, match="paper_49"):
        scene.load("nowhere")
    broken = tmp_path / "broken.toml"
    broken.write_text("loop = ")
    with pytest.raises(scene.SceneError, match="broken.toml"):
        scene.load(broken)


def test_steps_grow_with_the_way_and_are_none_for_a_still_world():
    a = World((Touch("circle", 0.0, 0.0, 0.01, 0.3),))
    b = World((Touch("circle", 0.02, 0.0, 0.01, 0.3),))
    assert steps_between(a, a) == 0
    assert steps_between(a, b) == 8


@pytest.mark.parametrize("kind", ["circle", "triangle", "rectangle", "L", "hertz"])
def test_a_touch_is_the_force_that_was_asked_for_whatever_its_size(kind):
    for radius, newton in ((0.005, 1.0), (0.01, 3.0), (0.02, 5.0), (0.006, 4.0)):
        made = scene.touch({"shape": kind, "x": 0.0, "y": 0.0, "force": newton, "radius": radius, "aspect": 1.5})
        assert made.force_n == pytest.approx(newton) and 0 < made.drop < 1
    disc = scene.touch({"x": 0.0, "y": 0.0, "force": 1.0, "radius": 0.005})
    assert disc.drop == pytest.approx(0.4) and disc.pressure == pytest.approx(1.0 / (3.14159265 * 0.005**2))
