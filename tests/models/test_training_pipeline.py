"""What training sees and where it starts: scenes from the sheet's inverse, soft edges, batches made on the device, a
shipped network taken up again, probabilities that mean what they say.
"""

import numpy as np
import pytest
from scipy import ndimage

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import data, export, geometry, samples  # noqa: E402
from models.augmentation import condition, random_condition  # noqa: E402
from models.class_temperature import TEMPERATURES, SeenClasses, calibration_error, cooled, pooled  # noqa: E402
from models.condensed import CondensedSheet  # noqa: E402
from models.device_batches import ConditionTensors, SceneTensors, measured, stacks  # noqa: E402
from models.evaluation import LEVELS  # noqa: E402
from models.forward import shared  # noqa: E402
from models.losses import losses  # noqa: E402
from models.mismatch import BLUR_GRID, anisotropy_root, soft_drop, soft_touched, turned  # noqa: E402
from models.network import FAST, FULL, MMCNN, NetworkConfig  # noqa: E402
from models.prereconstruction import Drift  # noqa: E402
from models.shapes import Shape, drop_image, from_rows  # noqa: E402
from models.symmetries import symmetries  # noqa: E402
from models.train import FINE, MUON_RATE, Trainer  # noqa: E402
from models.warm_start import NoSuchNetwork, normalised, restored  # noqa: E402

CPU = torch.device("cpu")


# -- scenes ---------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def uneven():
    """A coarse sheet that is anisotropic and uneven, with contact impedances of its own."""
    model = shared("square16", "inverse")
    field = 1 + 0.05 * model.centroids[:, :1]
    untouched = turned(model.touched([]) * field, anisotropy_root(0.1, 0.4))
    contact = 0.01 * np.linspace(0.7, 1.3, 16)
    return model, field, contact, untouched, CondensedSheet(model, untouched, contact)


@pytest.mark.parametrize("blur", [0.0, 0.06])
def test_the_inverse_gives_what_a_solution_gives(uneven, blur):
    model, field, contact, untouched, sheet = uneven
    z0 = model.solve(untouched, contact).impedances()
    np.testing.assert_allclose(sheet.impedances(untouched), z0, rtol=1e-5)
    for scene in (
        [Shape("L", 0.3, -0.2, 0.4, 0.6, 1.0)],
        [Shape("hertz", 0, 0, 0.2, 0.3), Shape("circle", 0.6, 0.6, 0.2, 0.1)],
    ):
        touched = soft_touched(model, scene, blur) if blur else model.touched(scene)
        conductivity = turned(touched * field, anisotropy_root(0.1, 0.4))
        d = model.solve(conductivity, contact).impedances() / z0 - 1
        np.testing.assert_allclose(sheet.impedances(conductivity) / z0 - 1, d, atol=1e-3 * np.abs(d).max())


def test_a_soft_edge_is_the_gaussian_of_a_sharp_one():
    """Also where only the window about the touches is blurred."""
    scene = [Shape("square", -0.5, 0.2, 0.3, 0.4, 0.3), Shape("circle", 0.5, 0.2, 0.15, 0.2)]
    whole = ndimage.gaussian_filter(drop_image(scene, BLUR_GRID), 0.05 * BLUR_GRID / 2, mode="constant")
    np.testing.assert_allclose(soft_drop(scene, 0.05, BLUR_GRID), whole, atol=1e-5)


def test_a_chunk_has_soft_edges_and_its_pictures_show_them(monkeypatch):
    monkeypatch.setattr(data, "SOFT_SHARE", 0.5)
    chunk = data.make_chunk(data.ChunkSpec("square16", "test", 0, 6, 1, "inverse"))  # a nominal skin
    soft = np.flatnonzero(chunk["blur"])
    assert 0 < len(soft) < 6
    model = shared("square16", "inverse")
    z0 = model.solve(1.0).impedances()
    drop, mask, _ = samples.picture(chunk["shapes"], chunk["blur"])
    for k in range(6):
        scene, blur = from_rows(chunk["shapes"][k].astype(float)), float(chunk["blur"][k])
        touched = soft_touched(model, scene, blur) if blur else model.touched(scene)
        d = model.solve(touched).impedances() / z0 - 1
        np.testing.assert_allclose(chunk["difference"][k], d, rtol=1e-4, atol=1e-7)
        wanted = soft_drop(scene, blur, samples.N) if blur else drop_image(scene, samples.N)
        assert np.abs(drop[k].astype(float) - wanted).max() < 0.02 * wanted.max()
        edge = (mask[k] > 25) & (mask[k] < 230)
        # A soft edge is wider: 1.7 standard deviations of the blur lie between 10 and 90 % of it on either side.
        assert edge.sum() > 1.5 * _outline_pixels(scene, blur) if blur > 0.03 else True


def _outline_pixels(scene, blur):
    around = sum(np.linalg.norm(np.diff(s.outline(64), axis=0, append=s.outline(64)[:1]), axis=1).sum() for s in scene)
    return around * samples.N / 2 * blur * samples.N / 2 / 2


def test_jaccards_index_of_soft_masks_is_best_at_the_truth():
    """With products, as for hard masks, a steeper edge than the true one would score better."""
    truth = torch.sigmoid(torch.linspace(-6, 6, 96)).repeat(96, 1)[None, None]
    sigma, amplitude = torch.full_like(truth, -2.0), torch.zeros(1, 1, 24, 24)
    target = samples.Target(truth, truth, torch.zeros(1, 24, 24, dtype=torch.long))

    def jaccard(steeper):
        logits = steeper * torch.logit(truth)
        return float(losses((logits, amplitude, sigma, torch.zeros(1, 5, 24, 24)), target)["jaccard"])

    assert jaccard(1.0) < 1e-3 and jaccard(1.0) < min(jaccard(0.6), jaccard(1.6), jaccard(4.0))


# -- batches --------------------------------------------------------------------------------------------------------
def test_batches_on_the_device_are_those_made_scene_by_scene(pre, scenes):
    """Without noise: eight symmetries, three conditions, one with a dead electrode, in one product."""
    rng = np.random.default_rng(1)
    skin = geometry.load("square16")
    turns = symmetries(skin.to_dict(), skin.pattern)
    found = [
        condition(pre, rng, np.full(120, sigma), Drift(1e-5, 1e-4), dead=dead, exact=True)
        for sigma, dead in ((1e-4, 0), (1e-3, 1), (1e-6, 0))
    ]
    quiet = [_without_noise(c) for c in found]
    index, which = np.arange(24), np.arange(24) % 8
    parts = [samples.make(scenes, index[8 * k : 8 * k + 8], turns, quiet[k], rng) for k in range(3)]
    wanted = samples.join(parts)
    tensors = [ConditionTensors(c, CPU) for c in quiet]
    clean, target = SceneTensors(scenes.d, scenes.drop, scenes.mask, scenes.classes, turns, CPU).pick(
        torch.from_numpy(index), torch.from_numpy(which)
    )
    seen = measured(tensors, clean.reshape(3, 8, -1), torch.Generator().manual_seed(0))
    stack, context, scale = stacks(tensors, seen)
    torch.testing.assert_close(stack, wanted.stack, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(context, wanted.context, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(target.drop / scale[:, None, None, None], wanted.target.drop, rtol=1e-4, atol=1e-5)
    assert torch.equal(target.mask, wanted.target.mask) and torch.equal(target.classes, wanted.target.classes)


def _without_noise(c):
    return type(c)(c.operator, np.zeros(120), Drift(), c.contact, c.error, c.live, c.tare_frames)


def test_noise_on_the_device_is_that_of_the_condition(pre):
    """4000 draws: standard deviation of each channel, and what drift makes of two of them together."""
    rng = np.random.default_rng(5)
    c = condition(pre, rng, np.linspace(1e-4, 4e-4, 120), Drift(2e-3, 0.1), dead=1)
    d = 0.05 * rng.standard_normal(120)
    by_hand = c.spoil(np.tile(d, (4000, 1)), rng)
    clean = torch.from_numpy(d.astype(np.float32)).expand(1, 4000, 120)
    found = measured([ConditionTensors(c, CPU)], clean, torch.Generator().manual_seed(0))[0].numpy()
    assert (found[:, ~c.live] == 0).all() and (~c.live).any()
    live = np.flatnonzero(c.live)
    a, b = np.cov(by_hand[:, live].T), np.cov(found[:, live].T)
    np.testing.assert_allclose(np.sqrt(np.diag(b)), np.sqrt(np.diag(a)), rtol=0.12)
    assert np.linalg.norm(a - b) < 0.1 * np.linalg.norm(a)


def test_small_touches_are_drawn_more_often(pre, scenes):
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=2)
    weight = np.diff(batches.cumulated, prepend=0)
    radius = scenes.shapes[:, :, 3]
    single = np.isnan(radius[:, 1])
    circle = single & (scenes.shapes[:, 0, 0] == 1)
    small = circle & (radius[:, 0] < samples.SMALL_RADIUS)
    assert small.any() and (circle & ~small).any()
    assert weight[small].min() > 1.3 * weight[circle & ~small].max()


# -- a shipped network as the start ---------------------------------------------------------------------------------
@pytest.mark.parametrize("variant, config", [("full", FULL), ("fast", FAST)])
def test_a_shipped_network_is_restored_from_its_file(bundle, pre, scenes, variant, config):
    content = bundle.network_path(variant).read_bytes()
    model = restored(content, config)
    rng = np.random.default_rng(2)
    parts = [samples.make(scenes, np.arange(24), None, random_condition(pre, rng), rng) for _ in range(2)]

    def apart():
        with torch.no_grad():
            mine = [t.numpy() for t in model.eval()(parts[0].stack, parts[0].context)]
        theirs = export.run(export.session(content), parts[0].stack.numpy(), parts[0].context.numpy())
        return max(np.abs(a - b).max() / np.abs(b).max() for a, b in zip(mine, theirs, strict=True))

    assert apart() < 1e-4
    normalised(model, [(p.stack, p.context) for p in parts])
    assert apart() < 1e-4
    # In training each normalisation takes its own batch's statistics: now those are what it had.
    with torch.no_grad():
        still = model.eval()(parts[0].stack, parts[0].context)[0]
        moving = model.train()(parts[0].stack, parts[0].context)[0]
    assert np.corrcoef(still.ravel(), moving.ravel())[0, 1] > 0.9


def test_a_network_of_other_sizes_is_refused(bundle):
    content = bundle.network_path("fast").read_bytes()
    with pytest.raises(NoSuchNetwork, match="in a network of"):
        restored(content, NetworkConfig(channels=(8, 24, 32), blocks=(1, 1, 1), lean=True))
    with pytest.raises(NoSuchNetwork, match="no convolution '/stage2/blocks.2"):
        restored(content, FULL)


def test_training_goes_on_from_a_shipped_network(bundle, pre, scenes, tmp_path):
    """The manifest will say from which; rates are lower; a resumed run remembers both."""
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)
    trainer = Trainer(FAST, batches, scenes)
    trainer.start_from(bundle, "fast")
    assert trainer.start["from"]["network"] == bundle.manifest["files"]["network_fast.onnx"]
    assert trainer.rates[0] == pytest.approx(FINE * MUON_RATE)
    trainer.step(0.5)
    trainer.best_score, trainer.elapsed = 9.0, 99.0
    worse = {f"contact IoU, {level}": 0.1 for level in LEVELS}
    assert not trainer._no_better(worse, budget=100.0)  # worse until its rate has fallen: no reason to stop
    trainer.start, kept = {}, trainer.start
    assert trainer._no_better(worse, budget=100.0)
    trainer.start = kept
    trainer.save(tmp_path / "fast.pt")
    again = Trainer(FAST, batches, scenes)
    again.resume(tmp_path / "fast.pt")
    assert again.rates == trainer.rates and again.start == trainer.start
    assert torch.load(tmp_path / "fast.pt", weights_only=True)["said"]["from"]["bundle"] == bundle.hash


# -- how sure of a shape --------------------------------------------------------------------------------------------
def test_the_temperature_undoes_overconfidence():
    """Answers that are right as often as their logits say, then told three times too loud."""
    rng = np.random.default_rng(0)
    logits = 1.2 * rng.standard_normal((6000, 5))
    share = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    truth = np.array([rng.choice(5, p=p) for p in share])
    loud = 3.0 * logits[None] / TEMPERATURES[:, None, None] * 0.8
    shown = np.exp(loud - loud.max(axis=2, keepdims=True))
    shown /= shown.sum(axis=2, keepdims=True)
    seen = SeenClasses(TEMPERATURES, shown, truth, np.full(6000, 70.0))
    said = seen.said()
    assert said["temperature"] == pytest.approx(2.4, rel=0.12)
    assert said["calibration error, all"] < 0.03
    untouched = int(np.abs(TEMPERATURES - 1).argmin())
    assert calibration_error(shown[untouched], truth, seen.weights())[1] > 0.1


def test_a_cooled_network_says_what_the_temperature_made_of_it():
    model = MMCNN(NetworkConfig(channels=(8, 8, 8), blocks=(1, 1, 1))).eval()
    x = torch.randn(1, 9, 24, 24), torch.randn(1, 4)
    with torch.no_grad():
        before = model(*x)[2].numpy()[0]
        cooled(model, float(TEMPERATURES[20]))
        after = model(*x)[2].numpy()[0]
    image = Shape("circle", 0.1, 0.1, 0.3, 0.3).fraction(96)
    one = int(np.abs(TEMPERATURES - 1).argmin())
    assert TEMPERATURES[one] == pytest.approx(1, rel=0.05)
    np.testing.assert_allclose(pooled(image, after)[one], pooled(image, before / TEMPERATURES[20])[one], rtol=1e-4)
    np.testing.assert_allclose(pooled(image, before).sum(axis=1), 1, rtol=1e-6)
