"""A touch followed from part to part: held, sliding, pressed harder; what is not explained is not followed."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from services.estimation.circles import Circles
from services.estimation.part_filter import PartFilter
from services.estimation.part_image import PartImage
from services.estimation.rolling import measured_at
from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.persistence import arrays, plain
from tests.services.rolling_host import rolling_host

ROLLING = Skin(port="stub", bundle="square16", scan="rolling")
SIGMA = 1e-4
PART_US = 4360.0
NOISE = np.full(120, SIGMA)


class Skin:
    """Scans in parts of a touch whose course is known: `at(seconds)` gives (x, y, radius, drop)."""

    def __init__(self, bundle, at, seed=0):
        self.image, self.at, self.rng = PartImage(bundle), at, np.random.default_rng(seed)
        self.bundle = bundle
        self.end_us = 10 * PART_US

    def values(self, part):
        """d, age and when, after `part` parts more."""
        self.end_us += PART_US
        age = (1 - measured_at(self.bundle, part)) * 10 * PART_US
        d = np.empty(120)
        for t in np.unique(age):
            (rows,) = np.nonzero(age == t)
            x, y, radius, drop = self.at(1e-6 * (self.end_us - t))
            d[rows] = drop * self.image.responses(np.array([[x, y, np.log(radius)]]), rows)[0]
        return d + SIGMA * self.rng.standard_normal(120), age, self.end_us


def run(bundle, at, parts=60, seed=0):
    """(seconds, whether explained, state or None) after each part, whole scans between as the service takes them."""
    skin, follower, seen = Skin(bundle, at, seed), PartFilter(bundle), []
    for k in range(parts):
        d, age, now = skin.values(1 + k % 10)
        explained = k > 0 and follower.part(d, NOISE, age, now)
        if k % 10 == 0:
            follower.whole(d + follower.at_once(d, NOISE, age), NOISE, now, shown=follower.moves or not follower.knows)
        (state,) = follower.states() or [None]
        if k:
            seen.append((1e-6 * (now - PART_US / 2), explained, state, follower))
    return seen


def off(seen, at):
    return np.array([np.hypot(s.x - at(t)[0], s.y - at(t)[1]) for t, _, s, _ in seen])


def test_a_held_touch_stays_where_the_whole_scan_shows_it(bundle):
    for seed in range(4):
        seen = run(bundle, lambda t: (0.3, -0.2, 0.2, 0.2), seed=seed)
        assert all(explained for _, explained, _, _ in seen)
        assert all((s.vx, s.vy) == (0, 0) for _, _, s, _ in seen)
        assert len({(s.x, s.y) for _, _, s, _ in seen}) == 1
        assert off(seen, lambda t: (0.3, -0.2)).max() < 0.02


@pytest.mark.slow
def test_a_held_touch_is_known_better_with_every_image_of_more_scans(bundle):
    off, stated = [], []
    for seed in range(6):
        skin, follower = Skin(bundle, lambda t: (0.1, 0.05, 0.1, 0.1), seed), PartFilter(bundle)
        for k in range(81):
            d, age, now = skin.values(1 + k % 10)
            assert k == 0 or follower.part(d, NOISE, age, now)
            if k % 10 == 0:
                follower.whole(d, NOISE, now, shown=k in (0, 10, 40, 80))
                if k in (0, 80):
                    (state,) = follower.states()
                    off.append(np.hypot(state.x - 0.1, state.y - 0.05))
                    stated.append(state.sigma[0])
    one, nine = np.array(off).reshape(-1, 2).T
    assert np.sqrt((nine**2).mean()) < 0.7 * np.sqrt((one**2).mean())
    assert np.mean(stated[1::2]) < 0.6 * np.mean(stated[::2])
    assert (nine < 3 * np.array(stated[1::2])).all()


@pytest.mark.parametrize("speed", [2.0, 6.0])
def test_a_sliding_touch_is_where_it_is_and_as_fast(bundle, speed):
    """Model units a second: 0.1 and 0.3 m/s. It begins to move at once, in the middle of a scan."""

    def at(t):
        return (
            -0.5 + 0.8 * speed * np.clip(t - 0.111, 0, None),
            -0.4 + 0.6 * speed * np.clip(t - 0.111, 0, None),
            0.2,
            0.2,
        )

    seen = run(bundle, at, parts=round((0.111 + 1.0 / speed) * 1e6 / PART_US))
    assert all(explained for _, explained, _, _ in seen)
    moving = [each for each in seen if each[0] > 0.13]
    assert np.median(off(moving, at)) < 0.01 and off(seen, at).max() < 0.05
    error = [np.hypot(s.vx - 0.8 * speed, s.vy - 0.6 * speed) / speed for t, _, s, _ in moving]
    assert np.median(error) < 0.15
    stated = np.array([s.sigma[0] for _, _, s, _ in moving])
    assert (off(moving, at) < 3 * stated).mean() > 0.98


def test_a_force_that_changes_is_followed_where_the_touch_stays(bundle):
    def at(t):
        return 0.1, 0.4, 0.15, 0.2 + 0.1 * np.clip((t - 0.12) / 0.05, 0, 1)

    seen = run(bundle, at)
    assert all(explained for _, explained, _, _ in seen)
    late = [s.integral for t, _, s, _ in seen if t > 0.2]
    before = [s.integral for t, _, s, _ in seen if t < 0.1]
    assert np.median(late) / np.median(before) == pytest.approx(1.5, rel=0.03)
    assert off(seen, at).max() < 0.04


def test_another_touch_is_not_explained_and_nothing_is_said_until_a_whole_scan(bundle):
    follower, skin = PartFilter(bundle), Skin(bundle, lambda t: (0.3, -0.2, 0.2, 0.2))
    other = Skin(bundle, lambda t: (-0.5, 0.5, 0.2, 0.2), seed=1)
    d, age, now = skin.values(1)
    follower.whole(d, NOISE, now, shown=True)
    d, age, now = skin.values(2)
    assert follower.part(d, NOISE, age, now)
    other.values(1), other.values(2)
    d, age, now = skin.values(3)
    assert not follower.part(d + other.values(3)[0], NOISE, age, now)
    assert not follower.states() and not follower.knows
    assert not follower.part(*(skin.values(4)[0], NOISE), age, now + PART_US)
    follower.whole(skin.values(5)[0], NOISE, skin.end_us, shown=True)
    assert follower.knows


def test_a_held_touch_stays_where_it_is_while_another_begins_slowly_elsewhere(bundle):
    """A filter of one touch went 10 mm towards the other one and stated 1 mm."""
    held = Skin(bundle, lambda t: (0.37, -0.17, 0.2, 0.45))
    other = Skin(bundle, lambda t: (0.55, 0.41, 0.2, 2.0 * np.clip(t - 0.1, 1e-9, None)), seed=1)
    follower, explained = PartFilter(bundle), 0
    for k in range(30):
        (d, age, now), more = held.values(1 + k % 10), other.values(1 + k % 10)[0]
        if k == 0:
            follower.whole(d, NOISE, now, shown=True)
        elif follower.part(d + more, 1.5 * NOISE, age, now):
            (state,) = follower.states()
            assert np.hypot(state.x - 0.37, state.y + 0.17) < 0.06, "3 % of the side"
            explained += 1
    assert explained >= 10 and not follower.knows


@pytest.mark.parametrize("count", [2, 3])
def test_several_touches_are_followed_while_one_of_them_slides(bundle, count):
    places = [(-0.5, -0.4), (0.5, 0.5), (-0.3, 0.6)][:count]

    def first(t):
        return places[0][0] + 2.0 * np.clip(t - 0.111, 0, None), places[0][1], 0.2, 0.25

    skins = [Skin(bundle, first)] + [Skin(bundle, lambda t, at=at: (*at, 0.2, 0.25), seed=1) for at in places[1:]]
    follower, errors, others = PartFilter(bundle), [], []
    for k in range(75):
        made = [skin.values(1 + k % 10) for skin in skins]
        d, (_, age, now) = sum(each[0] for each in made), made[0]
        assert k == 0 or follower.part(d, 2 * NOISE, age, now)
        if k % 10 == 0:
            follower.whole(d + follower.at_once(d, 2 * NOISE, age), 2 * NOISE, now, shown=not follower.knows)
        assert len(follower.states()) == count
        t = 1e-6 * (now - PART_US / 2)
        apart = [min(np.hypot(s.x - x, s.y - y) for s in follower.states()) for x, y in (first(t)[:2], *places[1:])]
        errors, others = errors + [apart[0]], others + apart[1:]
    assert np.median(errors) < 0.02 and max(errors) < 0.08
    assert max(others) < 0.06


def test_its_state_goes_with_a_recording(bundle):
    def at(t):
        return -0.3 + 2.0 * np.clip(t - 0.08, 0, None), 0.2, 0.2, 0.2

    skin, first = Skin(bundle, at), PartFilter(bundle)
    for k in range(16):
        d, age, now = skin.values(1 + k % 10)
        first.part(d, NOISE, age, now)
        if k % 10 == 0:
            first.whole(d, NOISE, now, shown=True)
    second = PartFilter(bundle)
    second.load(first.state())
    assert first.moves and second.number == first.number
    for k in range(16, 24):
        d, age, now = skin.values(1 + k % 10)
        assert first.part(d, NOISE, age, now) == second.part(d, NOISE, age, now)
        assert first.states() == second.states()
    np.testing.assert_array_equal(first.at_once(d, NOISE, age), second.at_once(d, NOISE, age))


@pytest.fixture(scope="module")
def host():
    with rolling_host(seed=8) as host:
        yield host


def test_contacts_of_a_held_and_then_sliding_touch_come_at_the_part_rate(host):
    host.press(x=-0.02, y=0.01, force=2.0, radius=0.01, seconds=60.0, finger="one")
    host.until(host.now + 0.2)
    first, began = len(host.contacts), host.now
    host.until(began + 0.3)
    held = [f for _, f in host.contacts[first:]]
    assert len(held) / 0.3 == pytest.approx(229, rel=0.05)
    assert all(f.valid and len(f.contacts) == 1 and not f.reasons for f in held)
    assert all(np.hypot(f.contacts[0].position[0] + 0.02, f.contacts[0].position[1] - 0.01) < 1e-3 for f in held)
    assert all(f.contacts[0].velocity == [0, 0, 0] for f in held[20:])
    samples = [f.stamps["sample"] for f in held]
    assert np.diff(samples).min() > 0, "each stands for its own part"
    assert np.median([t * 1e9 - f.stamps["sample"] for t, f in host.contacts[first:]]) < 8e6
    first, began = len(host.contacts), host.now
    host.press(x=-0.02, y=0.01, force=2.0, radius=0.01, seconds=0.2, to_x=0.02, to_y=0.01, finger="one")
    host.until(began + 0.2)
    errors, speeds, ids = [], [], set()
    for _, f in host.contacts[first:]:
        (contact,) = f.contacts
        assert f.valid and "changing" not in f.reasons
        sampled = f.stamps["sample"] * 1e-9 - began
        ids.add(contact.id)
        if sampled > 0.03:
            errors.append(np.hypot(contact.position[0] + 0.02 - 0.2 * sampled, contact.position[1] - 0.01))
            speeds.append(contact.velocity[0])
    assert len(ids) == 1
    assert np.median(errors) < 1e-3 and max(errors) < 3e-3
    assert np.median(speeds) == pytest.approx(0.2, rel=0.1)
    first, began = len(host.contacts), host.now
    host.until(began + 0.3)
    gone = [t for t, f in host.contacts[first:] if f.valid and all(c.state == "end" for c in f.contacts)]
    assert gone[0] - began < 0.025


def test_a_reader_of_30_hz_misses_neither_begin_nor_end(host):
    host.until(host.now + 0.5)
    first, began = len(host.contacts), host.now
    host.press(x=0.01, y=0.02, force=2.0, radius=0.01, seconds=0.2)
    host.until(began + 0.6)
    seen = host.contacts[first:]
    for phase in np.linspace(0, 1 / 30, 5):
        looks = np.arange(began + phase, began + 0.6, 1 / 30)
        read = [[f for t, f in seen if t <= look][-1:] for look in looks]
        states = [contact.state for frames in read for f in frames for contact in f.contacts]
        assert {"begin", "hold", "end"} <= set(states)
    for state in ("begin", "end"):
        samples = [f.stamps["sample"] for _, f in seen for contact in f.contacts if contact.state == state]
        assert 40e6 < max(samples) - min(samples) < 60e6
        assert len({contact.id for _, f in seen for contact in f.contacts if contact.state == state}) == 1


def until_it_slides(host):
    """A touch is held, and a third on its way."""
    host.until(host.now + 0.5)
    host.press(x=-0.02, y=-0.01, force=2.0, radius=0.01, seconds=60.0, finger="one")
    host.until(host.now + 0.2)
    host.press(x=-0.02, y=-0.01, force=2.0, radius=0.01, seconds=0.3, to_x=0.02, to_y=0.01, finger="one")
    host.until(host.now + 0.1)


def test_a_recording_that_begins_while_a_touch_slides_plays_as_it_was(host):
    until_it_slides(host)
    stages = (host.pipeline.pre, host.pipeline.inference, host.pipeline.publishing)
    states = [plain(stage.state()) for stage in stages]
    first, raw = len(host.contacts), len(host.raws)
    host.until(host.now + 0.3)
    again = Pipeline(ROLLING, "palm")
    for stage, state in zip((again.pre, again.inference, again.publishing), states, strict=True):
        stage.load(arrays(state))
    made = [found for frame in host.raws[raw:] if (found := again.step(frame)) is not None]
    assert len(made) == len(host.contacts) - first > 40
    for one, (_, other) in zip(made, host.contacts[first:], strict=True):
        assert (one.scan, one.valid, one.reasons) == (other.scan, other.valid, other.reasons)
        assert [asdict(c) for c in one.contacts] == [asdict(c) for c in other.contacts]


def test_a_touch_that_goes_while_it_slides_is_not_followed_any_further(host):
    until_it_slides(host)
    ended, first = host.now, len(host.contacts)
    host.release()
    host.until(ended + 0.4)
    after = [(t - ended, f) for t, f in host.contacts[first:]]
    assert all(f.valid for _, f in after)
    for _, f in after:
        for c in f.contacts:
            if c.state != "end":  # it is where it went, for as long as that is asked
                assert np.hypot(c.position[0] + 0.02 - 0.04 * 0.1 / 0.3, c.position[1] + 0.01 - 0.02 * 0.1 / 0.3) < 5e-3
    gone = next(t for t, f in after if all(c.state == "end" for c in f.contacts))
    assert gone < 0.06
    assert all(c.state == "end" for t, f in after if t > gone for c in f.contacts), "it does not come back"


def test_two_touches_in_one_place_lie_on_the_skin_still(bundle):
    """No value tells one from the other: their covariance was singular, which ended preprocessing."""
    circles = Circles(bundle)
    one = np.array([[0.1, 0.2, np.log(0.2), np.log(0.3), 0.0, 0.0]])
    fit = circles.fitted(circles.still(one), NOISE, np.vstack([one, one]))
    assert fit.misfit < 1
    assert (np.diag(fit.covariance).reshape(2, -1)[:, :2] < bundle.half_width**2).all()
