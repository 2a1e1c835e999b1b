"""Contacts between images: where two measurements of a touch's place agree, and where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from protocol.frames import Contact, FollowedTouch
from services.contacts.following import MOVES, Following
from services.contacts.surface import Placed


class Flat:
    """A sheet that lies in its frame's plane."""

    flat = True

    def __call__(self, x, y):
        up, along_x, along_y = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
        return Placed(np.array([x, y, 0.0]), up, along_x, along_y)


def touch(x, y, velocity=(0.0, 0.0), sigma=(4e-4, 3e-4, 0.2), integral=1e-5):
    return FollowedTouch(number=1, position=[x, y], velocity=list(velocity), sigma=list(sigma), integral=integral)


def contact(x, y, sigma=None):
    return Contact(id=1, state="hold", position=[x, y, 0.0], force_n=2.0, force_sigma_n=0.2, position_sigma=sigma)


def test_a_contact_is_in_the_middle_of_an_image_and_a_followed_touch_that_agree():
    following = Following()
    following.anchor([contact(0.011, 0.0)], [touch(0.010, 0.0)])
    (now,) = following.moved([contact(0.011, 0.0)], [touch(0.010, 0.0)], Flat())
    assert now.position == pytest.approx([0.0105, 0.0, 0.0])
    assert now.position_sigma == pytest.approx([4e-4 / np.sqrt(2), 3e-4 / np.sqrt(2), 0.2])
    (later,) = following.moved([contact(0.011, 0.0)], [touch(0.013, 0.001, (0.1, 0.0), integral=2e-5)], Flat())
    assert later.position == pytest.approx([0.0135, 0.001, 0.0]) and later.velocity == pytest.approx([0.1, 0.0, 0.0])
    assert later.position_sigma == pytest.approx([4e-4, 3e-4, 0.2]), "while it moves the image's place gets old"
    assert (now.force_n, now.force_sigma_n) == pytest.approx((2.0, 0.2))
    assert (later.force_n, later.force_sigma_n) == pytest.approx((4.0, np.hypot(0.4, MOVES * 4.0))), "it moves"


def test_an_image_and_a_followed_touch_that_do_not_agree_say_so():
    """After a force that grew during the scan an image was 4 mm off, with half a millimetre stated."""
    following = Following()
    following.anchor([contact(0.014, 0.0)], [touch(0.010, 0.0)])
    (now,) = following.moved([contact(0.014, 0.0)], [touch(0.010, 0.0)], Flat())
    assert now.position == pytest.approx([0.014, 0.0, 0.0]), "what is no circle is where its image is"
    assert min(now.position_sigma[:2]) >= 0.004


def test_a_place_that_was_measured_by_itself_stays_with_its_own_uncertainty():
    following, own = Following(), [1e-4, 1e-4, 0.0]
    following.anchor([contact(0.011, 0.0, own)], [touch(0.010, 0.0)])
    (now,) = following.moved([contact(0.011, 0.0, own)], [touch(0.010, 0.0)], Flat())
    assert now.position == pytest.approx([0.011, 0.0, 0.0]) and now.position_sigma == own


def test_a_refined_place_is_the_fits_until_the_touch_moves():
    """The image's place was told with the fit's uncertainty: three times as far off as stated."""
    following, own = Following(), [3e-5, 2e-5, 0.0]
    following.anchor([contact(0.0112, 0.0)], [touch(0.0110, 0.0)])
    fitted = replace(contact(0.0100, 0.0, own), refined=True)
    (still,) = following.moved([fitted], [touch(0.0111, 0.0, integral=2e-5)], Flat())
    assert still.position == pytest.approx([0.0100, 0.0, 0.0]) and still.position_sigma == own
    assert still.force_n == pytest.approx(4.0), "pressed harder meanwhile"
    (moved,) = following.moved([fitted], [touch(0.0130, 0.0, (0.1, 0.0))], Flat())
    assert moved.position == pytest.approx([0.0120, 0.0, 0.0])
    assert moved.position_sigma == pytest.approx([np.hypot(3e-5, 4e-4), np.hypot(2e-5, 4e-4), 0.0])
    (image,) = following.moved([contact(0.0112, 0.0)], [touch(0.0110, 0.0)], Flat())
    assert image.position == pytest.approx([0.0111, 0.0, 0.0]), "and the image's again, where there is no fit"


def test_anchors_go_with_a_recording():
    first, second = Following(), Following()
    first.anchor([contact(0.011, 0.0)], [touch(0.010, 0.0)])
    second.load(first.state())
    now = [each.moved([contact(0.011, 0.0)], [touch(0.012, 0.0)], Flat())[0] for each in (first, second)]
    assert now[0].position == now[1].position and now[0].position_sigma == now[1].position_sigma
