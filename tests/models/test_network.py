"""Training and export: symmetries against the forward model, parity of ONNX, resuming, and the shipped
network on another solver's frames.
"""

import numpy as np
import pytest

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import export, geometry, samples  # noqa: E402
from models.augmentation import random_condition  # noqa: E402
from models.bundle import Bundle  # noqa: E402
from models.forward import ForwardModel  # noqa: E402
from models.losses import losses, total  # noqa: E402
from models.network import NetworkConfig, compose  # noqa: E402
from models.published import PublishedMMCNN  # noqa: E402
from models.shapes import Shape  # noqa: E402
from models.symmetries import symmetries  # noqa: E402
from models.train import Trainer  # noqa: E402
from models.turns import Turn  # noqa: E402

TINY = NetworkConfig(channels=(8, 8, 8), blocks=(1, 1, 1))


@pytest.fixture(scope="module")
def trainer(pre, scenes):
    torch.set_num_threads(1)
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)
    return Trainer(TINY, batches, scenes)


def symmetries_of(skin):
    return symmetries(skin.to_dict(), skin.pattern)


def test_symmetries_are_those_of_the_forward_model():
    """The difference of a turned touch is the permuted difference of the touch; meshes are not symmetric: 1 %."""
    model = ForwardModel("square16", mesh="inverse")
    z0 = np.abs(model.solve(1.0).impedances())

    def difference(image):
        return np.abs(model.solve(1 - model.element_map(96) @ image.ravel()).impedances()) / z0 - 1

    image = 0.4 * Shape("triangle", 0.3, -0.5, 0.3, 0.4, 0.4).fraction(96)
    d = difference(image)
    found = symmetries_of(model.skin)
    assert len(found) == 8
    for symmetry in found:
        turned = difference(symmetry.turn.image(image))
        assert np.linalg.norm(turned - d[symmetry.measurements]) < 0.015 * np.linalg.norm(turned)


def test_a_disc_has_only_the_symmetries_its_electrodes_have():
    assert len(symmetries_of(geometry.load("disc16"))) == 8
    skin = geometry.load("square16")
    assert len(symmetries_of(skin.moved(np.r_[0.05, np.zeros(15)]))) == 1


def test_an_outline_or_a_contact_of_its_own_is_no_symmetry():
    """A sheet that is cut off on one side, with electrodes that look alike; one electrode that touches badly."""
    skin = geometry.load("square16").to_dict()
    pattern = geometry.load("square16").pattern
    longer = skin | {"outline": [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.2], [-1.0, 1.2]]}
    assert [s.turn for s in symmetries(longer, pattern)] == [Turn(False, False, False), Turn(False, False, True)]
    assert len(symmetries(skin | {"contact_impedance": [0.1, *[0.01] * 15]}, pattern)) == 1
    assert len(symmetries(skin, pattern[1:])) < 8
    assert symmetries({}, pattern) == []


@pytest.mark.parametrize("skin", ["square16", "disc16"])
def test_a_symmetry_maps_measurements_one_to_one_also_where_a_pattern_reads_each_twice(skin):
    """The disc's pattern drives each pair of electrodes in both directions: a real skin's two readings differ."""
    found = [symmetry.measurements for symmetry in symmetries_of(geometry.load(skin))]
    np.testing.assert_array_equal(found[0], np.arange(len(found[0])))
    for measurements in found:
        np.testing.assert_array_equal(np.sort(measurements), np.arange(len(measurements)))


def test_training_lowers_the_loss(trainer):
    first = np.mean([total_of(trainer.step(0.2)) for _ in range(3)])
    for _ in range(30):
        trainer.step(0.2)
    last = np.mean([total_of(trainer.step(0.2)) for _ in range(3)])
    assert last < 0.85 * first


def total_of(terms):
    return sum(v for k, v in terms.items() if k != "sigma")


def test_the_loss_is_least_at_the_truth(pre, scenes):
    rng = np.random.default_rng(1)
    batch = samples.make(scenes, np.arange(8), None, random_condition(pre, rng), rng)
    t = batch.target
    right = torch.logit(t.mask.clamp(1e-4, 1 - 1e-4))
    peak = t.drop.amax((1, 2, 3), keepdim=True)
    amplitude = torch.log(t.drop[:, :, 1::4, 1::4].clamp_min(1e-6))
    amplitude = torch.where(t.mask[:, :, 1::4, 1::4] > 0, amplitude, torch.log(peak))
    sigma, classes = torch.full_like(right, -2.0), torch.zeros(8, 5, 24, 24)
    at_truth = losses((right, amplitude, sigma, classes), t)
    for wrong in ((torch.roll(right, 4, 3), amplitude), (right, amplitude + 0.3), (-right, amplitude)):
        off = losses((*wrong, sigma, classes), t)
        worse, best = ({k: v for k, v in terms.items() if k != "sigma"} for terms in (off, at_truth))
        assert total(worse) > total(best)
    assert at_truth["image"] < 0.1 and at_truth["jaccard"] < 0.2  # soft edges overlap only in part


def test_resuming_continues_where_it_stopped(trainer, pre, scenes, tmp_path):
    trainer.step(0.2)
    trainer.save(tmp_path / "a.pt")
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)
    again = Trainer(TINY, batches, scenes)
    again.resume(tmp_path / "a.pt")
    assert again.steps == trainer.steps
    x = torch.randn(2, 9, 24, 24), torch.randn(2, 4)
    for mine, theirs in ((again.model, trainer.model), (again.average, trainer.average)):
        assert torch.equal(mine.eval()(*x)[0], theirs.eval()(*x)[0])
    moments = [o.state_dict()["state"] for o in (again.optimizers[0], trainer.optimizers[0])]
    assert torch.equal(moments[0][0]["momentum"], moments[1][0]["momentum"])


def test_onnx_agrees_with_pytorch_for_any_batch(trainer, pre, scenes):
    """to_onnx checks parity itself; here single frames against the batch, and int8 against float."""
    model = trainer.result()
    rng = np.random.default_rng(2)
    batch = samples.make(scenes, np.arange(32), None, random_condition(pre, rng), rng)
    stack, context = batch.stack.numpy(), batch.context.numpy()
    content = export.to_onnx(model, stack, context)
    session = export.session(content)
    together = export.run(session, stack[:5], context[:5])
    alone = [export.run(session, stack[k : k + 1], context[k : k + 1]) for k in range(5)]
    assert [t.shape for t in together] == [(5, 1, 96, 96), (5, 1, 96, 96), (5, 5, 24, 24)]
    for k, output in enumerate(together):
        assert np.concatenate([a[k] for a in alone]) == pytest.approx(output, rel=1e-4, abs=1e-5)
    small = export.run(export.session(export.to_int8(content, stack, context)), stack, context)
    exact = export.run(session, stack, context)
    assert np.corrcoef(small[0].ravel(), exact[0].ravel())[0, 1] > 0.98


def test_export_refuses_a_network_that_computes_something_else(trainer, monkeypatch, pre, scenes):
    rng = np.random.default_rng(3)
    batch = samples.make(scenes, np.arange(4), None, random_condition(pre, rng), rng)
    real = export.run
    monkeypatch.setattr(export, "run", lambda *a: [1.001 * o for o in real(*a)])
    with pytest.raises(export.ParityError, match="differs from PyTorch"):
        export.to_onnx(trainer.result(), batch.stack.numpy(), batch.context.numpy())


def test_export_allows_what_float32_loses_in_pytorch_too(trainer, pre, scenes):
    """A network that adds a large number and takes it away again loses digits in any float32 program."""

    class Cancelling(torch.nn.Module):
        def __init__(self, model):
            super().__init__()
            self.model = model

        def forward(self, stack, context):
            return tuple((1e5 + output) - 1e5 for output in self.model(stack, context))

    rng = np.random.default_rng(4)
    batch = samples.make(scenes, np.arange(4), None, random_condition(pre, rng), rng)
    stack, context = batch.stack.numpy(), batch.context.numpy()
    model = Cancelling(trainer.result()).eval()
    content = export.to_onnx(model, stack, context)
    with torch.no_grad():
        exact = model.double()(torch.from_numpy(stack).double(), torch.from_numpy(context).double())
    found = export.run(export.session(content), stack, context)
    assert max(np.abs(f - e.numpy()).max() / e.abs().max() for f, e in zip(found, exact, strict=True)) > export.PARITY


def test_uncertain_is_what_the_network_says_it_is():
    """compose: sigma is relative to the amplitude, so doubling the amplitude doubles drop and sigma alike."""
    mask, sigma = torch.randn(1, 1, 96, 96), torch.randn(1, 1, 96, 96)
    amplitude = torch.randn(1, 1, 24, 24)
    drop, log_sigma = compose(mask, amplitude, sigma)
    twice, log_twice = compose(mask, amplitude + np.log(2), sigma)
    assert torch.allclose(twice, 2 * drop, rtol=1e-4)
    assert torch.allclose(log_twice.exp(), 2 * log_sigma.exp(), rtol=1e-4)


@pytest.mark.parametrize("attention", [True, False])
def test_the_published_network_has_the_published_layers(attention):
    model = PublishedMMCNN(attention)
    kinds = [type(m).__name__ for m in model.modules()]
    assert kinds.count("MaxPool2d") == 3 and kinds.count("ConvTranspose2d") == 4 and kinds.count("Upsample") == 4
    assert kinds.count("CBAM") == attention
    assert model.eval()(torch.zeros(2, 1, 48, 48)).shape == (2, 1, 96, 96)


@pytest.mark.parametrize(
    "variant, decibel, bound", [("full", None, 0.90), ("full", 70, 0.84), ("fast", None, 0.88), ("fast", 70, 0.80)]
)
def test_the_shipped_network_on_another_solvers_frames(pre, variant, decibel, bound):
    """EIDORS's single touches. Bounds below the benchmark's figures: they catch a broken bundle, not a bad day."""
    z = np.load(needs.reference("eidors_reference.npz"))
    rng = np.random.default_rng(0)
    impedance = np.abs(z["impedance_pairs"])
    single = np.flatnonzero(np.isfinite(z["shapes"][:, 0, 0]) & np.isnan(z["shapes"][:, 1, 0]))
    sigma = 10 ** (-(decibel or 130) / 20)
    operator = pre.condition(np.full(120, sigma))
    session = export.session(Bundle.load("square16").network_path(variant))
    scores = []
    for scene in np.repeat(single, 4):
        z0 = (impedance[0] * (1 + sigma * rng.standard_normal((64, 120)))).mean(axis=0)
        noisy = impedance[scene] * (1 + sigma * rng.standard_normal(120))
        stack, context, _ = operator.stack(pre.difference(noisy, z0))
        drop = export.run(session, stack[None], context[None])[0][0, 0]
        seen, real = drop > 0.5 * drop.max(), z["drop"][scene] > 0
        contact, rest = [(a & b).sum() / (a | b).sum() for a, b in ((seen, real), (~seen, ~real))]
        scores.append((contact + rest) / 2)
    assert np.mean(scores) > bound
