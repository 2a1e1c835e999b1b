"""Touches beside a changed contact."""

from __future__ import annotations

import numpy as np
import pytest

from models.shapes import Shape
from services.pipeline import Result
from tests.services.stub_skin import StubSkin, transfer


@pytest.mark.parametrize("waited", range(20, 24))
def test_two_touches_that_begin_beside_a_changed_contact_are_two(waited: int) -> None:
    """Their first frames, in which they rise within the scan, say nothing of the contact."""
    stub, changed = StubSkin(80.0), ((9, 1.38),)
    touches = (Shape("circle", -0.72, 0.72, 0.2, 0.333), Shape("circle", -0.08, -0.78, 0.2, 0.236))
    assert stub.rest(3).contact.valid
    for _ in range(waited):
        named = stub.feel((), changed)
    assert named.contact.valid and named.delta.electrodes[9] and not named.delta.touched
    rising, felt = transfer((), changed), []
    for k in (1, 2, 3):  # thirds of the whole: each scan ends with more
        grown = transfer(tuple(Shape(t.kind, t.x, t.y, t.radius, t.drop * k / 3) for t in touches), changed)
        felt.append(stub.see(rising, grown))
        rising = grown
    felt += [stub.see(rising) for _ in range(8)]
    assert all(len(found.contact.contacts) <= 2 for found in felt)
    for found in felt[3:]:
        assert found.contact.valid and np.flatnonzero(found.delta.electrodes).tolist() == [9]
        assert np.array(sorted(places(found))) == pytest.approx(np.array([(-36.0, 36.0), (-4.0, -39.0)]), abs=1.0)


def places(result: Result) -> list[tuple[float, float]]:
    """Of the touches that press, mm."""
    return [
        (1e3 * contact.position[0], 1e3 * contact.position[1])
        for contact in result.contact.contacts
        if contact.state != "end"
    ]


def test_scans_out_of_order_say_nothing_of_a_changed_contact() -> None:
    """They are alike, one after the other, and no contact and no touch explains them: what was known stays known."""
    stub, changed = StubSkin(80.0), ((1, 6.9),)
    for _ in range(20):
        stub.feel((), changed)
    touch = (Shape("circle", 0.06, -0.22, 0.2, 0.285),)
    before = [stub.feel(touch, changed) for _ in range(4)]
    stub.faults.inject("fifo_misaligned", {"silent": True}, 0.0, 1.0)
    assert not any(stub.feel(touch, changed).contact.valid for _ in range(16))
    stub.faults.clear()
    after = [stub.feel(touch, changed) for _ in range(20)]
    free = [stub.feel((), changed) for _ in range(8)]
    for found in (*before[1:], *after[1:]):
        assert found.contact.valid and np.flatnonzero(found.delta.electrodes).tolist() == [1]
        assert places(found) == [pytest.approx((3.0, -11.0), abs=1.0)]
    assert all(found.contact.valid and not places(found) for found in free[1:])
    assert np.flatnonzero(free[-1].delta.electrodes).tolist() == [1]
