"""What named worlds do to the skin, and how right the short cut of their solutions is."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_stub.analog import four_terminal
from firmware_stub.rig import Rig
from firmware_stub.timeline import Script, TouchPath
from firmware_stub.world import Touch
from firmware_stub.worlds import table
from firmware_stub.worlds.disturbances import Disturbances, Flicker, Hum, Telegraph
from firmware_stub.worlds.foam import ExponentialCreep, PowerCreep

CREEPS = [ExponentialCreep(((0.05, 2.0), (0.05, 40.0))), PowerCreep(0.15, 0.2)]
NOISE = 1e-4  # relative, of 80 dB


def track(begin: float, end: float, to: tuple[float, float] | None = None) -> TouchPath:
    touch = Touch("circle", 0.01, 0.0, 0.008, 0.4)
    there = replace(touch, x=to[0], y=to[1]) if to else touch
    poses = (replace(touch, drop=0.0), touch, there, replace(there, drop=0.0))
    return TouchPath((begin, begin + 0.05, end - 0.05, end), poses)


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
    assert during.touches[0].drop == 0.4 and 0.002 < during.touches[0].crept < 0.06
    assert not after.touches
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
