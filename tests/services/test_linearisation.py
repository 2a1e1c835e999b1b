"""Calibration in the stages: a person's tare fits and adopts, a start never does, image and data agree."""

from __future__ import annotations

import gc
import sys
import weakref
from dataclasses import replace as replaced
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import geometry, metrics
from models.bundle import Bundle
from models.calibration_file import CalibrationFileError, found_by, unpack
from models.fit_calibration import calibrate
from models.mismatch import MismatchedSheet, named
from models.shapes import Shape
from protocol.frames import Frame, RawFrame
from services import mounting
from services.calibration.force_presses import of_file
from services.contacts.force import calibration_file
from services.contacts.force.curve import Curve
from services.estimation.by_bundle import skin_tables
from services.estimation.first.baseline import Baseline
from services.linearisation import Linearisation
from services.pipeline import Pipeline, Result
from services.preprocessing import Preprocessing
from services.runtime.config import Skin, TareConfig
from services.runtime.stage import Stage

BUNDLE = "square16"
NOISE = 1e-4  # 80 dB
TOUCH = (Shape("triangle", 0.3, -0.2, 0.35, 0.3),)


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rt").mkdir(mode=0o700)
    monkeypatch.setenv("EITSKIN_RUNTIME", str(tmp_path / "rt"))


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load(BUNDLE)


@pytest.fixture(scope="module")
def sheet() -> MismatchedSheet:
    return MismatchedSheet(BUNDLE, named("mild"), "stub")


class Bench:
    """A pipeline that is fed frames of a sheet, one after the other."""

    def __init__(self, sheet: MismatchedSheet, **config: Any) -> None:
        self.skin = Skin(port="stub", bundle=BUNDLE, frame_id="palm", **config)
        self.pipeline = Pipeline(self.skin, name="palm")
        self.sheet, self.scan, self.rng = sheet, 0, np.random.default_rng(5)

    def feed(self, shapes: tuple[Shape, ...] = (), frames: int = 1) -> Result:
        z = np.abs(self.sheet.solve(shapes).impedances())
        for _ in range(frames):
            self.scan += 1
            noisy = z * (1 + NOISE * self.rng.standard_normal(len(z)))
            raw = RawFrame(
                skin="palm", scan=self.scan, z=noisy.astype(np.complex64), status=np.zeros(len(z), np.uint8),
                stamps={"sample": self.scan * 45_000_000}, source="board", valid=True, board="b",
            )  # fmt: skip
            result = self.pipeline.run(raw)
        return result

    def calibrated(self) -> dict[str, Any]:
        """Tare by command, and wait for what the fit finds."""
        answer = self.pipeline.pre.command("tare", {})
        search = self.pipeline.pre.linearisation
        if answer["calibrating"]:
            assert search._fit._process is not None
            assert search._fit._process.wait(300) == 0
            while search._fit.busy and search._ready is None:
                search._ready = search._fit.poll()
        self.pipeline.prepare()
        return answer


def iou(result: Result) -> float:
    image = result.image.image
    mask = np.any([s.fraction(len(image), covered=True) > 0.5 for s in TOUCH], axis=0)
    return metrics.iou(image > 0.5 * image.max(), mask)[0]


@pytest.fixture
def forces(tmp_path: Path, bundle: Bundle) -> Path:
    """A calibration of forces, made with this bundle."""
    file = tmp_path / "forces.json"
    skin = Skin(port="stub", bundle=BUNDLE, frame_id="palm")
    calibration_file.save(file, calibration_file.Calibration(Curve(12.0)), "palm", skin, bundle)
    return file


@pytest.mark.release
def test_a_tare_by_command_calibrates_and_a_restart_goes_on_with_it(
    sheet: MismatchedSheet, bundle: Bundle, forces: Path
) -> None:
    bench = Bench(sheet, calibration=forces)
    untared = bench.pipeline.pre.info()
    assert untared is not None and untared["force_law"]["scale"] == 12.0
    forces.unlink()  # while the service runs: it goes on with what it has read
    before = bench.feed(frames=80)
    assert not before.contact.valid and {"stale_baseline", "touched_at_start"} & set(before.contact.reasons)
    assert bench.pipeline.pre.linearisation.name == "" and not bench.pipeline.pre.linearisation.busy
    assert bench.calibrated()["calibrating"]
    after = bench.feed(frames=3)
    name = bench.pipeline.pre.linearisation.name
    assert after.contact.valid and after.delta.calibration == name
    assert bench.pipeline.inference.linearisation.name == name  # image and data agree
    info = bench.pipeline.pre.info()
    assert info is not None and info["bundle_hash"] == name != bundle.hash
    assert np.allclose(info["mounting"]["anisotropy"], 0.05, atol=0.03)
    # Of the bundle as it was loaded, and still what the publisher uses.
    assert info["calibration_hash"] == untared["calibration_hash"] and info["force_law"] == untared["force_law"]
    touched = bench.feed(TOUCH, frames=6)
    assert touched.contact.valid and iou(touched) > 0.9
    # another process, after a crash
    saved = bench.pipeline.pre.saved()
    assert saved is not None
    calibration_file.save(forces, calibration_file.Calibration(Curve(12.0)), "palm", bench.skin, bundle)
    again = Preprocessing("palm", bench.skin, bundle)
    again.restore(saved, 1.0)
    assert again.linearisation.name == name and again.info() is not None
    assert again.baseline is not None
    off = Preprocessing("palm", bench.skin.model_copy(update={"tare": TareConfig(calibrate=False)}), bundle)
    with pytest.raises(Exception, match="another bundle"):
        off.restore(saved, 1.0)
    # the same, by what a recording holds
    replay = Pipeline(bench.skin, name="palm")
    states: list[tuple[Stage, Stage]] = [
        (replay.pre, bench.pipeline.pre),
        (replay.inference, bench.pipeline.inference),
        (replay.publishing, bench.pipeline.publishing),
    ]
    for new, old in states:
        new.load(old.state())
    assert replay.pre.linearisation.name == replay.inference.linearisation.name == name
    # the person has put the skin right: the bundle is used as it is
    bench.sheet = MismatchedSheet(BUNDLE, named("none"), "stub")
    bench.feed(frames=80)
    bench.pipeline.pre.command("tare", {"force": True})
    bench.pipeline.prepare()
    assert bench.pipeline.pre.linearisation.name == "" and bench.feed().contact.valid


@pytest.mark.release
def test_no_calibration_is_adopted_while_something_touches(sheet: MismatchedSheet) -> None:
    bench = Bench(sheet)
    bench.feed(frames=80)
    bench.pipeline.pre.command("tare", {})
    search = bench.pipeline.pre.linearisation
    assert search._fit._process is not None and search._fit._process.wait(300) == 0
    while search._ready is None and search._fit.busy:
        search._ready = search._fit.poll()
    assert bench.feed(TOUCH, frames=4).delta.touched
    bench.pipeline.prepare()
    assert search.name == ""
    bench.feed(frames=12)
    bench.pipeline.prepare()
    assert search.name != ""


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.6, 0.55), (-0.7, 0.1)])
@pytest.mark.parametrize("newtons", [1.0, pytest.param(5.0, marks=pytest.mark.release)])
def test_a_start_under_a_touch_fits_nothing(x: float, y: float, newtons: float) -> None:
    for name in ("none", "mild"):
        bench = Bench(MismatchedSheet(BUNDLE, named(name), "inverse"))
        press = (Shape("circle", x, y, 0.2, newtons / 10),)
        bench.feed(press, frames=90)
        bench.pipeline.prepare()
        assert not bench.pipeline.pre.linearisation.busy
        assert bench.feed(press).delta.calibration == ""


def test_the_switch_and_the_option_turn_it_off(sheet: MismatchedSheet) -> None:
    bench = Bench(sheet, tare=TareConfig(calibrate=False))
    bench.feed(frames=80)
    assert not bench.pipeline.pre.command("tare", {})["calibrating"]
    bench = Bench(sheet)
    bench.feed(frames=80)
    assert not bench.pipeline.pre.command("tare", {"calibrate": False})["calibrating"]
    assert not bench.pipeline.pre.linearisation.busy


def test_a_tare_without_scikit_fem_is_taken_and_says_that_nothing_was_calibrated(
    sheet: MismatchedSheet, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(sheet)
    bench.feed(frames=80)
    with monkeypatch.context() as lacking:
        lacking.setitem(sys.modules, "skfem", None)
        answer = bench.pipeline.pre.command("tare", {})
    assert answer["frames"] == 64 and not answer["calibrating"]
    assert "scikit-fem is not installed" in answer["problem"] and "service.lock" in answer["problem"]
    assert answer["problem"] in bench.pipeline.pre.health().messages
    after = bench.feed(frames=3)
    assert after.delta.calibration == "" and after.contact.valid and not after.delta.touched, "the tare is in use"
    # what an earlier tare could not do is not said of one that was to calibrate nothing
    bench.feed(frames=80)
    assert bench.pipeline.pre.command("tare", {"calibrate": False, "force": True})["problem"] == ""
    bench.sheet = MismatchedSheet(BUNDLE, named("none"), "stub")
    bench.feed(frames=80)
    assert bench.pipeline.pre.command("tare", {"force": True})["problem"] == ""
    assert not bench.pipeline.pre.health().messages


def test_a_calibration_that_inference_cannot_find_makes_frames_invalid(sheet: MismatchedSheet) -> None:
    bench = Bench(sheet)
    bench.feed(frames=80)
    bench.pipeline.pre.command("tare", {"calibrate": False})
    delta = bench.pipeline.pre.process(_raw(bench), frozenset({"delta"}))[0]
    delta.calibration = "ab" * 32  # type: ignore[attr-defined]
    image = bench.pipeline.inference.process(delta, frozenset({"image"}))[0]
    assert not image.valid and "stale_baseline" in image.reasons


@pytest.mark.release
def test_a_calibration_that_arrives_late_is_used(sheet: MismatchedSheet, bundle: Bundle) -> None:
    z0 = np.abs(sheet.solve().impedances())
    packed = calibrate(bundle, z0, 1e-5 * z0)
    bench = Bench(sheet)
    bench.feed(frames=80)
    bench.pipeline.pre.command("tare", {"calibrate": False})
    delta = bench.pipeline.pre.process(_raw(bench), frozenset({"delta"}))[0]
    delta.calibration = unpack(packed, bundle).hash  # type: ignore[attr-defined]

    def image() -> Frame:
        return bench.pipeline.inference.process(delta, frozenset({"image"}))[0]

    assert not any(image().valid for _ in range(10))
    mounting.keep("palm", mounting.MountedSkin(packed, bundle))
    assert any([image().valid for _ in range(25)]) and image().valid  # a second of frames


def test_what_is_made_of_a_calibrated_bundle_goes_with_it(bundle: Bundle) -> None:
    """Each tare that calibrates makes a bundle with a hash of its own."""
    held = skin_tables(bundle)
    made = [weakref.ref(skin_tables(replaced(bundle, hash=f"{k:064x}"))) for k in range(7)]
    gc.collect()
    assert sum(each() is not None for each in made) <= 4
    assert skin_tables(bundle) is held  # who uses it shares it, however many came since


def _raw(bench: Bench) -> RawFrame:
    z = np.abs(bench.sheet.solve().impedances())
    return RawFrame(
        skin="palm", scan=999, z=z.astype(np.complex64), status=np.zeros(len(z), np.uint8),
        stamps={"sample": 999 * 45_000_000}, source="board", valid=True, board="b",
    )  # fmt: skip


@pytest.mark.release
def test_forces_are_calibrated_on_what_is_seen_after_a_tare(
    sheet: MismatchedSheet, bundle: Bundle, tmp_path: Path
) -> None:
    press = Shape("circle", -0.5, -0.5, 0.25, 0.3)
    z0, z = (np.abs(sheet.solve(shapes).impedances()) for shapes in ((), (press,)))
    noise = NOISE * np.random.default_rng(3).standard_normal((40, len(z)))
    np.savez(tmp_path / "presses.npz", measurements=z[None], untouched=z0 * (1 + noise))

    def seen(**config: Any) -> tuple[float, float]:
        """Newtons, and the integrated drop."""
        skin = Skin(port="stub", bundle=BUNDLE, frame_id="palm", **config)
        found = of_file(tmp_path / "presses.npz", skin, bundle, lambda text: None)(0).quantities
        return found["pressure"].value, found["integral"].value

    (newton, integral), true = seen(), press.drop * press.area * 0.05**2
    assert newton == pytest.approx(press.force(0.05), rel=0.02) and integral == pytest.approx(true, rel=0.02)
    with pytest.raises(ValueError, match="not valid: stale_baseline"):
        seen(tare=TareConfig(calibrate=False))


@pytest.mark.release
def test_a_calibration_of_another_bundle_or_a_damaged_one_is_refused(bundle: Bundle, sheet: MismatchedSheet) -> None:
    z0 = np.abs(sheet.solve().impedances())
    packed = calibrate(bundle, z0, 1e-5 * z0)
    own = unpack(packed, bundle)
    said = found_by(own)
    assert said is not None and found_by(bundle) is None and own.hash != bundle.hash
    assert np.allclose(own.matrices.gram, own.matrices.gram.T) and own.matrices.gram.shape == bundle.matrices.gram.shape
    assert np.allclose(own.matrices.gram, bundle.matrices.gram, rtol=0.5, atol=0.1 * np.abs(own.matrices.gram).max())
    geometry.from_dict(own.skin)  # electrodes where they are, on the outline
    with pytest.raises(CalibrationFileError, match="of the bundle"):
        unpack(packed, replaced(bundle, hash="0" * 64))
    with pytest.raises(CalibrationFileError, match="skin tare"):
        unpack(packed[:-100], bundle)
    mounting.keep("palm", mounting.MountedSkin(packed, bundle))
    found = mounting.kept("palm", bundle)
    assert found is not None and found.bundle.hash == own.hash
    assert Linearisation("palm", bundle).follow(own.hash)
    mounting.keep("palm", None)
    assert mounting.kept("palm", bundle) is None


def test_a_bundle_that_predicts_the_skin_needs_no_fit(bundle: Bundle) -> None:
    def baseline(name: str) -> Baseline:
        z0 = np.abs(MismatchedSheet(BUNDLE, named(name), "stub").solve().impedances())
        return Baseline(z0, 1e-4 * z0, 64, "b", 0)

    assert not mounting.needs_fit(baseline("none"), bundle)
    assert mounting.needs_fit(baseline("shift1"), bundle)


def test_a_fit_that_fails_says_why_and_changes_nothing(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    z0 = np.abs(MismatchedSheet(BUNDLE, named("shift1"), "inverse").solve().impedances())
    z0[:60] = 0.0  # half of the measurements failed
    sigma = np.where(z0 > 0, 1e-4 * z0, np.inf)
    search = mounting.MountingFit(bundle)
    search.start(Baseline(z0, sigma, 64, "b", 0))
    assert search.wait() is None and "60 of 120" in search.problem and not search.busy
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "full"))  # a disk that takes nothing
    search.start(Baseline(z0, sigma, 64, "b", 0))
    assert "could not be calibrated" in search.problem and not search.busy
