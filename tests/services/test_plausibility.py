"""Gross faults of the stub's board are named and give no wrong contact; the hardest touches on the same sheet stay
valid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models.shapes import Shape
from tests.services.stub_skin import StubSkin

PRESS = (Shape("circle", 0.3, -0.2, 0.2, 0.3),)
HARD = [
    (Shape("circle", 0.0, 0.0, 0.45, 0.5),),
    (Shape("circle", 0.3, 0.2, 0.2, 0.85),),
    (Shape("square", -0.7, 0.7, 0.3, 0.5),),
    (Shape("circle", 0.5, 0.5, 0.2, 0.5), Shape("L", -0.5, 0.4, 0.3, 0.4), Shape("triangle", 0.0, -0.6, 0.25, 0.3)),
]


@pytest.fixture(scope="module")
def tared() -> dict[float, StubSkin]:
    return {snr_db: StubSkin(snr_db) for snr_db in (60.0, 80.0)}


QUIET = 50  # frames after which the baseline has seen the skin untouched: whatever was before is over

FAULTS: list[tuple[str, dict[str, Any]]] = [
    *(("mux_stuck", {"mux": mux, "bit": bit, "value": v}) for mux, bit, v in (
        ("drive+", 2, 0), ("drive+", 0, 1), ("drive-", 3, 0), ("sense+", 1, 1), ("sense-", 0, 0)
    )),
    *(("electrodes_swapped", {"electrodes": list(pair)}) for pair in ((0, 1), (2, 9), (7, 8), (4, 15))),
    *(("stale_rtia", {"gain": gain}) for gain in (0.9, 0.95, 1.05, 1.2)),
]  # fmt: skip


NAMED = {
    "mux_stuck": {"multiplexer"},
    "electrodes_swapped": {"electrode_swapped"},
    "stale_rtia": {"out_of_distribution", "gain"},
}


@pytest.mark.parametrize("snr_db", [60.0, 80.0])
@pytest.mark.parametrize("shapes", [(), PRESS], ids=["free", "pressed"])
@pytest.mark.parametrize(("name", "args"), FAULTS, ids=[f"{n}-{'-'.join(map(str, a.values()))}" for n, a in FAULTS])
def test_a_gross_fault_is_named_and_gives_no_wrong_contact(
    tared: dict[float, StubSkin], name: str, args: dict[str, Any], shapes: tuple[Shape, ...], snr_db: float
) -> None:
    skin = tared[snr_db]
    skin.rest(QUIET)
    skin.faults.inject(name, args, 0.0, 1.0)
    try:
        found = [skin.feel(shapes) for _ in range(4)]
    finally:
        skin.faults.clear()
    named = [bool(set(r.contact.reasons) & NAMED[name]) for r in found]
    assert all(named) or (named[0] and name == "stale_rtia")  # a gain that steps is taken over, and said once
    for r in found:
        if r.contact.valid:  # what is pressed is seen in spite of the fault, and nothing else
            assert r.delta.touched == bool(shapes) and len(r.contact.contacts) == len(shapes)
            for contact, shape in zip(r.contact.contacts, shapes, strict=True):
                away = np.hypot(contact.position[0] - 0.05 * shape.x, contact.position[1] - 0.05 * shape.y)
                assert away < 0.003
    after = [skin.feel() for _ in range(5)]
    assert all(r.contact.valid and not r.delta.electrodes.any() for r in after[3:])  # and when it is over, all is well


@pytest.mark.parametrize("gain", [0.95, 1.05])
def test_a_gain_that_comes_and_goes_is_no_touch_and_leaves_the_baseline_as_it_was(gain: float) -> None:
    skin = StubSkin(80.0)
    before = skin.rest(60)
    for _ in range(25):  # ten seconds without a quiet one
        skin.faults.inject("stale_rtia", {"gain": gain}, 0.0, 1.0)
        faulty = [skin.feel() for _ in range(4)]
        skin.faults.clear()
        assert not any(r.contact.contacts or r.delta.touched for r in faulty)
        assert not any(r.contact.contacts for r in [skin.feel() for _ in range(5)] if r.contact.valid)
    after = [skin.feel() for _ in range(60)]
    assert all(r.contact.valid and not r.delta.touched for r in after)
    assert np.abs(after[-1].delta.difference).max() < 2 * np.abs(before.delta.difference).max()


@pytest.mark.parametrize("gain", [0.95, 0.98, 1.02, 1.05])
def test_another_gain_for_good_is_never_a_touch_and_ends_with_a_tare(gain: float) -> None:
    skin = StubSkin(80.0)
    skin.rest(60)
    skin.faults.inject("stale_rtia", {"gain": gain}, 0.0, 1.0)
    found = [skin.feel() for _ in range(700)]
    assert not any(r.contact.valid and r.contact.contacts for r in found)
    skin.pipeline.pre.command("tare", {"force": True})
    assert all(r.contact.valid and not r.delta.touched for r in [skin.feel() for _ in range(50)])


@pytest.mark.parametrize("snr_db", [60.0, 80.0])
@pytest.mark.parametrize("shapes", HARD)
def test_the_hardest_touches_are_no_fault(
    tared: dict[float, StubSkin], shapes: tuple[Shape, ...], snr_db: float
) -> None:
    skin = tared[snr_db]
    skin.rest(QUIET)
    found = [skin.feel(shapes) for _ in range(4)]
    assert all(r.delta.touched and r.delta.valid for r in found)
    skin.feel()


@pytest.mark.parametrize("gain", [2.5, 3.9])
def test_the_end_of_marked_frames_is_no_step_of_the_gain(tared: dict[float, StubSkin], gain: float) -> None:
    """An overrange scales the measurements that it marks; the baseline never followed, so it must not follow back."""
    skin = tared[80.0]
    skin.rest(QUIET)
    steps = skin.pipeline.pre.health().counters.get("gain_steps", 0)
    skin.faults.inject("rtia_overrange", {"gain": gain}, 0.0, 1.0)
    try:
        marked = [skin.feel() for _ in range(6)]
    finally:
        skin.faults.clear()
    assert not any(r.contact.valid for r in marked)
    after = [skin.feel() for _ in range(60)]  # longer than a gross step takes to be believed
    assert all(r.contact.valid and not r.contact.contacts for r in after[5:])
    assert skin.pipeline.pre.health().counters.get("gain_steps", 0) == steps
