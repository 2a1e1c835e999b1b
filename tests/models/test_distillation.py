"""A smaller network as a part of a larger one that teaches it."""

import numpy as np
import pytest

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import geometry, samples  # noqa: E402
from models.augmentation import random_condition  # noqa: E402
from models.distillation import Teacher, taught, turned  # noqa: E402
from models.network import FAST, MMCNN, NetworkConfig  # noqa: E402
from models.pruning import NoPart, part, worth  # noqa: E402
from models.train import PART, Trainer, full_network  # noqa: E402
from models.turns import TURNS  # noqa: E402

pytestmark = pytest.mark.release  # trains

WHOLE = NetworkConfig(channels=(8, 12, 10), blocks=(1, 3, 2))


@pytest.fixture
def batches(pre, scenes):
    return samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)


def lived_in(config):
    """A network whose normalisations are not those of a fresh one."""
    torch.manual_seed(3)
    model = MMCNN(config).eval()
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                for values, low in ((module.weight, 0.5), (module.bias, -0.5), (module.running_mean, -0.5)):
                    values.uniform_(low, 1.0)
    return model


def unread(model, channels, blocks):
    """Nothing reads these channels of the three widths any more, and these blocks of the second stage add nothing."""
    readers = (
        (model.down1[0], model.out, model.aside),
        (model.down2[0], model.up1[0], model.classes, *(b[0] for s in (model.stage1, model.stage3) for b in s.blocks)),
        (model.up2[0], *(b[0] for b in model.stage2.blocks)),
    )
    with torch.no_grad():
        for convolutions, index in zip(readers, channels, strict=True):
            for convolution in convolutions:
                convolution.weight[:, index] = 0
        for k in blocks:
            model.stage2.blocks[k][1].weight.zero_()
            model.stage2.blocks[k][1].bias.zero_()


@pytest.mark.parametrize("lean", [True, False])
def test_without_what_nothing_reads_a_network_computes_the_same(batches, lean):
    """Attention looks at the mean over the inner channels, so there all of those are kept."""
    model = lived_in(NetworkConfig(WHOLE.stack, WHOLE.grid, WHOLE.channels, WHOLE.blocks, lean))
    unread(model, ([1, 6], [0, 5, 11], [2, 9] if lean else []), [1])
    small = part(
        model, NetworkConfig(channels=(6, 9, 8 if lean else 10), blocks=(1, 2, 2), lean=lean), worth(model, batches, 2)
    ).eval()
    batch = batches.draw()
    with torch.no_grad():
        for mine, theirs in zip(
            small.parts(batch.stack, batch.context), model.parts(batch.stack, batch.context), strict=True
        ):
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)


def test_a_larger_network_is_no_part():
    model = MMCNN(WHOLE)
    for config in (
        NetworkConfig(channels=(9, 12, 10), blocks=WHOLE.blocks),
        NetworkConfig(channels=WHOLE.channels, blocks=(1, 4, 2)),
    ):
        with pytest.raises(NoPart, match="may have fewer"):
            part(model, config, None)


@pytest.mark.parametrize("turn", TURNS)
def test_the_teacher_sees_the_turned_stack_and_its_answer_is_turned_back(pre, scenes, turn):
    rng = np.random.default_rng(1)
    batch = samples.make(scenes, np.arange(4), None, random_condition(pre, rng), rng)
    images = batch.stack.numpy()
    np.testing.assert_array_equal(turned(batch.stack, turn).numpy(), turn.image(images))
    model = lived_in(WHOLE)
    with torch.no_grad():
        seen = model.parts(torch.from_numpy(turn.image(images).copy()), batch.context)
    for mine, theirs in zip(Teacher(model, {}).parts(batch.stack, batch.context, turn), seen, strict=True):
        np.testing.assert_allclose(mine.numpy(), turn.back.image(theirs.numpy()), atol=1e-6)


def test_what_is_taught_is_least_at_the_teachers_answer(pre, scenes):
    rng = np.random.default_rng(1)
    batch = samples.make(scenes, np.arange(8), None, random_condition(pre, rng), rng)
    with torch.no_grad():
        answer = lived_in(WHOLE).parts(batch.stack, batch.context)
    mask, amplitude, sigma, classes = answer
    at_best = taught(answer, answer, batch.target)
    assert at_best["taught amplitude"] == 0 and abs(float(at_best["taught class"])) < 1e-6
    others = {
        "taught mask": (torch.roll(mask, 4, 3), amplitude, sigma, classes),
        "taught amplitude": (mask, amplitude + 0.3, sigma, classes),
        "taught class": (mask, amplitude, sigma, 2 * classes + torch.randn(classes.shape)),
    }
    for name, other in others.items():
        assert taught(other, answer, batch.target)[name] > at_best[name] + 1e-3


def test_training_starts_as_a_part_of_a_bundles_network_and_learns_from_it(bundle, scenes, batches, tmp_path):
    """The manifest will say of which; a resumed run has the teacher again."""
    trainer = Trainer(FAST, batches, scenes)
    trainer.start_as_part(full_network(bundle, batches))
    file = bundle.manifest["files"]["network.onnx"]
    assert trainer.start == {"part_of": {"name": "square16", "bundle": bundle.hash, "network": file}}
    assert trainer.rates[1] == pytest.approx(PART * 2e-3)
    assert trainer.step(0.5).keys() >= {"taught mask", "taught amplitude", "taught class", "mask"}
    trainer.save(tmp_path / "fast.pt")
    again = Trainer(FAST, batches, scenes)
    again.resume(tmp_path / "fast.pt", full_network(bundle, batches))
    assert again.start == trainer.start and again.rates == trainer.rates and "taught mask" in again.step(0.5)
