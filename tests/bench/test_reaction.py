"""The reaction benchmark: its scene says what its truth says, and what counts as a touch seen in place."""

import numpy as np
import pytest

from bench.speed import reaction
from bench.speed.reaction_events import KINDS, SIDE_M, STEPS_TO_RECV, SeenFrame, TouchEvent, events, react, scene
from bench.speed.reaction_report import PIECES, sums
from firmware_stub import scene as scenes
from firmware_stub.timeline import Timeline
from protocol.frames import Contact, ContactFrame

STILL = TouchEvent(KINDS[0], 1.0, 1.3, 0.01, 0.0, 0.01, np.inf)


def seen(t, *at, valid=True, reasons=(), sigma=None, state="hold", sampled=None, velocity=(0.0, 0.0)):
    contacts = [
        Contact(id=1, state=state, position=[x, y, 0.0], position_sigma=sigma, velocity=[*velocity, 0.0]) for x, y in at
    ]
    frame = ContactFrame(skin="palm", valid=valid, reasons=list(reasons), contacts=contacts)
    return SeenFrame(t, t - 0.02 if sampled is None else sampled, frame)


def test_the_scene_plays_the_events_one_at_a_time(tmp_path):
    plan = events({kind.name: 4 for kind in KINDS}, 0.35, seed=3)
    path = tmp_path / "reaction.toml"
    path.write_text(scene(plan))
    timeline = Timeline(scenes.load(path), 100.0)
    assert len(plan) == 4 * len(KINDS)
    for event in plan:
        assert timeline.at(100.0 + event.onset - 1e-4).touches == ()
        assert timeline.at(100.0 + event.end + 1e-4).touches == ()
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
    found = react(pair, 2.0, frames)
    assert found.near_s == pytest.approx(0.06), "the third is not held against it"
    assert found.contact_s == pytest.approx(0.11) and found.gone_s == pytest.approx(0.1)


def test_the_stamps_of_the_first_frame_near_say_where_its_time_went():
    late = seen(1.030, (0.01, 0.0), sampled=1.004)
    clock = 500.0  # the stamps' clock has another beginning than the scene's
    at = dict(zip(STEPS_TO_RECV, (1.004, 1.007, 1.019, 1.0195, 1.026), strict=True))
    late.frame.stamps = {step: round((t + clock) * 1e9) for step, t in at.items()}
    found = react(STILL, 2.0, [seen(1.02, (0.03, 0.0)), late])
    (row,) = sums("rolling", [(STILL, found)])
    assert [row[f"{name}_ms"] for name in PIECES] == pytest.approx([4.0, 3.0, 12.0, 0.5, 6.5, 4.0])
    assert row["whole_ms"] == pytest.approx(30.0) and 4.0 < row["floor_ms"] < 30.0
    del late.frame.stamps["infer"]
    (row,) = sums("rolling", [(STILL, react(STILL, 2.0, [late]))])
    assert row["inference_ms"] == 0 and row["publisher_ms"] == pytest.approx(7.0), "a part goes without inference"
    assert sums("rolling", [(STILL, react(STILL, 2.0, [seen(1.02, (0.01, 0.0))]))]) == [], "no stamps in simulated time"


def test_a_touch_is_seen_with_the_first_of_the_frames_that_all_are_in_place():
    there, off = (0.01, 0.0), (0.02, 0.0)
    frames = [seen(1.02), seen(1.06, off, reasons=["changing"]), seen(1.11, there), seen(1.15, off)]
    found = react(STILL, 2.0, [*frames, seen(1.2, there), seen(1.25, there), seen(1.4, there), seen(1.5), seen(1.6)])
    assert found.contact_s == pytest.approx(0.2)
    assert found.near_s == pytest.approx(0.11), "the first one is off"
    assert found.gone_s == pytest.approx(0.2)
    assert (found.wrong, found.unstated) == (0, 1), "the frame that says changing is not held against it"


@pytest.mark.parametrize("bad", [{"valid": False}, {"reasons": ["coarse"]}, {"reasons": ["changing"]}])
def test_a_doubtful_frame_before_the_release_is_no_touch_seen(bad):
    frames = [seen(1.05, (0.01, 0.0)), seen(1.2, (0.01, 0.0), **bad)]
    found = react(STILL, 2.0, frames)
    assert np.isnan(found.contact_s) and np.isnan(found.gone_s)


def test_an_early_frame_is_wrong_beyond_three_of_its_own_sigmas_whatever_it_says():
    sigma = [0.002, 0.001, 0.0]
    near = seen(1.03, (0.015, 0.0), sigma=sigma, reasons=["coarse"])
    far = seen(1.04, (0.017, 0.0), sigma=sigma, reasons=["coarse"])
    found = react(STILL, 2.0, [near, far, seen(1.1, (0.01, 0.0))])
    assert (found.wrong, found.unstated) == (1, 0)
    assert react(STILL, 2.0, [seen(1.04, (0.02, 0.0), sigma=sigma, valid=False)]).wrong == 0


def test_a_slide_is_scored_against_the_truth_at_recv_and_at_the_sample():
    kind = KINDS[5]
    slide = TouchEvent(kind, 1.0, 1.4, 0.0, 0.0, 0.01, 1.2, (0.3, 0.0))
    frame = seen(1.3, (0.015, 0.0), sampled=1.25, velocity=(0.27, 0.0))
    found = react(slide, 2.0, [frame])
    assert found.errors_m == pytest.approx([0.015])
    assert found.slip == pytest.approx([0.1])
    assert found.contact_s == pytest.approx(0.3), "where it was when it was measured"


def test_a_held_touch_is_scored_where_it_is_still_and_beside_full_scans():
    from bench.speed.reaction_report import goals, rows

    def of(mode, off):
        frames = [seen(STILL.onset + t, (0.01 + off, 0.0)) for t in (0.05, 0.16, 0.2, 0.25)]
        for each in frames:
            each.frame.contacts[0].force_n = 2.1
        reaction = react(STILL, STILL.end + 0.3, frames)
        assert reaction.held_m == pytest.approx([off] * 3)
        assert reaction.held_force == pytest.approx([0.05] * 3)
        return rows(mode, [(STILL, reaction)])

    listed = {goal.figure: goal for goal in goals(of("full", 4e-4) + of("rolling", 3e-4), {})}
    goal = listed[f"rolling: {KINDS[0].name}: held, position error as a share of full scans'"]
    assert goal.value == pytest.approx(0.75) and goal.at_most == 1.0


def test_a_release_that_shows_while_the_force_still_fades_is_no_later_than_its_end():
    ramp = TouchEvent(KINDS[3], 1.0, 1.4, 0.01, 0.0, 0.01, np.inf)
    frames = [seen(1.2, (0.01, 0.0)), seen(1.37, (0.01, 0.0)), seen(1.395), seen(1.44)]
    assert react(ramp, 2.0, frames).gone_s == 0.0
    assert react(STILL, 2.0, [seen(1.29, (0.01, 0.0)), seen(1.34)]).gone_s == pytest.approx(0.04)


def test_truths_are_counted_within_the_ellipse_and_the_force_that_a_contact_states():
    from bench.speed.reaction_report import stated

    frames = []
    for t, dx, dy, force in (
        (1.01, 2e-3, 0.0, 2.0),
        (1.16, 2e-3, 0.0, 2.15),
        (1.2, 0.0, 2e-3, 2.05),
        (1.25, 0, 0, 1.7),
    ):
        frame = seen(t, (0.01 + dx, dy), sigma=[0.002, 0.0005, 0.0])
        frame.frame.contacts[0].force_n, frame.frame.contacts[0].force_sigma_n = force, 0.1
        frames.append(frame)
    found = {row["phase"]: row for row in stated("rolling", [(STILL, react(STILL, 2.0, frames))])}
    assert found["onset, 20 ms"]["position_68"] == 100 and found["onset, 20 ms"]["frames"] == 1
    held = found["held"]
    assert (held["frames"], held["touches"]) == (3, 1)
    assert held["position_68"] == held["position_90"] == pytest.approx(200 / 3), "2 mm along the short axis is 4 sigma"
    assert (held["force_68"], held["force_90"]) == pytest.approx((100 / 3, 200 / 3))


def test_the_floor_of_a_light_touch_is_higher_and_so_is_that_of_a_noisy_skin():
    from bench.speed.reaction_floor import held_floor

    light = TouchEvent(KINDS[1], 1.0, 1.3, 0.01, 0.0, 0.005, np.inf)
    strong = TouchEvent(KINDS[0], 1.0, 1.3, 0.01, 0.0, 0.0075, np.inf)
    assert held_floor([light], 80.0)[0] > 1.5 * held_floor([strong], 80.0)[0] > 0
    assert held_floor([strong], 60.0)[0] > 2 * held_floor([strong], 80.0)[0]


def test_two_that_begin_at_once_are_in_place_from_the_third_scan_on_in_parts(monkeypatch):
    """Taken for a broad one at first: what was learnt of its size does not hold for the one of the two that goes on. Of
    32 such pairs, eight on each of four processors' kernels, 2 are later (before, most were): here one may be.
    """
    scan_s, plan, at = 0.0436, [], 1.0
    for phase in (0.0, 0.008, 0.016, 0.020, 0.024, 0.028, 0.032, 0.036):
        at = round(float(np.ceil((at + 0.5) / scan_s) * scan_s + phase), 5)
        plan.append(TouchEvent(KINDS[6], at, at + 0.35, 0.001, -0.013, 0.0071, np.inf, others=((0.029, -0.027),)))
        at = plan[-1].end
    monkeypatch.setattr(reaction, "events", lambda *_: plan)
    found, _ = reaction.simulated("rolling", {}, 1)
    late = [each.contact_s for _, each in found if not each.contact_s < 3 * scan_s]
    assert len(late) <= 1, late
