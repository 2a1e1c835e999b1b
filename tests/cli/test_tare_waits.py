"""`skin tare` waits for frames that are still to come, and for nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models.bundle import Bundle
from models.measurement.responses.tables import tables_of
from services.cli import board
from services.cli.common import CliError
from services.estimation.first.tare import LatestScans, TareRefused


@pytest.fixture
def refusals(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What preprocessing says, one after the other; then it takes the baseline."""
    said: list[str] = []

    def control(process: str, command: str, **args: Any) -> dict[str, Any]:
        if said:
            raise CliError(said.pop(0))
        return {"frames": 64, "snr_db": 80.0}

    monkeypatch.setattr(board, "control", control)
    monkeypatch.setattr(board, "skin_name", lambda name: name)
    return said


def tare(wait: float = 10.0) -> None:
    board.tare(force=False, calibrate=True, wait=wait, skin="palm", as_json=False)


def test_it_tries_again_until_the_frames_are_there(refusals: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    refusals += ["only 60 of 64 untouched frames since the last touch: wait and try again"] * 2
    tare()
    assert not refusals and capsys.readouterr().out == "new baseline from 64 frames, 80.0 dB\n"


def test_the_other_refusal_that_time_mends(refusals: list[str]) -> None:
    with pytest.raises(TareRefused) as early:
        LatestScans().agreed(tables_of(Bundle.load("square16")))
    refusals.append(str(early.value))
    tare()
    assert not refusals


def test_it_does_not_wait_for_a_hand_to_go(refusals: list[str]) -> None:
    refusals += ["the skin is touched: free it and try again (or --force, if nothing touches it)", "never asked"]
    with pytest.raises(CliError, match="the skin is touched"):
        tare()
    assert refusals == ["never asked"]


def test_it_does_not_wait_for_ever(refusals: list[str]) -> None:
    refusals += ["only 0 of 64 frames came so far: wait, or look at `skin top`"] * 100
    with pytest.raises(CliError, match="so far: wait"):
        tare(wait=float(np.nextafter(0, 1)))
    assert len(refusals) == 99
