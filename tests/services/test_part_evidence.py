"""The first parts after a touch began: it is seen and placed with an honest uncertainty; faults and noise are not."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.simulated_host import SimulatedHost
from firmware_stub.timeline import PiecewiseLinear, Script, Timeline
from models.forward import shared
from models.shapes import Shape
from services.estimation.rolling import measured_at

SIGMA = 1e-4
AGE_US = 43_600.0


def frame(bundle, change, fresh, newest=3, seed=0, ramp=False):
    """d, noise and age where `change` (K,) is felt by the `fresh` newest values."""
    rng = np.random.default_rng(seed)
    at = measured_at(bundle, newest)
    rank = np.argsort(np.argsort(-at))  # 0: the newest
    course = np.clip((fresh - rank) / fresh, 0, 1) if ramp else rank < fresh
    return change * course + SIGMA * rng.standard_normal(120), np.full(120, SIGMA), (1 - at) * AGE_US


def touch(bundle, image, x, y, radius=0.2, drop=0.2):
    return drop * image.responses(np.array([[x, y, np.log(radius)]]), np.arange(120))[0]


@pytest.mark.parametrize("ramp", [False, True])
def test_a_touch_is_seen_from_two_parts_and_lies_where_its_uncertainty_says(bundle, evidence, image, places, ramp):
    rng = np.random.default_rng(3)
    off, stated = [], []
    for seed in range(12):
        x, y = rng.uniform(-0.7, 0.7, 2)
        fresh = int(rng.integers(20, 31))
        change = touch(bundle, image, x, y, drop=0.6 if ramp else 0.2)
        d, noise, age = frame(bundle, change, fresh, newest=1 + seed % 10, seed=seed, ramp=ramp)
        onset = evidence.began(d, noise, age)
        if onset is None:
            continue
        found = places(d, noise, age, onset.starts).touch
        if found.fits:
            off.append(np.hypot(found.at[0] - x, found.at[1] - y) / found.sigma[0])
            stated.append(found.sigma[0] / 2)
    assert len(off) >= (4 if ramp else 11)
    assert max(off) < 3 and np.median(off) < 1
    assert np.median(stated) < 0.05


def test_what_touched_only_some_of_the_newest_values_is_not_taken_for_all(bundle, evidence, image, places):
    """A part half touched, read as a whole one, would be wrong by a third of the side."""
    change = touch(bundle, image, 0.3, -0.4)
    for fresh in (17, 20, 29):
        d, noise, age = frame(bundle, change, fresh)
        onset = evidence.began(d, noise, age)
        assert onset is not None
        rank = np.argsort(np.argsort(age))
        felt = rank[places(d, noise, age, onset.starts).course > 0].max() + 1
        plain = np.abs(change[np.argsort(age)]) > 6 * SIGMA  # values that tell whether they felt it
        assert not plain[min(fresh, felt) : max(fresh, felt)].any()


def test_a_first_part_that_fits_a_step_here_and_a_ramp_there_says_so(bundle, evidence, places):
    """A strong touch, exactly solved: the likeliest course and place of a grid were up to 6.5 sigmas wrong."""
    x, y, model = 0.65, -0.506, shared("square16", "inverse")
    touched = model.solve(model.touched([Shape("circle", x, y, 0.166, 0.2)])).impedances(bundle.pattern)
    change, seen = np.abs(touched) / np.abs(model.solve().impedances(bundle.pattern)) - 1, 0
    for newest in range(1, 11):
        for fresh in range(8, 15):
            d, noise, age = frame(bundle, change, fresh, newest=newest, seed=fresh)
            if (onset := evidence.began(d, noise, age)) is not None:
                found, seen = places(d, noise, age, onset.starts).touch, seen + 1
                assert not found.fits or np.hypot(found.at[0] - x, found.at[1] - y) < 3 * found.sigma[0]
    assert seen > 50


@pytest.mark.parametrize("parts", [3, 6, 9])
def test_a_force_that_grew_and_stays_is_told_from_one_that_grows(bundle, image, places, parts):
    """Its course is that of all values, those older than the growth's end and older than the message included."""
    at, change = measured_at(bundle, 3), touch(bundle, image, 0.2, -0.3)
    seen = image.fit(change, np.full(120, SIGMA))
    age = (1 - at) * AGE_US
    for began in (0.6, 1.3):
        if began * 10 <= parts:
            continue
        true = np.clip((began * AGE_US - age) / (began * AGE_US - parts / 10 * AGE_US), 0, 1)
        d = true * change + SIGMA * np.random.default_rng(parts).standard_normal(120)
        course = places.course(d, np.full(120, SIGMA), age, seen)
        plain = np.abs(change) > 30 * SIGMA
        assert np.abs(course - true)[plain].max() < 0.12
    d = change + SIGMA * np.random.default_rng(1).standard_normal(120)
    assert places.course(d, np.full(120, SIGMA), age, seen).min() == 1.0, "it was there all the time"


def test_a_touch_that_goes_on_is_followed_from_where_it_was_and_a_fault_in_its_place_is_not(
    bundle, evidence, image, places
):
    change = touch(bundle, image, 0.3, -0.2, radius=0.15)
    d, noise, age = frame(bundle, change, 24, newest=2)
    place = places(d, noise, age, evidence.began(d, noise, age).starts)
    d, noise, age = frame(bundle, change, 36, newest=3, seed=1)
    again = places.again(d, noise, age, place.touch)
    assert evidence.goes_on(d, noise, again.course, places.response(again.touch)) > 50
    assert np.hypot(again.touch.at[0] - 0.3, again.touch.at[1] + 0.2) < 3 * again.touch.sigma[0]
    assert again.touch.sigma[0] < 1.1 * place.touch.sigma[0]
    contact = np.where(np.isin(bundle.pattern[:, :2], (3,)).any(axis=1), -0.02, 0.0)
    for wrong in (contact, np.full(120, 0.01), np.zeros(120)):
        d, noise, age = frame(bundle, wrong, 36, newest=3, seed=2)
        again = places.again(d, noise, age, place.touch)
        assert evidence.goes_on(d, noise, again.course, places.response(again.touch)) is None


def test_a_circle_that_leaves_the_skin_while_it_is_fitted_is_no_error(bundle, image):
    """What is left of a difference beside its first touch may be like no touch at all."""
    theta = np.array([1.0, 1.0, np.log(0.04), np.log(0.005)])
    assert np.abs(image._linear(theta, np.arange(120), np.zeros(120), np.ones(120))[2][:, :2]).max() < 1e-6
    image_start = image._start
    try:
        image._start = lambda *_: theta
        found = image.fit(-touch(bundle, image, 0.3, -0.4), np.full(120, SIGMA))
    finally:
        image._start = image_start
    assert not found.fits and np.isfinite([found.x, found.y, found.drop, *found.sigma]).all()


@pytest.mark.parametrize("electrodes", [(5,), (0, 1), (3, 11)])
def test_a_change_of_one_or_two_electrodes_is_no_touch(bundle, evidence, electrodes):
    rng = np.random.default_rng(1)
    concerned = np.isin(bundle.pattern[:, :2], electrodes).any(axis=1)
    for seed in range(5):
        change = np.where(concerned, rng.uniform(0.01, 0.3) * rng.choice([-1, 1]), 0.0)
        for fresh in (8, 12, 24, 36):
            d, noise, age = frame(bundle, change, fresh, newest=1 + seed, seed=seed)
            assert evidence.began(d, noise, age) is None


@pytest.mark.parametrize("factor", [0.99, 1.003, 1.3])
def test_a_step_of_gain_is_no_touch(bundle, evidence, factor):
    for fresh in (6, 12, 25):
        d, noise, age = frame(bundle, np.full(120, factor - 1), fresh)
        assert evidence.began(d, noise, age) is None


def test_noise_is_no_touch(bundle, evidence):
    most = 0.0
    for seed in range(300):
        d, noise, age = frame(bundle, np.zeros(120), 1, newest=1 + seed % 10, seed=seed)
        most = max(most, evidence.sigmas(d, noise, age))
        assert evidence.began(d, noise, age) is None
    assert 2.5 < most < 5.5, "of three hundred parts, as normal noise has it"


def test_an_end_is_seen_where_the_touch_would_be_plain_and_only_there(bundle, evidence, image):
    strong, faint = touch(bundle, image, 0.1, 0.2), 0.01 * touch(bundle, image, 0.1, 0.2)
    for held, left, ended in ((strong, 0.0, True), (strong, 1.0, False), (strong, 0.3, False), (faint, 0.0, False)):
        d, noise, age = frame(bundle, left * held, 12)
        assert evidence.ended(d, held, noise, age) == ended
    moved = touch(bundle, image, -0.5, -0.5)
    d, noise, age = frame(bundle, moved, 12)
    assert not evidence.ended(d, strong, noise, age), "it is elsewhere now"


def test_the_end_of_a_light_touch_is_seen_as_soon_as_its_absence_would_be_plain(bundle, evidence, image):
    light = touch(bundle, image, 0.05, 0.1, radius=0.1, drop=0.08)
    assert (light / SIGMA)[np.argsort(measured_at(bundle, 3))[-12:]] @ (light / SIGMA)[
        np.argsort(measured_at(bundle, 3))[-12:]
    ] < 12**2, "one part does not tell"
    silent = [evidence.ended(*_ended_since(bundle, light, fresh, 0.0)) for fresh in (12, 60)]
    assert silent == [False, True]
    assert not any(evidence.ended(*_ended_since(bundle, light, fresh, 0.5)) for fresh in (12, 24, 36, 60))


def _ended_since(bundle, held, fresh, left):
    """What `ended` takes, where the `fresh` newest values felt `left` times the touch that was held."""
    d, noise, age = frame(bundle, (left - 1) * held, fresh)
    return d + held, held, noise, age


@pytest.mark.parametrize("x, y", [(0.98, 0.97), (0.0, 1.0), (-0.9, 0.9), (0.3, 0.2)])
def test_a_touch_is_where_its_part_that_lies_on_the_skin_is(image, x, y):
    at, spread = image.place(np.array([x, y, np.log(0.2)]), np.diag([0.1, 0.1, 0.1]) ** 2)
    rng = np.random.default_rng(0)
    points = np.array([x, y]) + rng.uniform(-0.2, 0.2, (20_000, 2))
    on = points[(np.hypot(*(points - [x, y]).T) < 0.2) & (np.abs(points) < 1).all(axis=1)]
    assert at == pytest.approx(on.mean(axis=0), abs=0.02)
    over = np.abs([x, y]) > 0.8
    assert np.sqrt(np.diag(spread))[~over] == pytest.approx(0.1, abs=0.03)
    assert (np.sqrt(np.diag(spread))[over] < 0.08).all(), "what leaves the skin moves it less"


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


@pytest.mark.slow
@pytest.mark.parametrize("x, y", [(0.037, -0.044), (-0.0137, 0.0436)])
def test_a_touch_on_an_electrode_is_not_taken_for_its_contact_after_parts_had_told_them_apart(x, y):
    """The two whole scans after its beginning were of a contact that jumped, by what they show alone."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=4)
    host.until(6.0)
    began, first = host.now, len(host.contacts)
    host.press(x=x, y=y, force=2.0, radius=0.006, seconds=60.0)
    host.until(began + 0.4)
    host.rig.close()
    frames = [f for _, f in host.contacts[first:]]
    assert all(f.valid for f in frames)
    assert [t for t, f in host.contacts[first:] if f.contacts][0] - began < 0.025


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


@pytest.mark.slow
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
