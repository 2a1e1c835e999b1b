"""A bundle calibrated to the skin as it is mounted: a tare fits and adopts, a start never, image and data agree."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from models import metrics
from models.bundle import Bundle
from models.calibration_file import CalibrationFileError, found_by, pack, unpack
from models.mismatch import MismatchedSheet, named
from models.shapes import Shape
from services import mounting
from services.estimation.initialisation.baseline import Baseline
from services.pipeline import Pipeline
from services.preprocessing import Preprocessing
from services.runtime.config import Skin, TareConfig
from services.runtime.stage import Refused
from tests.services.stub_skin import whole_scan
from tests.waiting import until

NOISE = 1e-4  # 80 dB
TOUCH = (Shape("triangle", 0.3, -0.2, 0.35, 0.3),)
pytestmark = pytest.mark.usefixtures("runtime")


@pytest.fixture(scope="module")
def sheet():
    return MismatchedSheet("square16", named("mild"), "stub")


class Bench:
    """A pipeline that is fed frames of a sheet, one after the other."""

    def __init__(self, sheet, **config):
        self.skin = Skin(port="stub", bundle="square16", frame_id="palm", **config)
        self.pipeline = Pipeline(self.skin, name="palm")
        self.sheet, self.scan, self.rng = sheet, 0, np.random.default_rng(5)

    def feed(self, shapes=(), frames=1):
        z = np.abs(self.sheet.solve(shapes).impedances())
        for _ in range(frames):
            self.scan += 1
            noisy = z * (1 + NOISE * self.rng.standard_normal(len(z)))
            result = self.pipeline.run(whole_scan(noisy, self.scan, board="b"))
        return result

    def tare(self, **args):
        return self.pipeline.pre.command("tare", args)

    def mounted(self, packed, bundle, z0):
        """Start with a baseline that was kept beside this calibration."""
        mounting.save("palm", mounting.MountedSkin(packed, bundle))
        kept = Baseline(z0, NOISE * z0, 64, "b", 1)
        saved = {"bundle": unpack(packed, bundle).hash, "baseline": kept.to_dict(), "taken_s": 0.0}
        self.pipeline.pre.restore(saved, 1.0)
        return saved


@pytest.fixture
def packed(bundle, sheet):
    """A calibration that has the sheet's |Z| when untouched and else the bundle's matrices: cheap, and good enough."""
    z0 = np.abs(sheet.solve().impedances())
    return pack(replace(bundle.matrices, z0=z0), bundle.skin, {"bundle_hash": bundle.hash})


def test_frames_name_their_calibration_and_inference_follows_although_it_comes_late(bundle, sheet, packed):
    own = unpack(packed, bundle)
    assert found_by(own) is not None and found_by(bundle) is None and own.hash != bundle.hash
    np.testing.assert_allclose(own.matrices.gram, bundle.matrices.gram)
    with pytest.raises(CalibrationFileError, match="of the bundle"):
        unpack(packed, replace(bundle, hash="0" * 64))
    bench = Bench(sheet)
    before = bench.feed(frames=80)
    assert not before.contact.valid and {"stale_baseline", "touched_at_start"} & set(before.contact.reasons)
    assert before.delta.calibration == "" and not bench.pipeline.pre.linearisation.busy, "a start fits nothing"
    bench.tare(calibrate=False)
    delta = bench.feed().delta
    delta.calibration = own.hash
    (image,) = bench.pipeline.inference.process(delta, frozenset({"image"}))
    assert delta.valid and not image.valid and "stale_baseline" in image.reasons, "it is nowhere to be found"
    mounting.save("palm", mounting.MountedSkin(packed, bundle))
    late = [bench.pipeline.inference.process(delta, frozenset({"image"}))[0].valid for _ in range(25)]
    assert any(late) and late[-1], "within a second of frames"
    # a start that finds a baseline that was kept with it goes on with it, unless skin.toml says no
    again = Bench(sheet)
    saved, after = again.mounted(packed, bundle, own.matrices.z0), again.feed(frames=3)
    assert after.contact.valid and after.delta.calibration == own.hash and not after.delta.touched
    info = again.pipeline.pre.info()
    assert info["bundle_hash"] == own.hash and info["mounting"]["bundle_hash"] == bundle.hash
    off = Preprocessing("palm", again.skin.model_copy(update={"tare": TareConfig(calibrate=False)}), bundle)
    with pytest.raises(Refused, match="another bundle"):
        off.restore(saved, 1.0)
    # the same, by what a recording holds
    replay = Pipeline(again.skin, name="palm")
    replay.pre.load(again.pipeline.pre.state())
    replay.inference.load(again.pipeline.inference.state())
    assert replay.pre.linearisation.name == replay.inference.linearisation.name == own.hash


def test_a_skin_put_right_goes_back_to_its_bundle_while_nothing_touches(bundle):
    bench = Bench(MismatchedSheet("square16", named("none"), "stub"))
    z0 = np.abs(bench.sheet.solve().impedances())
    other = replace(bundle.matrices, z0=bundle.z0 * (1 + 1e-3 * np.random.default_rng(0).standard_normal(120)))
    bench.mounted(pack(other, bundle.skin, {"bundle_hash": bundle.hash}), bundle, z0)
    name = bench.feed(frames=72).delta.calibration
    assert name and not bench.tare(force=True)["calibrating"] and bench.feed(TOUCH, frames=4).delta.touched
    bench.pipeline.prepare()
    assert bench.feed(TOUCH).delta.calibration == name
    bench.feed(frames=12)
    bench.pipeline.prepare()
    after = bench.feed()
    assert after.contact.valid and after.delta.calibration == "" and not after.contact.contacts


def test_a_tare_that_calibrates_nothing_is_in_use_and_says_why(sheet, monkeypatch, bundle):
    bench = Bench(sheet)
    bench.feed(frames=80)
    assert not bench.tare(calibrate=False)["calibrating"] and not bench.pipeline.pre.linearisation.busy
    monkeypatch.setitem(sys.modules, "skfem", None)
    answer = bench.tare(force=True)
    assert not answer["calibrating"] and "scikit-fem is not installed" in answer["problem"]
    assert answer["problem"] in bench.pipeline.pre.health().messages
    assert bench.tare(calibrate=False, force=True)["problem"] == ""  # of an earlier tare
    after = bench.feed(frames=3)
    assert after.delta.calibration == "" and after.contact.valid and not after.delta.touched, "the tare is in use"
    z0 = np.abs(sheet.solve().impedances())
    for z, of, needs in ((z0, bundle, True), (1.2 * bundle.z0, bundle, False), (z0, Bundle.load("disc16"), False)):
        assert mounting.needs_fit(Baseline(z, 1e-4 * z0, 64, "b", 0), of) == needs, "a gain alone needs no fit"


@pytest.mark.release
def test_a_tare_by_command_calibrates_while_nothing_touches(sheet, bundle):
    """The fit itself, in its process: half a minute of computing."""
    bench = Bench(sheet)
    bench.feed(frames=80)
    assert bench.tare()["calibrating"]
    linearisation = bench.pipeline.pre.linearisation
    bench.feed(TOUCH, frames=4)
    found = until(lambda: (bench.pipeline.prepare(), mounting.saved("palm", bundle))[1])
    bench.pipeline.prepare()
    assert linearisation.name == "", "something touches"
    assert bench.feed(frames=12).contact.valid
    until(lambda: (bench.pipeline.prepare(), linearisation.name)[1])
    after = bench.feed(frames=3)
    assert after.contact.valid and after.delta.calibration == linearisation.name == found.bundle.hash
    assert np.allclose(bench.pipeline.pre.info()["mounting"]["anisotropy"], 0.05, atol=0.03)
    touched = bench.feed(TOUCH, frames=6)
    image, truth = touched.image.image, TOUCH[0].fraction(96, covered=True) > 0.5
    assert touched.contact.valid and metrics.iou(image > 0.5 * image.max(), truth)[0] > 0.9
