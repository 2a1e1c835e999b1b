"""Benchmarks: scores of frames made by hand, the page of reports, every command line; what counts as a reaction."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest

import bench
from bench import all as page
from bench.accuracy import compare, scores
from bench.accuracy import frames as _frames
from bench.accuracy.frames import Frames
from bench.force_presses import PlannedPress, planned
from bench.goals import Goal
from bench.speed.reaction_events import KINDS, SIDE_M, SeenFrame, TouchEvent, events, react, scene
from firmware_stub import scene as scenes
from firmware_stub.timeline import Timeline
from models import metrics, patterns
from models.forward import shared
from models.shapes import Shape, drop_image, to_rows
from protocol.frames import Contact, ContactFrame


def frames_of(groups):
    """Frames without physics: (group, scene) pairs, impedances all one."""
    names, rows = np.array([g for g, _ in groups]), np.array([to_rows(scene, 4) for _, scene in groups])
    pairs, adjacent = np.ones((len(groups), 120)), np.ones((len(groups), 208))
    return Frames(names, rows, pairs, pairs, adjacent, adjacent)


def test_symmetry_moves_touches_as_solving_them_does_and_covers_the_papers_grid():
    model, pair = shared("square16", "inverse"), patterns.pattern("pairs", 16)
    shape, z0 = Shape("circle", 0.6, 0.2, 0.2, 0.3), model.solve(1.0).impedances(pair)
    solution = model.solve(model.touched([shape]))
    for turn, to in _frames.symmetries()[:3]:
        x, y = turn @ (shape.x, shape.y)
        back = np.argsort(to)[pair]
        moved = solution.impedances(back) / model.solve(1.0).impedances(back) - 1
        solved = model.solve(model.touched([replace(shape, x=x, y=y)])).impedances(pair) / z0 - 1
        assert np.linalg.norm(moved - solved) < 5e-3 * np.linalg.norm(solved)  # the mesh is not symmetric
    octant = [scene[0] for name, scene in _frames.scenes(1, 2) if name == "ldci-0.2-0.15"]
    spread = {(round(x, 6), round(y, 6)) for s in octant for t, _ in _frames.symmetries() for x, y in [t @ (s.x, s.y)]}
    assert spread == {(round(x, 6), round(y, 6)) for x, y in metrics.ldci_positions(0.2)}


def test_noise_is_what_it_says():
    frames = frames_of([("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])] * 50)
    noisy, untouched = _frames.noisy(frames, "60", seed=1)
    assert noisy.pairs.std() == pytest.approx(1e-3, rel=0.05) == untouched.std()
    assert (noisy.pairs0[0] - 1).std() == pytest.approx(1e-3 / 8, rel=0.2)  # the mean of 64
    assert np.median(compare.tares(noisy, untouched)[""].sigma) == pytest.approx(1e-3, rel=0.1)
    weak = replace(frames, adjacent=frames.adjacent * 0.01, adjacent0=frames.adjacent0 * 0.01)
    assert (_frames.noisy(weak, "60f", 1)[0].adjacent / 0.01).std() == pytest.approx(0.1, rel=0.05)


def test_perfect_images_score_perfectly_and_poor_ones_do_not():
    groups = [("shapes", [Shape(k, 0.2, 0.1, 0.35, 0.3, 0.3)]) for k in ("circle", "triangle", "L")]
    groups += [("force", [Shape("circle", -0.3, 0.2, 0.2, 0.25)])]
    groups += [("two", [Shape("circle", -0.5, 0, 0.25, 0.3), Shape("square", 0.5, 0, 0.25, 0.2)])]
    frames, index = frames_of(groups), np.arange(5)
    truth = np.array([drop_image(frames.scene(k), 96) for k in index])
    best = scores.of_images(truth, frames, index)
    assert best["mean_iou"] > 0.98 and best["position_%"] < 0.2 and best["count_%"] == best["single_%"] == 100
    assert best["force_%"] < 0.1 and best["integral_%"] < 0.5 and best["four_%"] is None
    shifted = scores.of_images(np.roll(truth, 6, axis=2) * 1.2, frames, index)
    assert shifted["position_%"] == pytest.approx(6 / 96 * 100, rel=0.05)
    assert shifted["force_%"] == pytest.approx(20, rel=0.01)
    assert scores.of_images(truth * 0.5, frames, index, (2.0, 2.0))["force_%"] < 0.1


def test_contacts_are_scored_where_they_are_shown_and_counted_where_they_are_not():
    groups = [("shapes", 0.3)] * 3 + [("force", 0.2)] * 3
    frames = frames_of([(name, [Shape("circle", 0, 0, radius, 0.2)]) for name, radius in groups])
    found = {
        **{"count": np.array([1, 1, 2, 1, 1, 0]), "valid": np.ones(6, bool), "force_sigma": np.ones((6, 1))},
        "position": np.column_stack([0.001 * np.arange(6), np.zeros(6)])[:, None],  # 0, 1, 2 ... % of the side
        "force": np.array([[2.0], [2.0], [2.0], [2.2], [1.4], [np.nan]]),
        "shape": np.array([["circle"], ["circle"], ["L"], ["circle"], ["circle"], [""]]),
    }
    row = scores.of_contacts(found, frames)
    assert row["position_%"] == pytest.approx(2) and row["position_%_se"] == pytest.approx(np.sqrt(2.5 / 5))
    assert row["force_%"] == pytest.approx(20) and row["force_%_se"] == pytest.approx(10)
    assert row["shape_%"] == pytest.approx(200 / 3) and row["single_%"] == pytest.approx(400 / 6)
    assert (row["missed"], row["far"], row["not_valid"]) == (1, 0, 0)


@pytest.mark.parametrize("name", sorted(each.name for each in page.BENCHMARKS))
def test_each_program_refuses_what_is_no_number(name, capsys):
    with pytest.raises(SystemExit):
        option = {"latency": "--seconds", "peers": "--rounds", "trust": "--minutes"}.get(name, "--seed")
        importlib.import_module(bench.commands()[name]).main([option, "nan"])
    assert "found" in capsys.readouterr().err


def test_a_figure_is_held_against_its_goal_and_the_reports_before(tmp_path):
    head = {"command": "skin bench force", "commit": "c0ffee", "machine": "2 x one", "versions": {"python": "3"}}
    goals = [Goal("error, %", 9.0, at_most=7.0), Goal("ratio", 1.5), Goal("shown, %", 99.0, at_least=98.0)]
    before = {"error, %": [4.0, 4.1, 4.2], "ratio": [1.4], "shown, %": [99.0, 98.9]}
    report = {**head, "targets": [goal.to_dict() for goal in goals], "before": before, "left_out": []}
    (tmp_path / "force.json").write_text(json.dumps(report))
    assert page.main(["--reuse", "--out", str(tmp_path)]) == 0
    written = (tmp_path / "README.md").read_text()
    assert "| error, % | 9 | 4.2 | at most 7 | **missed**, worse than before |" in written
    assert "| ratio | 1.5 | 1.4 |  |  |" in written and "| shown, % | 99 | 98.9 | at least 98 | met |" in written
    assert page.history(report)["error, %"] == [4.0, 4.1, 4.2, 9.0]


def test_a_press_is_scored_by_the_nearest_contact_of_a_valid_frame():
    def contact(x, newton, state="ongoing"):
        said = {"force_n": newton, "force_sigma_n": 0.1, "pressure_pa": 1.0, "pressure_sigma_pa": 0.1}
        return {"state": state, "position": [x, 0.0, 0.0], **said}

    press = PlannedPress(10.0, 2.0, 0.02, 0.0)
    frame = {"valid": True, "reasons": ["extrapolated"], "contacts": [contact(-0.02, 9.0), contact(0.021, 2.1)]}
    row = press.row("full", frame)
    assert (row.said, row.sigma, row.extrapolated) == (2.1, 0.1, True)
    for change in ({"valid": False}, *({"contacts": [contact(0.02, *c)]} for c in ((2.0, "end"), (None,)))):
        assert press.row("full", {**frame, **change}).said is press.row("full", None).said is None
    assert list(planned(2, 3)) == list(planned(2, 3)) != list(planned(2, 4))


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
