"""Which fault of the wires one scan of the stub's board shows, whatever touches."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.grid import DiscGrid
from models.shapes import Shape
from services.estimation.faults.table import BoardScan, WireGuess, WireTable, any_touches
from services.estimation.faults.wires import WireFault, WireKind, WireMaps
from tests.services.test_fault_impedance import NOISE, PATTERN, SPAN_S, TIMES_S, tables, untouched
from tests.services.test_fault_maps import measured

Array = NDArray[np.float64]
Faults = dict[str, dict[str, Any]]

TOUCHES: list[tuple[Shape, ...]] = [
    (),
    (Shape("circle", 0.3, -0.2, 0.25, 0.5),),
    (Shape("circle", -0.6, 0.6, 0.3, 0.7), Shape("circle", 0.5, 0.0, 0.15, 0.3)),
]
MAPS = WireMaps(PATTERN)
MEASURED_S = np.random.default_rng(7).permutation(TIMES_S)  # a board's own order, not the pattern's


@cache
def any_touch() -> Array:
    return any_touches(DiscGrid(DiscResponse(tables())))


def guessed(z: Array, status: NDArray[np.uint8], standing: WireFault | None = None) -> WireGuess:
    """The first guess; it is likelier than the next by what true faults are."""
    failed = ~np.isfinite(z) | (z <= 0) | (status != 0)
    scan = BoardScan(np.log(np.where(failed, 1.0, z)), untouched(), failed, np.ones(len(z), bool), MEASURED_S, SPAN_S)
    if not WireTable(MAPS).suspicious(scan, standing):
        return WireGuess(None, -np.inf, 0.0, 0.0)
    found = WireTable(MAPS).guesses(scan, standing, any_touch(), 2 * NOISE**2 * np.eye(len(PATTERN)))
    others = [guess.score for guess in found if guess.fault != found[0].fault]
    assert found[0].score > max(others) + 50
    return found[0]


def cases() -> list[tuple[Faults, WireFault]]:
    found: list[tuple[Faults, WireFault]] = []
    for couple in ((1, 2), (4, 13), (0, 15)):
        found.append(({"electrodes_swapped": {"electrodes": list(couple)}}, WireFault(WireKind.EXCHANGED, couple)))
        found.append(({"electrodes_shorted": {"electrodes": list(couple)}}, WireFault(WireKind.SHORT, couple)))
    for fault in MAPS.faults[-16:]:
        args = {"mux": f"drive{fault.side}", "bit": fault.bit, "value": fault.value}
        found.append(({"mux_stuck": args}, fault))
    return found


@pytest.mark.parametrize("touch", range(len(TOUCHES)))
@pytest.mark.parametrize("case", range(len(cases())))
def test_a_fault_is_told_by_one_scan(case: int, touch: int) -> None:
    faults, fault = cases()[case]
    assert guessed(*measured(faults, TOUCHES[touch])).fault == fault


@pytest.mark.parametrize("touch", range(len(TOUCHES)))
@pytest.mark.parametrize("case", range(0, len(cases()), 3))
@pytest.mark.parametrize("ends", [False, True])
def test_a_fault_that_begins_or_ends_within_the_scan(case: int, touch: int, ends: bool) -> None:
    faults, fault = cases()[case]
    well, ill = measured({}, TOUCHES[touch]), measured(faults, TOUCHES[touch])
    before, after = (ill, well) if ends else (well, ill)
    late = 0.05 * SPAN_S <= MEASURED_S
    z, status = (np.where(late, after[k], before[k]) for k in (0, 1))
    found = guessed(z, status, fault if ends else None)
    assert found.fault == (None if ends else fault)
    assert abs(found.since_s - 0.05 * SPAN_S) < 0.06 * SPAN_S


@pytest.mark.parametrize("touch", range(len(TOUCHES)))
def test_sound_wires(touch: int) -> None:
    z, status = measured({}, TOUCHES[touch])
    for factor in (1.0, 0.8):
        assert guessed(factor * z, status).fault is None


def test_the_covariance_of_any_touches_is_one_seen_through_every_fault() -> None:
    """Slopes of a fault reach 40: what rounding leaves below 0 in it must stay far below the noise that is added."""
    for fault in MAPS.faults:
        slopes = MAPS.one(fault, np.exp(untouched())).slopes
        seen = slopes @ any_touch() @ slopes.T
        assert np.linalg.eigvalsh(seen)[0] > -1e-3 * NOISE**2
