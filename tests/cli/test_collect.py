"""`skin collect` where it cannot begin; what it measures: tests/services/test_collecting.py, tests/docs."""

import pytest

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
