"""Touches that come, go and change while they are scanned: valid, `changing`, and nothing else is taken for one."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from models.shapes import Shape
from services.pipeline import Result
from tests.services.stub_skin import METRES, TRANSFER, StubSkin, present, transfer

TOUCHES = (
    Shape("circle", 0.8, 0.4, 0.25, 0.22),
    Shape("circle", -0.6, -0.5, 0.2, 0.4),
    Shape("circle", 0.1, 0.25, 0.12, 0.3),
)
RAMP = (0.0, 0.35, 0.79, 1.0)  # share of the force at the ends of the scans that a ramp of 0.1 s is in


def levels(touch: Shape, shares: tuple[float, ...]) -> list[TRANSFER]:
    return [transfer((replace(touch, drop=share * touch.drop),) if share else ()) for share in shares]


@pytest.fixture
def skin() -> StubSkin:
    return StubSkin()


@pytest.mark.parametrize("touch", TOUCHES)
def test_a_touch_that_comes_and_goes_is_where_it_is_or_says_changing(skin: StubSkin, touch: Shape) -> None:
    skin.rest(3)
    up = levels(touch, RAMP)
    begin = [skin.see(*scan) for scan in pairwise(up)]
    held = [skin.see(up[-1]) for _ in range(8)]
    end = [skin.see(*scan) for scan in pairwise(reversed(up))]
    free = [skin.see(up[0]) for _ in range(6)]
    every = [*begin, *held, *end, *free]
    # Two frames in a row may be explained by a change: of an end in three scans the last may be refused.
    assert all(r.contact.valid for r in [*begin, *held, *end[:-1], *free]), [r.contact.reasons for r in every]
    assert not says_changing(held) and not says_changing(free)
    assert says_changing(begin) <= 3 and says_changing(end) <= 2
    whole_n = held[-1].contact.contacts[0].force_n
    middles = [(a + b) / 2 for a, b in pairwise((*RAMP, *[1.0] * 8, *reversed(RAMP[:-1]), *[0.0] * 6))]
    for result, share in zip(every, middles, strict=True):
        rough = "changing" in result.contact.reasons
        for contact in result.contact.contacts:
            off = np.hypot(*(np.array(contact.position[:2]) - METRES * np.array([touch.x, touch.y])))
            assert off < (0.015 if rough else 0.003)
            if not rough and contact.state != "end":  # how strongly it pressed in the middle of the scan
                assert contact.force_n == pytest.approx(share * whole_n, rel=0.15, abs=0.02 * whole_n)
    assert all(len(present(r)) == 1 for r in held) and not present(free[-1])
    # Where it presses in any part of the scan, its contact is there, or the frame says why not, or is not valid.
    assert not any(hides(r) for r in [*begin, *end]), [r.contact.reasons for r in [*begin, *end]]


def hides(result: Result) -> bool:
    """Whether a person would take the frame for one in which nothing touches."""
    return result.contact.valid and not present(result) and "changing" not in result.contact.reasons


@pytest.mark.parametrize("touch", TOUCHES)
@pytest.mark.parametrize("shares", [(1.0, 0.93, 0.5, 0.06), (1.0, 0.3, 0.0)])
def test_no_frame_hides_a_touch_that_goes_while_it_is_scanned(skin, touch, shares) -> None:
    skin.rest(3)
    down = levels(touch, shares)
    for _ in range(6):
        skin.see(down[0])
    going = [skin.see(*scan) for scan in pairwise(down)]
    free = [skin.see(levels(touch, (0.0,))[0]) for _ in range(6)]
    assert [hides(r) for r in going[:-1]] == [False] * (len(going) - 1), [r.contact.reasons for r in going]
    assert not hides(going[-1]) or shares[-2] < 0.2  # what is left of a faint touch may be too little to be seen
    assert says_changing(going) <= 2 and all(r.contact.valid and not present(r) for r in free[2:])


def says_changing(results: list[Result]) -> int:
    return sum("changing" in r.contact.reasons for r in results)
