"""Maps of faulty wires against the stub's board, which routes, joins and solves its own mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import MUXES, Faults
from models.bundle import Bundle
from models.patterns import adjacent, pairs
from models.shapes import Shape
from protocol.scan_setting import COHERENT
from services.estimation.faults import wires
from services.estimation.faults.wires import WireFault, WireKind, WireMaps
from tests.services.stub_skin import transfer

Array = NDArray[np.float64]

PATTERN = np.asarray(Bundle.load("square16").pattern)
TOUCH = (Shape("circle", 0.3, -0.2, 0.25, 0.3),)
CLOSE = 2e-3  # the registers' rounding, where a fault leaves a twentieth of an impedance


def measured(
    faults: dict[str, dict[str, Any]], touch: tuple[Shape, ...] = (), pattern: NDArray[np.int64] = PATTERN
) -> tuple[Array, NDArray[np.uint8]]:
    """|Z| (K,) and status of the stub's board with these faults."""
    board = Faults()
    for name, args in faults.items():
        board.inject(name, args, 0.0, 1.0)
    analog = Analog(BoardNoise(1e-7), board, np.random.default_rng(3))
    z, status = analog.measure((transfer(touch),) * 2, pattern, COHERENT, 40_000.0, 0.0)
    return np.abs(z).astype(float), status


def same(found: Array, expected: Array, blind: NDArray[np.bool_]) -> bool:
    return bool(np.allclose(found[~blind], expected[~blind], rtol=CLOSE, atol=0))


EXCHANGED = [(1, 2), (4, 13), (0, 15)]
SHORT = [(3, 11), (0, 15), (7, 8)]
STUCK = [(mux, bit, value) for mux in MUXES for bit in range(4) for value in (0, 1)]


@pytest.mark.parametrize("touch", [(), TOUCH])
@pytest.mark.parametrize("couple", EXCHANGED)
def test_exchanged_wires(couple: tuple[int, int], touch: tuple[Shape, ...]) -> None:
    seen, _ = measured({"electrodes_swapped": {"electrodes": list(couple)}}, touch)
    found = WireMaps(PATTERN).one(WireFault(WireKind.EXCHANGED, couple), measured({}, touch)[0])
    assert same(seen, found.values, found.blind) and not found.blind.any()


@pytest.mark.parametrize("touch", [(), TOUCH])
@pytest.mark.parametrize("couple", SHORT)
def test_shorts(couple: tuple[int, int], touch: tuple[Shape, ...]) -> None:
    seen, _ = measured({"electrodes_shorted": {"electrodes": list(couple)}}, touch)
    found = WireMaps(PATTERN).one(WireFault(WireKind.SHORT, couple), measured({}, touch)[0])
    assert same(seen, found.values, found.blind) and found.blind.sum() == 1


@pytest.mark.parametrize("touch", [(), TOUCH])
@pytest.mark.parametrize(("mux", "bit", "value"), STUCK)
def test_stuck_bits(mux: str, bit: int, value: int, touch: tuple[Shape, ...]) -> None:
    seen, _ = measured({"mux_stuck": {"mux": mux, "bit": bit, "value": value}}, touch)
    maps = WireMaps(PATTERN)
    (fault,) = [f for f in maps.faults if (f.side, f.bit, f.value) == (mux[-1], bit, value)]
    found = maps.one(fault, measured({}, touch)[0])
    assert same(seen, found.values, found.blind) and found.blind.sum() < 60


def test_a_stuck_bit_that_leads_to_where_nothing_is_connected() -> None:
    """Of 12 electrodes, addresses 12 to 15 are empty."""
    pattern = pairs(12)
    reachable = transfer()[:12, :12]
    board = Faults()
    board.inject("mux_stuck", {"mux": "drive-", "bit": 2, "value": 1}, 0.0, 1.0)
    analog = Analog(BoardNoise(1e-7), board, np.random.default_rng(3))
    _, status = analog.measure((reachable,) * 2, pattern, COHERENT, 40_000.0, 0.0)
    well = Analog(BoardNoise(1e-7), Faults(), np.random.default_rng(3))
    z0 = np.abs(well.measure((reachable,) * 2, pattern, COHERENT, 40_000.0, 0.0)[0]).astype(float)
    maps = WireMaps(pattern)
    (fault,) = [f for f in maps.faults if (f.side, f.bit, f.value) == ("-", 2, 1)]
    assert (maps.one(fault, z0).blind >= (status != 0)).all() and (status != 0).any()


def test_every_fault_at_once_is_each_by_itself() -> None:
    z0, maps = measured({})[0], WireMaps(PATTERN)
    every = maps.every(z0)
    assert len(every) == len(maps.faults) == 120 + 120 + 16
    for fault, values in zip(maps.faults, every, strict=True):
        np.testing.assert_allclose(maps.one(fault, z0).values, values)


def test_the_order_and_the_direction_of_pairs_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    pattern = PATTERN[rng.permutation(len(PATTERN))]
    turned = rng.random(len(pattern)) < 0.5
    pattern[turned] = pattern[turned][:, [1, 0, 3, 2]]
    z0 = measured({}, pattern=pattern)[0]
    for name, args, kind in (
        ("electrodes_swapped", {"electrodes": [4, 13]}, WireKind.EXCHANGED),
        ("electrodes_shorted", {"electrodes": [4, 13]}, WireKind.SHORT),
    ):
        seen, _ = measured({name: args}, pattern=pattern)
        found = WireMaps(pattern).one(WireFault(kind, (4, 13)), z0)
        assert same(seen, found.values, found.blind)
    seen, _ = measured({"mux_stuck": {"mux": "drive-", "bit": 2, "value": 1}}, pattern=pattern)
    maps = WireMaps(pattern)
    (fault,) = [f for f in maps.faults if (f.side, f.bit, f.value) == ("-", 2, 1)]
    found = maps.one(fault, z0)
    assert same(seen, found.values, found.blind)


def test_slopes_are_those_of_the_values() -> None:
    z0, maps, rng = measured({})[0], WireMaps(PATTERN), np.random.default_rng(1)
    step = 1e-5 * rng.normal(size=len(z0))
    for fault in (WireFault(WireKind.EXCHANGED, (2, 9)), WireFault(WireKind.SHORT, (2, 9)), maps.faults[-3]):
        low, at, high = (maps.one(fault, z0 * np.exp(by)) for by in (-step, 0 * step, step))
        live = ~at.blind
        moved = np.log(high.values[live] / low.values[live]) / 2
        np.testing.assert_allclose((at.slopes @ step)[live], moved, atol=1e-9)
        assert not at.slopes[at.blind].any()


def test_patterns_that_do_not_drive_every_pair_tell_nothing() -> None:
    assert not WireMaps(adjacent(16)).knows and not WireMaps(adjacent(16)).faults
    assert not WireMaps(pairs(16)[:-1]).knows


@pytest.mark.parametrize("broken", [(6,), (6, 12)])
def test_open_electrodes_are_those_whose_measurements_fail(broken: tuple[int, ...]) -> None:
    _, status = measured({"electrode_open": {"electrode": broken[0], "second": (*broken, -1)[1]}})
    failed = status != 0
    failed[PATTERN[:, :2].tolist().index([0, 1])] = True  # another one
    found, left = wires.open_electrodes(failed, wires.members(PATTERN))
    assert found == broken and left.sum() == 1
