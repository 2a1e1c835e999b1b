"""The eight symmetries of a square image."""

from __future__ import annotations

import numpy as np
import pytest

from models.turns import TURNS, Turn


@pytest.mark.parametrize("turn", TURNS)
def test_what_is_turned_comes_back(turn: Turn) -> None:
    image = np.random.default_rng(0).normal(size=(3, 5, 5))
    assert (turn.back.image(turn.image(image)) == image).all()
    assert (turn.image(image) == image).all() == (turn == TURNS[0])


@pytest.mark.parametrize("turn", TURNS)
def test_a_place_is_turned_as_its_pixel_is(turn: Turn) -> None:
    image = np.zeros((5, 5))
    image[1, 4] = 1.0
    (iy, ix), place = np.argwhere(turn.image(image))[0], np.array([[4 - 2.0, 1 - 2.0]])
    assert turn.points(place)[0].tolist() == [ix - 2, iy - 2]
