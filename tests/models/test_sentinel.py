"""The sentinel list: what it detects, held against another mesh, brute force and plain sampling."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from models import sentinel
from models.bundle import Bundle
from models.forward import shared
from models.shapes import Shape


@pytest.fixture(scope="module")
def found(bundle):
    return sentinel.design(bundle.matrices)


def test_exchange_comes_near_the_best_of_all_lists(found) -> None:
    """All 7140 pairs of pairs, and the triples of a dozen good ones."""
    power = (0.1 / 10**-3.5 * found.touches.response[found.touches.radius == sentinel.RADIUS]).astype(float) ** 2
    best = max((power[:, [k]] + power[:, k + 1 :]).min(axis=0).max() for k in range(119))
    assert power[:, sentinel.exchange(power, 2)].sum(axis=1).min() > 0.9 * best
    few = power[:, sentinel.exchange(power, 12)]
    best = max(few[:, list(c)].sum(axis=1).min() for c in combinations(range(12), 3))
    assert power[:, sentinel.exchange(power, 3)].sum(axis=1).min() > best


def test_exceedance_is_that_of_plain_sampling() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal((50, 5))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    largest = (rng.standard_normal((200_000, 5)) @ u.T).max(axis=1)
    for c in (2.0, 2.5, 3.0, 3.5):
        assert sentinel.exceedance(u, c, 2000) == pytest.approx((largest > c).mean(), rel=0.15)
    one = u[:1]  # a single direction: the normal tail itself
    assert sentinel.exceedance(one, 6.0) == pytest.approx(9.866e-10, rel=1e-3)


def test_the_threshold_is_exceeded_as_often_as_said(found) -> None:
    directions = found.filters(np.ones(len(found.rows)))
    c = sentinel.threshold(directions, 1e-3)
    rng = np.random.default_rng(5)
    largest = np.concatenate([(rng.standard_normal((5000, len(found.rows))) @ directions.T).max(1) for _ in range(20)])
    assert (largest > c).mean() == pytest.approx(1e-3, rel=0.35)


def test_the_list_is_short_and_continues_the_smallest(found, bundle) -> None:
    assert len(found.rows) == sentinel.LENGTH <= len(bundle.pattern) / 10
    assert 2 <= len(found.smallest) <= 6 and set(found.smallest) <= set(found.rows)
    assert (np.diff(found.rows) > 0).all()
    assert len(set(bundle.pattern[found.rows].ravel().tolist())) == 16, "an electrode that no sentinel uses"


@pytest.mark.parametrize("smallest", [True, False])
def test_a_newton_is_seen_wherever_it_presses(found, bundle, smallest: bool) -> None:
    """On a mesh that neither bundle nor design has seen, with margins for 99.9 % and one false alarm a minute."""
    model, rng = shared("square16", "inverse"), np.random.default_rng(6)
    rows = found.smallest if smallest else found.rows
    z0 = np.abs(model.solve().impedances())[rows]
    sigma = 10**-3.5 * np.sqrt(1 + 1 / 64)
    directions = found.touches.response[found.touches.radius == sentinel.RADIUS][:, rows]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    c = sentinel.threshold(directions, sentinel.FALSE_ALARMS_HZ * len(rows) * sentinel.MEASUREMENT_S)
    for x, y in [(0, -0.1), (-0.6, 0), (0.8, 0.8), (-0.8, 0.8), *rng.uniform(-0.8, 0.8, (12, 2))]:
        z = np.abs(model.solve(model.touched([Shape("circle", x, y, 0.2, 0.1)])).impedances())[rows]
        assert (directions @ ((z / z0 - 1) / sigma)).max() > c + 3.09 - 0.15, (x, y)  # 0.15: off the grid


def test_a_bundle_whose_touches_may_go_either_way_is_judged_two_sided() -> None:
    found = sentinel.design(Bundle.load("disc16").matrices)
    assert not found.signed
    d = -0.1 * found.touches.response[100, found.rows]
    assert (found.filters(np.full(len(d), 1e-3)) @ d).max() == pytest.approx(np.linalg.norm(d / 1e-3), rel=1e-6)
