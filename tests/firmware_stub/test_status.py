"""The stub's own status frames."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_stub.faults import FAULTS
from firmware_stub.rig import Rig
from firmware_stub.status import EVERY_S, Status
from protocol.frames import StatusFrame, pack, unpack


def test_who_reads_it_can_tell_when_the_stub_has_fallen_silent() -> None:
    rig: Any = SimpleNamespace(
        faults=SimpleNamespace(listing=lambda now: {"unplug": {}}),  # news, so that a frame is due
        line=SimpleNamespace(dropped=0),
        field=SimpleNamespace(solves=3, late=0),
        board=SimpleNamespace(received={}),
    )
    port: Any = SimpleNamespace(overrun=0)
    before = time.monotonic_ns()
    frame = Status("palm").due(rig, port, 0.0)
    assert frame is not None
    got = unpack(pack(frame))
    assert isinstance(got, StatusFrame) and got.valid_for_s == 3 * EVERY_S
    assert before <= got.stamps["publish"] <= time.monotonic_ns()


def said(rig: Rig) -> list[str]:
    frame = Status("palm").due(rig, SimpleNamespace(overrun=0), 0.0)
    assert frame is not None and frame.level == "WARN"
    return list(frame.messages)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig("square16", seed=1)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_said_in_words_and_not_as_a_program_prints_it(name: str, rig: Rig) -> None:
    rig.faults.clear()
    rig.fault(name, {}, 0.0)
    (message,) = said(rig)
    assert message.startswith("on request, ") and len(message) > 20
    assert not set('{}[]`_"') & set(message), message


@pytest.mark.parametrize(
    ("name", "args", "words"),
    [
        ("unplug", {}, "on request, the cable is out"),
        ("electrode_open", {"electrode": 5}, "on request, the wire of electrode 5 is broken"),
        (
            "electrode_open",
            {"electrode": 5, "second": 0},
            "on request, the wire of electrode 5 is broken, and that of electrode 0",
        ),
        (
            "electrodes_swapped",
            {"electrodes": [2, 3]},
            "on request, the wires of electrodes 2 and 3 are exchanged",
        ),
        ("gain", {"factor": 1.02}, "on request, an amplifier's gain has jumped: impedances times 1.02"),
    ],
)
def test_a_fault_is_said_with_its_numbers(name: str, args: dict[str, Any], words: str, rig: Rig) -> None:
    rig.faults.clear()
    rig.fault(name, args, 0.0)
    assert said(rig) == [words]
