"""Named worlds: what they do to the skin, how right their solutions' short cut is; scenes: the world between keys."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from firmware_stub import scene
from firmware_stub.analog import four_terminal
from firmware_stub.rig import Rig
from firmware_stub.timeline import Script, Timeline, TouchPath, press_track
from firmware_stub.world import Touch, World, steps_between
from firmware_stub.worlds import table
from firmware_stub.worlds.disturbances import Disturbances, Flicker, Hum, Telegraph
from firmware_stub.worlds.foam import ExponentialCreep, PowerCreep
from simulation.scenes import path_of

CREEPS = [ExponentialCreep(((0.05, 2.0), (0.05, 40.0))), PowerCreep(0.15, 0.2)]
NOISE = 1e-4  # relative, of 80 dB


def track(begin: float, end: float, to: tuple[float, float] | None = None) -> TouchPath:
    return path_of(Touch("circle", 0.01, 0.0, 0.008, 0.4), begin, end, 0.05, to)


def shown(world: str, *tracks: TouchPath) -> Rig:
    rig = Rig(world=world, seed=3)
    rig.field.play(rig.timeline(Script("test", tracks=tracks), 0.0), 0.0)
    return rig


@pytest.mark.parametrize("name", ["all", "creep-power"])
def test_what_is_interpolated_between_solutions_is_within_a_fifth_of_the_noise(name: str) -> None:
    script = Script("test", tracks=(track(1.0, 2.0), track(2.5, 3.0, (-0.02, 0.01))))
    rig = shown(name, *script.tracks)
    timeline, pattern = rig.timeline(script, 0.0), rig.sheet.skin.pattern
    for t in np.random.default_rng(1).uniform(0.9, 4.0, 9):
        matrices, weights = rig.field.over(np.array([t]))
        found = four_terminal(np.einsum("m,mij->ij", weights[0], matrices), pattern)
        world = rig.nature._world(timeline, replace(timeline, nature=None).segment(t), t, t)
        exact = four_terminal(rig.sheet.transfer(world), pattern)
        assert np.sqrt(np.mean((found / exact - 1) ** 2)) < 0.2 * NOISE, t


@pytest.mark.parametrize("creep", CREEPS)
def test_a_constant_force_creeps_and_fades_as_the_sum_over_small_steps(creep: ExponentialCreep | PowerCreep) -> None:
    held = ((0.0, 0.1, 60.0, 60.1), (0.0, 1.0, 1.0, 0.0))
    after = [creep.added(60.1 + t, *held) for t in (0.0, 1.0, 10.0, 60.0)]
    assert 0.05 < creep.added(60.0, *held) < 0.15 and 0.01 < after[0] < 0.12
    assert after == sorted(after, reverse=True) and after[-1] < 0.5 * after[0]
    times, drops = (1.0, 1.5, 4.0, 4.2), (0.0, 0.4, 0.3, 0.0)
    instants = np.linspace(1.0, 4.2, 20_001)
    steps = np.diff(np.interp(instants, times, drops))
    middles = (instants[1:] + instants[:-1]) / 2
    for t in (1.2, 3.0, 4.1, 9.0):
        summed = sum(step * creep.at(t - at) for step, at in zip(steps, middles, strict=True))
        assert creep.added(t, times, drops) == pytest.approx(summed, abs=1e-5)


def test_a_residue_stays_where_a_touch_was_and_no_truth_tells() -> None:
    rig = shown("creep", track(1.0, 4.0))
    during, after = rig.field.at(3.0), rig.field.at(4.5)
    assert during.touches[0].drop == 0.4 and 0.002 < during.touches[0].crept < 0.06 and not after.touches
    (residue,) = after.residues
    assert (residue.x, residue.y) == (0.01, 0.0) and 0.002 < residue.drop < 0.4 * 0.08
    assert all(left.drop < residue.drop / 2 for left in rig.field.at(60.0).residues)
    rig = shown("creep", track(1.0, 2.0, (-0.03, 0.0)))
    trail = rig.field.at(2.05).residues
    assert len(trail) > 3 and min(left.x for left in trail) < -0.02, "a slide leaves a trail"
    rig.press({"x": 0.0, "y": 0.02, "force": 3.0, "seconds": 2.0}, 101.0)
    assert (0.0, 0.02) in {(left.x, left.y) for left in rig.field.at(105.2).residues}, "a press on request too"


def test_a_hand_warms_its_place_and_the_sheet_conducts_better_there() -> None:
    rig = shown("warm-hand", track(1.0, 20.0))
    (spot,) = rig.field.at(19.0).spots
    assert 0.01 < spot.share < 0.067 and (spot.x, spot.y) == (0.01, 0.0)
    cooling = [rig.field.at(t).spots[0].share for t in (21.0, 40.0, 80.0)]
    assert cooling == sorted(cooling, reverse=True)
    cold = four_terminal(rig.sheet.transfer(rig.field.at(0.5)), rig.sheet.skin.pattern)
    warm = four_terminal(rig.sheet.transfer(rig.field.at(21.0)), rig.sheet.skin.pattern)
    assert (warm < cold).all()
    rig = shown("warming")
    cold, before, later = (rig.field.at(t).background for t in (3.0, 6.0, 66.0))
    assert before == pytest.approx(cold, abs=1e-4) and 0.008 < later - before < 0.011


def test_slopes_of_contact_impedances_are_what_a_solution_finds() -> None:
    sheet = table.sheet("plain", 1)
    rows, contact = np.asarray(sheet.skin.pattern, np.int64), sheet.skin.contact_impedance.copy()
    contact[4] *= 1.01
    z, other = (sheet.model.read(sheet.model.solve(*at).transfer) for at in ((), (1.0, contact)))
    found = four_terminal(sheet.contact_slopes()[4], rows) * 0.01
    assert np.abs(found - (other - z)).max() < 0.01 * np.abs(other - z).max()


def test_flicker_and_jumps_have_the_size_that_their_world_says() -> None:
    slopes = table.sheet("plain", 1).contact_slopes()
    made = Disturbances(slopes, 5, flicker=Flicker(1e-3), telegraph=Telegraph(0.02, 2.0))
    off = np.concatenate([made._contacts(np.arange(k, k + 120) * 2.2e-3) for k in range(0, 40_000, 120)])
    jumping = np.flatnonzero(off.std(axis=0) > 5e-3)
    assert len(jumping) == 3
    still = np.setdiff1d(np.arange(16), jumping)
    assert off[:, still].std() == pytest.approx(1e-3, rel=0.25)
    assert 0.018 < np.ptp(off[:, jumping[0]]) < 0.03


def test_interference_is_a_line_a_sweep_or_bursts() -> None:
    sheet, t = table.sheet("plain", 1), np.arange(0, 40.0, 1e-3)
    slopes, rows = sheet.contact_slopes(), np.asarray(sheet.skin.pattern, np.int64)
    one, many = rows[:1].repeat(len(t), axis=0), np.ones(len(t))

    def share(hum: Hum, begin: float, end: float, frequency: float) -> float:
        wave = Disturbances(slopes, 5, hum=hum).ohm(one, t, many)[(t >= begin) & (t < end)]
        power = np.abs(np.fft.rfft(wave)) ** 2
        at = np.fft.rfftfreq(len(wave), 1e-3)
        return float(power[np.abs(at - frequency) < 20].sum() / power.sum())

    assert share(Hum(2e-4, 50.0), 0, 40, 50) > 0.99
    sweep = Hum(2e-4, 30.0, 300.0)
    assert share(sweep, 0.0, 1.0, 37) > 0.9 and share(sweep, 19.0, 20.0, 293) > 0.9
    bursts = Hum(1e-3, 120.0, on_s=0.05)
    assert bursts.on(t, 5).mean() == pytest.approx(0.025, rel=0.1)


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
