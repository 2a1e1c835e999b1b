"""The first parts after a touch began: it is seen and placed with an honest uncertainty; faults and noise are not."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.simulated_host import SimulatedHost
from firmware_stub.timeline import PiecewiseLinear, Script, Timeline
from tests.services.gap_host import SCAN_S


@pytest.fixture(scope="module")
def host():
    host = SimulatedHost("rolling", snr_db=80.0, seed=7)
    host.until(6.0)
    yield host
    host.rig.close()


def test_a_touch_reaches_a_controller_within_three_parts_and_so_does_its_end(host):
    for x, y in ((0.02, -0.01), (-0.025, 0.02)):
        began, first = host.now, len(host.contacts)
        host.press(x=x, y=y, force=2.0, radius=0.01, seconds=60.0)
        host.until(began + 0.25)
        seen = [(t, f) for t, f in host.contacts[first:] if f.valid and f.contacts]
        assert seen[0][0] - began < 0.025
        for t, frame in seen:
            (contact,) = frame.contacts
            assert np.hypot(contact.position[0] - x, contact.position[1] - y) < 3e-3, t - began
            if frame.part and "coarse" not in frame.reasons and contact.position_sigma:
                assert np.hypot(contact.position[0] - x, contact.position[1] - y) < 3 * contact.position_sigma[0]
        assert len({c.id for _, f in seen for c in f.contacts}) == 1, "the network's image is of the same touch"
        assert not any("changing" in f.reasons for _, f in seen)
        ended, first = host.now, len(host.contacts)
        host.release()
        host.until(ended + 0.3)
        gone = [(t, f) for t, f in host.contacts[first:] if f.valid and all(c.state == "end" for c in f.contacts)]
        assert gone[0][0] - ended < 0.025
        later = [f for t, f in host.contacts[first:] if t > gone[0][0]]
        assert all(f.valid and all(c.state == "end" for c in f.contacts) for f in later), "it does not come back"
        host.until(host.now + 0.3)
    samples = [f.stamps["sample"] for _, f in host.contacts]
    assert samples == sorted(samples)


@pytest.mark.release
@pytest.mark.parametrize("x, y", [(0.037, -0.044), (-0.0137, 0.0436)])
def test_a_touch_on_an_electrode_is_not_taken_for_its_contact_after_parts_had_told_them_apart(x, y):
    """The two whole scans after its beginning were of a contact that jumped, by what they show alone. A whole scan
    tells them apart: the first one after the beginning.
    """
    host = SimulatedHost("rolling", snr_db=80.0, seed=4)
    host.until(6.0)
    began, first = host.now, len(host.contacts)
    host.press(x=x, y=y, force=2.0, radius=0.006, seconds=60.0)
    host.until(began + 0.4)
    host.rig.close()
    frames = [f for _, f in host.contacts[first:]]
    assert all(f.valid for f in frames)
    assert [t for t, f in host.contacts[first:] if f.contacts][0] - began < SCAN_S


def test_a_contact_that_jumps_as_a_touch_begins_elsewhere_is_named():
    """That the touch is none is no reason not to ask of others."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=11)
    host.until(6.0)
    jump = PiecewiseLinear((0.0, 0.106, 0.107), (1.0, 1.0, 4.0))
    host.rig.field.play(
        Timeline(Script("jumps", contact=((0, jump),)), host.now, (), host.rig.sheet.electrodes), host.now
    )
    host.until(host.now + 0.1)
    began, first = host.now, len(host.contacts)
    host.press(x=0.004, y=0.008, force=2.0, radius=0.007, seconds=60.0)
    host.until(began + 0.3)
    host.rig.close()
    named = [t - began for t, f in host.contacts[first:] if any(r.startswith("electrode") for r in f.reasons)]
    assert named and named[0] < 0.2


@pytest.mark.release
def test_no_whole_scan_is_made_of_values_from_before_and_after_a_release():
    """Of a release within the newest values too: such a scan looks like a contact that jumped, asking takes 20 ms."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=9)
    host.until(6.0)
    for k in range(20):
        host.press(x=0.03, y=-0.028, force=2.0, radius=0.0075, seconds=60.0)
        host.until(host.now + 0.3 + 0.0022 * k)
        ended, first = host.now, len(host.contacts)
        host.release()
        host.until(ended + 0.25)
        after = host.contacts[first:]
        assert all(f.valid and "changing" not in f.reasons for _, f in after), k
        assert next(t for t, f in after if all(c.state == "end" for c in f.contacts)) - ended < 0.02
    host.rig.close()


def test_a_light_tap_leaves_no_silence_behind():
    """What was left of it looked like a force that grows, so that the whole scan was put off by 0.3 s."""
    host, rng = SimulatedHost("rolling", snr_db=80.0, seed=2), np.random.default_rng(5)
    host.until(6.0)
    first = len(host.contacts)
    for _ in range(12):
        x, y = rng.uniform(-0.03, 0.03, 2).tolist()
        host.press(x=x, y=y, force=0.45, radius=0.005, seconds=rng.uniform(0.01, 0.025))
        host.until(host.now + 0.3 + rng.uniform(0.0, 0.05))
    host.rig.close()
    assert np.diff([t for t, _ in host.contacts[first:]]).max() < 0.1
    assert any(f.contacts for _, f in host.contacts[first:])


def test_while_nothing_touches_a_part_makes_no_frame(host):
    host.release()
    host.until(host.now + 0.5)
    first = len(host.contacts)
    host.until(host.now + 2.0)
    frames = [f for _, f in host.contacts[first:]]
    assert len(frames) / 2.0 == pytest.approx(22.9, rel=0.05)
    assert all(f.valid and not f.contacts for f in frames)


def test_a_tare_makes_no_contact_and_is_followed_by_touches_again(host):
    """The differences that parts are compared with were to the baseline before."""
    host.release()  # of whatever the tests before pressed
    host.until(host.now + 3.5)
    first = len(host.contacts)
    host.pipeline.pre.command("tare", {"calibrate": False})
    host.until(host.now + 0.5)
    assert len(host.contacts) > first and all(f.valid for _, f in host.contacts[first:])
    assert not any(f.contacts for _, f in host.contacts[first:])
    began, first = host.now, len(host.contacts)
    host.press(x=0.01, y=0.0, force=2.0, radius=0.01, seconds=0.2)
    host.until(began + 0.1)
    assert [t for t, f in host.contacts[first:] if f.valid and f.contacts][0] - began < 0.025
    host.until(began + 0.6)


@pytest.mark.parametrize("fault", [{"name": "electrode_open", "args": {"electrode": 4}}, {"name": "gain", "args": {}}])
def test_a_fault_of_the_board_makes_no_contact(fault):
    host = SimulatedHost("rolling", snr_db=80.0, seed=11)
    host.until(5.0)
    first = len(host.contacts)
    host.rig.fault(fault["name"], fault["args"], host.now, seconds=1.0)
    host.until(host.now + 2.0)
    assert not any(f.valid and f.contacts for _, f in host.contacts[first:])
    host.rig.close()
