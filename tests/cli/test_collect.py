"""`skin collect` where it cannot begin; what it measures: tests/services/test_collecting.py, tests/docs."""

from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from services.calibration.force_fit import CalibrationError
from services.calibration.seen import SeenTouch
from services.cli import collect


def test_what_cannot_be_collected(skin, tmp_path):
    ran = skin("collect", tmp_path / "presses.csv")
    assert ran.code == 2 and "expected a name ending in .npz" in ran.err
    ran = skin("collect", tmp_path / "nowhere" / "presses.npz")
    assert ran.code == 2 and "make it first" in ran.err
    real = tmp_path / "skin.toml"
    real.write_text('[skins.palm]\nport = "/dev/ttyACM9"\nbundle = "square16"\n')
    ran = skin("collect", tmp_path / "presses.npz", "--stub", 3, "--config", real)
    assert ran.code == 2 and "palm has '/dev/ttyACM9': leave it out" in ran.err


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("20 -10 3", (0.02, -0.01, 3.0)),
        ("20, -10", (0.02, -0.01, None)),
        ("20", None),
        ("20 -10 0", None),
        ("20 nan", None),
        ("twenty ten", None),
    ],
)
def test_what_is_typed_is_millimetres_and_newtons(text, numbers):
    assert collect._numbers(text) == pytest.approx(numbers) if numbers else collect._numbers(text) is None


def test_a_registration_is_suggested_of_as_many_presses_as_it_takes(skin, tmp_path):
    assert "skin register a.npz --skin disc16 --presses 10" in collect._next(Path("a.npz"), "disc16", 10)
    said = collect._next(Path("a.npz"), "disc16", 6)
    assert "at least 10" in said and "skin register a.npz" not in said


class Touched:
    """A collector of a skin that is not free before these presses."""

    def __init__(self, *presses: int) -> None:
        self.busy, self.asked = presses, 0

    def untouched(self):
        self.asked += 1
        if self.asked in self.busy:
            raise CalibrationError("no untouched scans within 20 s: something touches")
        return np.ones(120)

    def pressed(self):
        return np.ones(120), SeenTouch(0.0, 0.0, {})


@pytest.mark.parametrize(("busy", "kept"), [((2, 5), 4), ((3, 4, 5), 2)])
def test_presses_that_do_not_count_lose_no_others(monkeypatch, capsys, busy, kept):
    """Three in a row end it, with what there is."""
    told = []
    monkeypatch.setattr(collect, "control", lambda *what, **more: told.append(what[1]))
    found = list(collect._on_the_stub(Touched(*busy), "palm", Bundle.load("square16"), 6, 0.005))
    said = capsys.readouterr().err
    assert len(found) == kept and said.count("something touches; this press does not count") == len(busy)
    assert ("3 presses in a row did not count" in said) == (kept == 2)
    assert told[-1] == "release"
