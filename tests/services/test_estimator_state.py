"""The new estimator's state: kept at any moment it is gone on from bit by bit, and what is none is refused."""

from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

from firmware_stub.world import Touch
from models.measurement.responses.tables import tables_of
from protocol.records import Tree
from services.estimation.estimator import Estimator
from services.estimation.values.estimate import Estimate
from services.estimation.values.scan import Scan
from tests.services.test_estimator import FREE_S, PARTS, Board, bundle, press

ENDS_S = FREE_S + 3.0
TOUCH = Touch("circle", 0.01, -0.01, 8e-3, 0.3)


def packed(state: dict[str, Any]) -> dict[str, Any]:
    """As a message or a file has it."""
    tree = Tree()
    kept: dict[str, Any] = tree.decode(msgpack.unpackb(msgpack.packb(tree.encode(state)), strict_map_key=False))
    return kept


def scans(parts: int) -> list[Scan]:
    found: list[Scan] = []
    for raw in Board(press(TOUCH, until_s=FREE_S + 1.5, left=0.03), parts, seed=3).frames(ENDS_S):
        found.append(Scan.of(raw, found[-1] if found else None))
    return found


def same(a: Estimate, b: Estimate) -> bool:
    pairs = zip(a.touches, b.touches, strict=True)
    alike = all(
        s.id == t.id and s.x == t.x and s.drop == t.drop and (s.covariance == t.covariance).all() for s, t in pairs
    )
    return alike and a.judgements == b.judgements and np.array_equal(a.difference, b.difference)


# Before the baseline, untouched, as a touch begins, held, just released and when its memory fades.
@pytest.mark.parametrize("at_s", [1.0, FREE_S - 0.2, FREE_S + 0.06, FREE_S + 1.0, FREE_S + 1.62, FREE_S + 2.5])
@pytest.mark.parametrize("parts", [1, pytest.param(PARTS, marks=pytest.mark.release)])
def test_who_loads_a_state_goes_on_bit_by_bit(at_s: float, parts: int) -> None:
    first, second = Estimator(tables_of(bundle())), Estimator(tables_of(bundle()))
    since, touched = 0, False
    for scan in scans(parts):
        if scan.sample_ns * 1e-9 >= at_s and not since:
            second.load(packed(first.state()))
        since += scan.sample_ns * 1e-9 >= at_s
        found = first.step(scan)
        touched = touched or bool(found.touches)
        if since:
            assert same(found, second.step(scan)), f"{since} scans later"
    assert since > 10 and touched


def _lost(state: dict[str, Any]) -> None:
    del state["tared"]["drift"]["x"]


def _of_another_skin(state: dict[str, Any]) -> None:
    state["tared"]["log_z0"] = state["tared"]["log_z0"][:-1]


def _not_finite(state: dict[str, Any]) -> None:
    state["tared"]["drift"]["x"] = np.nan * state["tared"]["drift"]["x"]


def _no_covariance(state: dict[str, Any]) -> None:
    state["tared"]["drift"]["p"] = -state["tared"]["drift"]["p"]


def _text(state: dict[str, Any]) -> None:
    state["tared"]["touches"]["next_id"] = "7"


def _older(state: dict[str, Any]) -> None:
    state["layout"] = 0


@pytest.mark.parametrize("damage", [_lost, _of_another_skin, _not_finite, _no_covariance, _text, _older])
def test_what_is_no_state_is_refused_and_changes_nothing(damage: Callable[[dict[str, Any]], None]) -> None:
    estimator = Estimator(tables_of(bundle()))
    *before, last = scans(1)[:75]
    for scan in before:
        estimator.step(scan)
    kept = estimator.state()
    damaged = packed(kept)
    damage(damaged)
    with pytest.raises(ValueError, match="found|expected"):
        estimator.load(damaged)
    other = Estimator(tables_of(bundle()))
    other.load(packed(kept))
    assert same(estimator.step(last), other.step(last))
