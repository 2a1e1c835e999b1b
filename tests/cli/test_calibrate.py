"""`skin calibrate force` from files: presses of a stranger's skin, solved on a mesh that nothing was trained on."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from models.forward import shared
from models.shapes import Shape
from services.calibration.live import LivePresses

PLACES = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)]
LAW = 14.0  # N per S/m: this foam is stiffer than its kind's 10


@pytest.fixture(scope="module")
def solved():  # type: ignore[no-untyped-def]
    model = shared("square16", "stub")
    z0 = np.abs(model.solve(1.0).impedances())
    touches = [
        Shape("circle", *place, 0.3, drop) for place, drop in zip(PLACES * 2, np.linspace(0.1, 0.5, 12), strict=True)
    ]
    z = [np.abs(model.solve(model.touched([t])).impedances()) for t in touches]
    noise = 1 + 1e-4 * np.random.default_rng(0).standard_normal((64, len(z0)))
    return {"measurements": np.array(z), "untouched": z0 * noise}, [LAW * t.drop for t in touches]


@pytest.fixture
def workplace(tmp_path, solved, monkeypatch):  # type: ignore[no-untyped-def]
    arrays, forces = solved
    np.savez(tmp_path / "presses.npz", **arrays)
    rows = [f"{force:.3f},{k}" for k, force in enumerate(forces)]
    (tmp_path / "presses.csv").write_text("\n".join(["force_n,row", *rows]) + "\n")
    (tmp_path / "skin.toml").write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    return tmp_path


def calibrated(skin, workplace, *more):  # type: ignore[no-untyped-def]
    files = "--csv", workplace / "presses.csv", "--measurements", workplace / "presses.npz"
    return skin("calibrate", "force", *files, "--out", workplace / "palm.json", *more)


def test_presses_become_a_law_that_the_skin_uses(skin, workplace, solved) -> None:  # type: ignore[no-untyped-def]
    ran = calibrated(skin, workplace, "--save", workplace / "kept.csv", "--json")
    assert ran.code == 0, ran.err
    report = json.loads(ran.out)
    assert report["presses"] == 12 and report["error"]["left_out_rms"] < 0.06
    assert report["most_n"] == pytest.approx(LAW * 0.5)
    config = workplace / "skin.toml"
    config.write_text(config.read_text() + 'calibration = "palm.json"\n')
    doctor = skin("doctor", "--config", config)
    assert "palm.json:" in doctor.out and "to 7 N" in doctor.out
    ran = skin("reconstruct", workplace / "presses.npz", workplace / "out.npz", "--skin", "palm", "--age", "0")
    assert ran.code == 0, ran.err
    with np.load(workplace / "out.npz") as out:
        assert out["force"][:, 0] == pytest.approx(solved[1], rel=0.02)
        assert (out["force_sigma"][:, 0] > 0).all()


def test_the_presses_that_were_kept_give_the_same_law(skin, workplace) -> None:  # type: ignore[no-untyped-def]
    first = json.loads(calibrated(skin, workplace, "--save", workplace / "kept.csv", "--json").out)
    ran = skin("calibrate", "force", "--csv", workplace / "kept.csv", "--out", workplace / "b.json", "--json")
    assert json.loads(ran.out)["curve"]["scale"] == pytest.approx(first["curve"]["scale"], rel=1e-3)


def test_what_is_wrong_with_the_presses_is_one_line(skin, workplace) -> None:  # type: ignore[no-untyped-def]
    file = workplace / "presses.csv"
    file.write_text("force_n,row\n1,0\n2,99\n")
    ran = calibrated(skin, workplace)
    assert ran.code == 2 and "line 3, column row: found 99" in ran.err and "rows 0 to 11" in ran.err
    file.write_text("force_n,row\n1,0\n2,1\n")
    ran = calibrated(skin, workplace)
    assert ran.code == 2 and "2 presses: at least 5 are needed" in ran.err
    assert skin("calibrate", "force", "--measurements", workplace / "presses.npz").code == 2
    assert not (workplace / "palm.json").exists()


def test_a_radius_that_is_no_number_is_asked_for_again(skin, workplace, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """It must not pass for "not known": the law would then not be told apart by size."""
    monkeypatch.setattr("sys.stdin", io.StringIO("5mm\n-3\n5\n"))
    ran = skin("calibrate", "force", "--out", workplace / "palm.json")
    for text in ("5mm", "-3"):
        assert f"found '{text}', expected millimetres above 0" in ran.err
    assert ran.err.count("radius of the tip in millimetres") == 3 and ran.code == 2


def test_a_law_of_kept_presses_says_of_how_many(skin, workplace, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Nobody presses any more, and nothing runs: the law is that of the file."""
    kept = workplace / "kept.csv"
    assert calibrated(skin, workplace, "--save", kept).code == 0
    monkeypatch.setattr(LivePresses.__init__, "__defaults__", (None, 0.2))  # s of patience
    ran = skin("calibrate", "--live", "--csv", kept, "--out", workplace / "b.json")
    assert ran.code == 0 and "no image came" in ran.err and "the law is that of the 12 presses until then" in ran.err
