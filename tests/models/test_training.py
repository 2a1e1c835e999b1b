"""Training in small: it learns, goes on where it stopped, is exported, and says how it went."""

import numpy as np
import pytest

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import export, geometry, samples, verdict  # noqa: E402
from models.augmentation import random_condition  # noqa: E402
from models.network import NetworkConfig  # noqa: E402
from models.scenes import random_scene  # noqa: E402
from models.shapes import to_rows  # noqa: E402
from models.train import Trainer  # noqa: E402

pytestmark = pytest.mark.release  # trains, each time from nothing


def test_training_lowers_the_loss_resumes_and_is_exported(pre, tmp_path):
    """96 scenes, differences by the linearised model. to_onnx checks parity itself."""
    torch.set_num_threads(1)
    rng, tiny = np.random.default_rng(0), NetworkConfig(channels=(8, 8, 8), blocks=(1, 1, 1))
    rows = np.stack([to_rows(random_scene(rng)) for _ in range(96)]).astype(np.float32)
    drop, mask, classes = samples.picture(rows)
    coarse = drop.astype(float).reshape(96, 24, 4, 24, 4).mean(axis=(2, 4)).reshape(96, -1)
    scenes = samples.Samples((coarse @ pre.m.jacobian.T).astype(np.float32), drop, mask, classes, rows)
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)
    trainer, again = Trainer(tiny, batches, scenes), Trainer(tiny, batches, scenes)
    loss = [sum(v for k, v in trainer.step(0.2).items() if k != "sigma") for _ in range(36)]
    assert np.mean(loss[-3:]) < 0.85 * np.mean(loss[:3])
    trainer.save(tmp_path / "a.pt")
    again.resume(tmp_path / "a.pt")
    x = torch.randn(2, 9, 24, 24), torch.randn(2, 4)
    assert again.steps == trainer.steps
    for mine, theirs in ((again.model, trainer.model), (again.average, trainer.average)):
        assert torch.equal(mine.eval()(*x)[0], theirs.eval()(*x)[0])
    batch = samples.make(scenes, np.arange(32), None, random_condition(pre, rng), rng)
    stack, context = batch.stack.numpy(), batch.context.numpy()
    session = export.session(export.to_onnx(trainer.result(), stack, context))
    shapes = [output.shape for output in export.run(session, stack[:5], context[:5])]
    assert shapes == [(5, 1, 96, 96), (5, 1, 96, 96), (5, 5, 24, 24)]


def test_the_verdict():
    for iou, grade in ((0.83, "good"), (0.70, "usable"), (0.59, "too little")):
        row = {"contact IoU": iou, "position % of side": 0.5, "class": 0.7}
        held_out = {"noise-free": row, "70 dB": row}
        found = verdict.judge(held_out, batches=1000, minutes=5.0, single_step=0.57, floor=0.4)
        assert found.grade == grade and found.text.startswith(grade)
