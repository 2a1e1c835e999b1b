"""A registered skin's forward model: what is simulated for it is what was measured on it."""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from tests import needs

needs.TRAIN.here()

from models import build, data, manifest, verdict, warped  # noqa: E402
from models.bundle import Bundle, write  # noqa: E402
from models.forward import ForwardModel  # noqa: E402
from models.geometry import GeometryError, load  # noqa: E402
from models.locator import Locator  # noqa: E402
from models.samples import Samples, picture  # noqa: E402
from models.shapes import Shape, to_rows  # noqa: E402
from protocol.frames import DeltaFrame, ImageFrame  # noqa: E402
from services.calibration.register_command import register_presses  # noqa: E402
from services.calibration.registration import Similarity  # noqa: E402
from services.inference import Inference  # noqa: E402
from services.networks import Network, OneStep  # noqa: E402
from services.runtime.config import Skin  # noqa: E402
from tests.cli.test_registration import presses_of  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A skin of uneven gains, registered on 40 presses, 1.1 times as large as its file says."""
    made = presses_of(Bundle.load("disc16"), Similarity(0.4, 1.1, np.zeros(2), False), n=40)
    out = tmp_path_factory.mktemp("registered") / "own"
    register_presses(made, "disc16", None, out)
    return out


@pytest.fixture(scope="module")
def registered(folder: Path) -> Bundle:
    found = warped.registered(str(folder))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def model(registered: Bundle) -> warped.WarpedModel:
    return warped.warped(registered)


@lru_cache(maxsize=1)
def _simulation(metres: float) -> ForwardModel:
    return ForwardModel(replace(load("disc16"), metres_per_unit=metres), mesh="inverse")


def simulated(bundle: Bundle, touches: list[Shape]) -> Samples:
    """One scene on the skin of the bundle's file."""
    model = _simulation(bundle.metres_per_unit)
    z0 = np.abs(model.solve(1.0).impedances())
    d = np.abs(model.solve(model.touched(touches)).impedances()) / z0 - 1
    rows = to_rows(touches)[None].astype(np.float32)
    return Samples(d[None].astype(np.float32), *picture(rows), rows)


@pytest.mark.release
def test_a_simulated_press_comes_out_as_it_was_measured(registered: Bundle, model: warped.WarpedModel) -> None:
    assert registered.locator is not None
    locator = Locator(registered.locator)
    places = locator.places / registered.metres_per_unit
    for wanted in ([0.0, 0.0], [0.4, 0.1], [-0.1, -0.5]):
        at = int(np.linalg.norm(places - wanted, axis=1).argmin())
        press = Shape("circle", *places[at], warped.PRESS_RADIUS, warped.PRESS_DROP)
        plain = simulated(registered, [press])
        found, measured = model.samples(plain).d[0], registered.locator.map[at]
        alike = float(found @ measured / np.linalg.norm(found) / np.linalg.norm(measured))
        before = float(plain.d[0] @ measured / np.linalg.norm(plain.d[0]) / np.linalg.norm(measured))
        assert alike > 0.97 > before
        assert abs(np.linalg.norm(found) / np.linalg.norm(measured) - 1) < 0.25


def test_what_its_presses_leave_open_is_its_noise(registered: Bundle, model: warped.WarpedModel) -> None:
    assert registered.locator is not None
    a = registered.locator
    covariance = model.own.error @ model.own.error.T * float((a.map.astype(float) ** 2).sum(axis=1).mean())
    assert np.allclose(covariance, a.error, atol=1e-3 * np.abs(a.error).max())


def test_the_sensitivities_have_the_unit_of_the_scenes(registered: Bundle, model: warped.WarpedModel) -> None:
    """J times the drop is what a press of that drop does, and images have the same unit."""
    drop = simulated(registered, [Shape("circle", 0.2, 0.1, warped.PRESS_RADIUS, warped.PRESS_DROP)])
    y = -np.log1p(-drop.drop[0].astype(float)).reshape(24, 4, 24, 4).mean(axis=(1, 3)).ravel()
    by_sensitivities, found = model.matrices.jacobian @ y, model.samples(drop).d[0]
    assert np.linalg.norm(by_sensitivities - found) < 0.15 * np.linalg.norm(found)
    before = np.abs(registered.matrices.back).sum() * np.abs(registered.matrices.jacobian).sum()
    after = np.abs(model.matrices.back).sum() * np.abs(model.matrices.jacobian).sum()
    assert abs(after / before - 1) < 1e-3


def test_names_and_folders_are_told_apart(registered: Bundle, folder: Path, tmp_path: Path) -> None:
    assert warped.registered("disc16") is None and warped.registered("some/where.toml") is None
    with contextlib.chdir(folder.parent):
        folder.rename("disc16")
        try:  # the folder has a shipped skin's name: ./ says which is meant
            assert warped.registered("disc16") is None and load("disc16").metres_per_unit == 0.08
            assert warped.registered("./disc16") is not None and load("./disc16").metres_per_unit != 0.08
        finally:
            Path("disc16").rename(folder)
    assert load(folder).metres_per_unit == registered.metres_per_unit
    with pytest.raises(warped.NotRegistered, match="skin register"):
        warped.registered(str(Bundle.load("disc16").path))
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(GeometryError, match="says nothing of a skin"):
        load(tmp_path)
    with pytest.raises(GeometryError, match="skin register"):
        load(tmp_path / "nothing")


@pytest.mark.parametrize(("right", "stated"), [(0.3, False), (0.8, True)])
def test_shapes_are_stated_only_where_they_were_told_apart(
    registered: Bundle, tmp_path: Path, right: float, stated: bool
) -> None:
    path = Bundle.load("square16").network_path("full")
    assert path is not None
    said = {"full": {"held_out": {"noise-free": {"class": right}}}}
    about = manifest.of_registered(registered, network=said)
    made = write(tmp_path, about, registered.matrices, {"full": path.read_bytes()}, registered.locator)
    stage = Inference("own", Skin(port="stub", bundle=str(tmp_path)), made)
    assert registered.locator is not None
    sigma = np.full(len(made.pattern), 1e-3)
    difference = registered.locator.map[100]
    frame = DeltaFrame(skin="own", touched=True, averaged=1, tare_frames=64)
    frame.difference, frame.sigma = difference.astype(np.float32), sigma.astype(np.float32)
    (image,) = stage.process(frame, frozenset({"image"}))
    assert isinstance(image, ImageFrame) and image.image.shape == (96, 96) and len(image.touches) == 1
    assert bool(image.classes.size) == stated
    assert "out_of_distribution" not in image.reasons


@pytest.mark.release
@pytest.mark.parametrize("grade", ["usable", "too little"])
def test_a_registered_bundle_gets_a_network_where_that_is_better_than_none(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], grade: str
) -> None:
    """By the command, in its shortest form; the services then run it, and the locator says where, as before."""
    monkeypatch.setattr(build, "VALID", 16)
    monkeypatch.setattr(build.Plan, "of", staticmethod(lambda minutes: build.Plan(16, 0.7 * minutes, 0.0)))
    monkeypatch.setattr(build, "make_scenes", _few)
    monkeypatch.setattr(verdict, "BETTER", -1.0 if grade == "usable" else 1.0)
    monkeypatch.setattr(verdict, "FARTHER", 1e9)
    out, before = tmp_path / "trained", Bundle.load(folder)
    shutil.copytree(folder, out)
    build.main(["--skin", str(out), "--work", str(tmp_path / "work"), "--minutes", "0.02", "--jobs", "1"])
    made = Bundle.load(out)
    assert f"verdict: {grade}" in capsys.readouterr().out and made.locator is not None
    stage = Inference("own", Skin(port="stub", bundle=str(out)), made)
    assert stage._locator is not None
    if grade == "too little":
        assert made.hash == before.hash and isinstance(stage._network, OneStep)
        return
    assert made.network_path("full") is not None and isinstance(stage._network, Network)
    assert made.hash != before.hash and made.manifest["trained"]["from"] == before.hash
    assert made.manifest["registration"] == before.manifest["registration"] and "warped" in made.manifest
    assert made.manifest["network"]["full"]["verdict"]["grade"] == grade


def _few(skin: str, work: Path, *_: object) -> None:
    for split in ("train", "valid"):
        data.generate(work, data.specs(skin, split, 16, 1, 16, "inverse"), quiet=True)
