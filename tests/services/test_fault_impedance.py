"""Changed contact impedances and gains in closed form, on scans of the stub's board and mesh."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from models.bundle import Bundle
from models.measurement.covariance.whitening import Whitening
from models.measurement.responses.tables import SkinTables, tables_of
from models.shapes import Shape
from protocol.scan_setting import COHERENT
from services.estimation.faults.impedance import ContactChange, ContactColumns, Unexplained, gain_change
from tests.services.stub_skin import transfer

Array = NDArray[np.float64]

PATTERN = np.asarray(Bundle.load("square16").pattern)
NOISE = 1e-4
SPAN_S = 0.0436
TIMES_S = ((np.arange(len(PATTERN)) + 0.5) / len(PATTERN) - 0.5) * SPAN_S
ALWAYS = -np.inf


def scan(begin: NDArray[np.float64], end: NDArray[np.float64] | None = None, seed: int = 3) -> Array:
    """log |Z| (K,) of a sheet that goes from one transfer matrix to another while it is measured."""
    analog = Analog(BoardNoise(NOISE), Faults(), np.random.default_rng(seed))
    z, _ = analog.measure((begin, begin if end is None else end), PATTERN, COHERENT, 40_000.0, 0.0)
    return np.asarray(np.log(np.abs(z).astype(float)))


@cache
def untouched() -> Array:
    return np.asarray(np.mean([scan(transfer(), seed=seed) for seed in range(64)], axis=0))


@cache
def tables() -> SkinTables:
    return tables_of(Bundle.load("square16")).relative_to(np.exp(untouched()))


def asked(log_z: Array) -> Unexplained:
    covariance = NOISE**2 * (1.1 * np.eye(len(PATTERN)))
    live = np.ones(len(PATTERN), bool)
    return Unexplained(log_z - untouched(), np.ones(len(PATTERN)), live, TIMES_S, SPAN_S, Whitening.of(covariance))


def likeliest(log_z: Array, begins_s: float = ALWAYS) -> tuple[ContactChange, float]:
    """And by how much it is likelier than the next."""
    found = ContactColumns.of(tables()).changes(asked(log_z), np.arange(16), np.full(16, begins_s))
    found.sort(key=lambda change: -change.score)
    return found[0], found[0].score - found[1].score


@pytest.mark.parametrize("electrode", [0, 9])
@pytest.mark.parametrize("times", [0.4, 0.97, 1.03, 1.5, 8.0, 20.0])
def test_a_changed_contact_is_told_by_one_scan(electrode: int, times: float) -> None:
    change, margin = likeliest(scan(transfer((), ((electrode, times),))))
    assert change.electrode == electrode and margin > 30
    assert change.size == pytest.approx(times - 1, rel=0.05, abs=2e-3) and change.chi2 < 1.6


def test_a_contact_that_rises_within_the_scan() -> None:
    change, margin = likeliest(scan(transfer(), transfer((), ((9, 3.0),))))
    assert change.electrode == 9 and margin > 30
    assert change.size == pytest.approx(1.0, rel=0.15)  # at its middle


def test_a_contact_that_jumps_in_the_midst_of_a_scan() -> None:
    log_z = np.where(TIMES_S < 0.01, scan(transfer()), scan(transfer((), ((9, 3.0),))))
    late, margin = likeliest(log_z, 0.01)
    assert late.electrode == 9 and margin > 30 and late.chi2 < 1.6
    assert late.size == pytest.approx(2.0, rel=0.1)
    assert late.score > likeliest(log_z)[0].score + 30
    found = max(ContactColumns.of(tables()).likeliest(asked(log_z)), key=lambda change: change.score)
    assert found.electrode == 9 and found.since_s == pytest.approx(0.01, abs=2e-3)


def test_nothing_is_no_change() -> None:
    log_z = scan(transfer())
    nothing = asked(log_z)
    well = nothing.white.log_density - 0.5 * float(nothing.white(nothing.y) @ nothing.white(nothing.y))
    change, _ = likeliest(log_z)
    assert abs(change.size) < 4 * change.variance**0.5 and change.score < well
    assert gain_change(nothing, ALWAYS).score < well


@pytest.mark.parametrize("place", [(0.3, -0.2), (0.9, 0.1)])
def test_a_touch_is_no_changed_contact(place: tuple[float, float]) -> None:
    change, _ = likeliest(scan(transfer((Shape("circle", *place, 0.15, 0.2),))))
    assert change.chi2 > 10


@pytest.mark.parametrize("factor", [0.85, 0.999, 1.006, 1.2])
def test_a_gain_is_told_by_one_scan(factor: float) -> None:
    asked_of = asked(scan(transfer()) + np.log(factor))
    found = gain_change(asked_of, ALWAYS)
    assert found.log_factor == pytest.approx(np.log(factor), abs=1e-4) and found.chi2 < 1.6
    assert found.score > likeliest(scan(transfer()) + np.log(factor))[0].score


def test_columns_of_a_skin_whose_contact_has_changed_for_good() -> None:
    columns = ContactColumns.of(tables())
    first, second = (np.exp(scan(transfer((), ((9, times),)))) for times in (3.0, 6.0))
    after = columns.with_change(9, 2.0)
    np.testing.assert_allclose((second - first) / np.exp(untouched()), after.mean(9, 3.0), atol=2e-3)
