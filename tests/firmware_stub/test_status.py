"""The stub's own status frames."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

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
