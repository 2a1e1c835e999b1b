"""A network that goes on from one that was exported: the weights of an ONNX file, in PyTorch again.

The export folds each batch normalisation into the convolution before it. Here it becomes one again that changes
nothing: its statistics are measured on batches, and its gain and offset undo them. So the network computes what it
computed, and learns on as any other.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from models.network import MMCNN, NetworkConfig
from models.samples import Batches
from protocol.errors import EitskinError

BATCHES = 4  # that statistics are taken over


class OtherNetwork(EitskinError, ValueError):
    """An ONNX file does not hold a network of the sizes that are to be trained."""


def warm(path: Path, config: NetworkConfig, batches: Batches) -> MMCNN:
    """The network of an ONNX file, ready to learn on. Raises OtherNetwork."""
    model = MMCNN(config).eval()
    weights = _weights(path)
    norms = {name: layer for name, layer in model.named_modules() if isinstance(layer, nn.BatchNorm2d)}
    chosen: dict[str, Tensor] = {}
    for name, value in model.state_dict().items():
        layer, _, kind = name.rpartition(".")
        if layer in norms:  # changes nothing until its statistics are known
            folded = weights.get(f"{layer.rpartition('.')[0]}.0.bias")
            plain = {"weight": torch.ones_like(value), "running_var": torch.full_like(value, 1.0 - norms[layer].eps)}
            found = folded if kind == "bias" else plain.get(kind, torch.zeros_like(value))
        else:
            found = weights.get(name)
        if found is None or found.shape != value.shape:
            held = "nothing" if found is None else f"{list(found.shape)}"
            raise OtherNetwork(f"{path}: {name}: found {held}, expected {list(value.shape)}: train without --start")
        chosen[name] = found
    model.load_state_dict(chosen)
    with torch.no_grad():
        _measure(model, norms, batches)
    return model


def _measure(model: MMCNN, norms: dict[str, nn.BatchNorm2d], batches: Batches) -> None:
    sums = {name: torch.zeros(3, layer.num_features) for name, layer in norms.items()}

    def seen(name: str, _: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        x = inputs[0]
        sums[name] += torch.stack([torch.ones(x.shape[1]), x.mean((0, 2, 3)), (x**2).mean((0, 2, 3))])

    hooks = [layer.register_forward_pre_hook(partial(seen, name)) for name, layer in norms.items()]
    for _ in range(BATCHES):
        batch = batches.draw()
        model.parts(batch.stack, batch.context)
    for hook in hooks:
        hook.remove()
    for name, layer in norms.items():
        count, first, second = sums[name]
        mean = first / count
        variance = (second / count - mean**2).clamp_min(1e-8)
        layer.running_mean, layer.running_var = mean, variance
        layer.weight.copy_((variance + layer.eps).sqrt())
        layer.bias.add_(mean)


def _weights(path: Path) -> dict[str, Tensor]:
    """Every weight by its name in PyTorch. A folded convolution's weights have the name of its node only."""
    graph = onnx.load(str(path)).graph
    arrays = {each.name: torch.from_numpy(np.array(numpy_helper.to_array(each))) for each in graph.initializer}
    found = dict(arrays)
    for node in graph.node:
        if node.op_type == "Conv" and node.input[1] in arrays:
            # "/stage1/blocks.0/blocks.0.0/Conv" is layer stage1.blocks.0.0: each part repeats the one before it
            name = before = ""
            for part in node.name.strip("/").split("/")[:-1]:
                stem = name.removesuffix(before) if part.startswith(f"{before}.") else f"{name}."
                name, before = (stem + part).lstrip("."), part
            for kind, given in zip(("weight", "bias"), node.input[1:], strict=False):
                found[f"{name}.{kind}"] = arrays[given]
    return found
