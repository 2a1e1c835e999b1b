"""`skin calibrate force` from files: presses solved on a mesh that nothing was trained on."""

import json
from functools import cache

import numpy as np
import pytest

from models.forward import shared
from models.shapes import Shape
from services.calibration.live import LivePresses

PLACES = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)]
LAW = 14.0  # N per S/m: this foam is stiffer than its kind's 10


@cache
def solved():
    model = shared("square16", "stub")
    z0 = np.abs(model.solve(1.0).impedances())
    touches = [Shape("circle", *at, 0.3, drop) for at, drop in zip(PLACES * 2, np.linspace(0.1, 0.5, 12), strict=True)]
    z = [np.abs(model.solve(model.touched([t])).impedances()) for t in touches]
    noise = 1 + 1e-4 * np.random.default_rng(0).standard_normal((64, len(z0)))
    return {"measurements": np.array(z), "untouched": z0 * noise}, [LAW * t.drop for t in touches]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    arrays, forces = solved()
    np.savez(tmp_path / "presses.npz", **arrays)
    rows = "".join(f"{force:.3f},{k}\n" for k, force in enumerate(forces))
    (tmp_path / "presses.csv").write_text(f"force_n,row\n{rows}")
    (tmp_path / "skin.toml").write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def calibrated(skin, *more):
    files = "--csv", "presses.csv", "--measurements", "presses.npz"
    return skin("calibrate", "force", *files, "--out", "palm.json", *more)


def test_presses_become_a_law_that_the_skin_uses(skin, workplace, monkeypatch):
    ran = calibrated(skin, "--save", "kept.csv", "--json")
    assert ran.code == 0, ran.err
    report = json.loads(ran.out)
    assert report["presses"] == 12 and report["error"]["left_out_rms"] < 0.12
    assert report["most_n"] == pytest.approx(LAW * 0.5)
    monkeypatch.setattr(LivePresses.__init__, "__defaults__", (None, 0.2))  # s of patience
    ran = skin("calibrate", "--live", "--csv", "kept.csv", "--out", "b.json")  # nothing runs, nobody presses any more
    assert ran.code == 0 and "no image came" in ran.err and "the law is that of the 12 presses until then" in ran.err
    config = workplace / "skin.toml"
    config.write_text(config.read_text() + 'calibration = "palm.json"\n')
    doctor = skin("doctor", "--config", config)
    assert "palm.json:" in doctor.out and "to 7 N" in doctor.out
    ran = skin("reconstruct", "presses.npz", "out.npz", "--skin", "palm", "--age", "0")
    assert ran.code == 0, ran.err
    with np.load(workplace / "out.npz") as out:
        assert out["force"][:, 0] == pytest.approx(solved()[1], rel=0.04)
        assert (out["force_sigma"][:, 0] > 0).all()


@pytest.mark.parametrize("row", ["2,99", "2,1"])
def test_what_is_wrong_with_the_presses_is_one_line(skin, workplace, row):
    (workplace / "presses.csv").write_text(f"force_n,row\n1,0\n{row}\n")
    ran = calibrated(skin)
    says = "line 3, column row: found 99" if row == "2,99" else "2 presses: at least 5"
    assert ran.code == 2 and says in ran.err and not (workplace / "palm.json").exists()
