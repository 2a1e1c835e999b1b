"""A touch followed from part to part: held, sliding, pressed harder; what is not explained is not followed."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.persistence import arrays, plain
from tests.services.rolling_host import rolling_host

ROLLING = Skin(port="stub", bundle="square16", scan="rolling")


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
