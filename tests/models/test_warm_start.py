"""A network that goes on from an exported one computes what that one computed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from models import warm_start
from models.bundle import Bundle
from models.network import FAST, FULL, MMCNN, NetworkConfig
from models.samples import Batch


class Drawn:
    """Batches of random stacks."""

    def __init__(self) -> None:
        self.made = torch.Generator().manual_seed(1)

    def draw(self) -> Batch:
        stack, context = torch.randn(16, 9, 24, 24, generator=self.made), torch.randn(16, 4, generator=self.made)
        return Batch(stack, context, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("variant", "config"), [("full", FULL), ("fast", FAST)])
def test_it_computes_what_the_exported_network_computes(variant: str, config: NetworkConfig) -> None:
    path = Bundle.load("square16").network_path(variant)
    assert path is not None
    model = warm_start.warm(path, config, Drawn())  # type: ignore[arg-type]
    batch = Drawn().draw()
    expected = onnxruntime.InferenceSession(path).run(
        None, {"stack": batch.stack.numpy(), "context": batch.context.numpy()}
    )
    with torch.no_grad():
        for mine, theirs in zip(model.eval()(batch.stack, batch.context), expected, strict=True):
            assert np.allclose(mine.numpy(), theirs, atol=2e-4 * max(1.0, np.abs(theirs).max()))
        learning = model.train()(batch.stack, batch.context)  # by a batch's own statistics, which are much the same
        apart = [float((a - torch.from_numpy(b)).std() / b.std()) for a, b in zip(learning, expected, strict=True)]
    assert max(apart[1:]) < 0.5  # the drop is an exponential of what random stacks make


def test_a_network_of_another_size_is_refused() -> None:
    path = Bundle.load("square16").network_path("fast")
    assert path is not None
    with pytest.raises(warm_start.OtherNetwork, match="expected"):
        warm_start.warm(Path(path), FULL, Drawn())  # type: ignore[arg-type]


def test_an_untrained_one_of_that_size_is_another() -> None:
    """The test above can fail: other weights compute something else."""
    path = Bundle.load("square16").network_path("fast")
    batch = Drawn().draw()
    expected = onnxruntime.InferenceSession(path).run(
        None, {"stack": batch.stack.numpy(), "context": batch.context.numpy()}
    )
    with torch.no_grad():
        found = MMCNN(FAST).eval()(batch.stack, batch.context)
    assert not np.allclose(found[0].numpy(), expected[0], atol=2e-4 * max(1.0, np.abs(expected[0]).max()))
