"""The first parts after a touch began: it is seen and placed with an honest uncertainty; faults and noise are not."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.sentinel_host import AdaptiveHost
from models.bundle import Bundle
from services.estimation.part_evidence import PartEvidence
from services.estimation.part_image import PartImage
from services.estimation.rolling import measured_at, parts_of

SIGMA = 1e-4
AGE_US = 43_600.0


@pytest.fixture(scope="module")
def bundle():
    return Bundle.load("square16")


@pytest.fixture(scope="module")
def evidence(bundle):
    return PartEvidence(bundle, parts_of(bundle))


@pytest.fixture(scope="module")
def image(bundle):
    return PartImage(bundle)


def frame(bundle, change, fresh, newest=3, seed=0, ramp=False):
    """d, noise and age where `change` (K,) is felt by the `fresh` newest values."""
    rng = np.random.default_rng(seed)
    at = measured_at(bundle, newest)
    rank = np.argsort(np.argsort(-at))  # 0: the newest
    course = np.clip((fresh - rank) / fresh, 0, 1) if ramp else rank < fresh
    return change * course + SIGMA * rng.standard_normal(120), np.full(120, SIGMA), (1 - at) * AGE_US


def touch(bundle, image, x, y, radius=0.2, drop=0.2):
    return drop * (image._share(x, y, radius) @ bundle.matrices.jacobian.T)[0]


@pytest.mark.parametrize("ramp", [False, True])
def test_a_touch_is_seen_from_two_parts_and_lies_where_its_uncertainty_says(bundle, evidence, image, ramp):
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
        on = onset.course > 0
        share = np.where(on, onset.course, 1.0)
        found = image.fit(np.where(on, d / share, 0.0), np.where(on, noise / share, np.inf))
        if found.fits:
            off.append(np.hypot(found.x - x, found.y - y) / found.sigma[0])
            stated.append(found.sigma[0] / 2)
    assert len(off) >= (4 if ramp else 11)
    assert max(off) < 3 and np.median(off) < 1
    assert np.median(stated) < 0.05


def test_what_touched_only_some_of_the_newest_values_is_not_taken_for_all(bundle, evidence, image):
    """A part half touched, read as a whole one, would be wrong by a third of the side."""
    change = touch(bundle, image, 0.3, -0.4)
    for fresh in (17, 20, 29):
        d, noise, age = frame(bundle, change, fresh)
        onset = evidence.began(d, noise, age)
        assert onset is not None
        rank = np.argsort(np.argsort(age))
        felt = rank[onset.course > 0].max() + 1
        plain = np.abs(change[np.argsort(age)]) > 6 * SIGMA  # values that tell whether they felt it
        assert not plain[min(fresh, felt) : max(fresh, felt)].any()


def test_a_circle_that_leaves_the_skin_while_it_is_fitted_is_no_error(bundle, image):
    """What is left of a difference beside its first touch may be like no touch at all."""
    theta = np.array([1.0, 1.0, np.log(0.04), np.log(0.005)])
    assert np.abs(image._linear(theta, image._jacobian, np.zeros(120), np.ones(120))[2][:, :2]).max() < 1e-6
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


@pytest.fixture(scope="module")
def host():
    host = AdaptiveHost("rolling", snr_db=80.0, seed=7)
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


def test_while_nothing_touches_a_part_makes_no_frame(host):
    first = len(host.contacts)
    host.until(host.now + 2.0)
    frames = [f for _, f in host.contacts[first:]]
    assert len(frames) / 2.0 == pytest.approx(22.9, rel=0.05)
    assert all(f.valid and not f.contacts for f in frames)


def test_a_tare_makes_no_contact_and_is_followed_by_touches_again(host):
    """The differences that parts are compared with were to the baseline before."""
    host.until(host.now + 3.5)
    first = len(host.contacts)
    host.pipeline.pre.command("tare", {"calibrate": False})
    assert host.pipeline.pre.rolling_scans.state()["rest"] is None
    host.until(host.now + 0.5)
    assert not any(f.contacts for _, f in host.contacts[first:])
    began, first = host.now, len(host.contacts)
    host.press(x=0.01, y=0.0, force=2.0, radius=0.01, seconds=0.2)
    host.until(began + 0.1)
    assert [t for t, f in host.contacts[first:] if f.valid and f.contacts][0] - began < 0.025
    host.until(began + 0.6)


@pytest.mark.parametrize("fault", [{"name": "electrode_open", "args": {"electrode": 4}}, {"name": "gain", "args": {}}])
def test_a_fault_of_the_board_makes_no_contact(fault):
    host = AdaptiveHost("rolling", snr_db=80.0, seed=11)
    host.until(5.0)
    first = len(host.contacts)
    host.rig.fault(fault["name"], fault["args"], host.now, seconds=1.0)
    host.until(host.now + 2.0)
    assert not any(f.valid and f.contacts for _, f in host.contacts[first:])
    host.rig.close()
