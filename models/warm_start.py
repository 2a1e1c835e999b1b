"""A shipped network as the start of further training.

A bundle has the network as ONNX, its batch normalisations folded into the convolutions. `restored` puts the weights
back: exactly, for inference. `normalised` gives each normalisation the statistics of its own convolution on real
batches, and the scale and offset that undo them, so that training goes on from the same function.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from models.network import MMCNN, NetworkConfig
from protocol.errors import EitskinError

BATCHES = 8  # that statistics are taken over


class NoSuchNetwork(EitskinError, ValueError):
    """An ONNX file that is not of this network; says what is missing."""


def restored(content: bytes, config: NetworkConfig) -> MMCNN:
    """The network of an ONNX file that models/export.py wrote, in eval mode. Raises NoSuchNetwork."""
    graph = onnx.load_model_from_string(content).graph
    stored = {i.name: torch.from_numpy(np.array(numpy_helper.to_array(i))) for i in graph.initializer}
    inputs = {n.name: list(n.input) for n in graph.node if n.op_type == "Conv"}
    model = MMCNN(config).eval()
    state = model.state_dict()
    for path, normal in _normalisations(model):
        found = inputs.get(_node(path))
        if found is None or len(found) < 3:
            raise NoSuchNetwork(f"the file has no convolution {_node(path)!r}: it is of another network than {config}")
        stored[f"{path}.0.weight"], stored[f"{path}.1.bias"] = stored[found[1]], stored[found[2]]
        stored[f"{path}.1.weight"] = torch.full_like(normal.weight.data, (1 + normal.eps) ** 0.5)
        stored[f"{path}.1.running_mean"] = torch.zeros_like(normal.bias.data)
        stored[f"{path}.1.running_var"] = torch.ones_like(normal.bias.data)
        stored[f"{path}.1.num_batches_tracked"] = torch.zeros((), dtype=torch.long)
    for name, value in state.items():
        shape = tuple(stored[name].shape) if name in stored else "nothing"
        if shape != tuple(value.shape):
            wanted = f"{tuple(value.shape)} in a network of {config}"
            raise NoSuchNetwork(f"weight {name!r} is {shape} in the file, {wanted}")
    model.load_state_dict({name: stored[name] for name in state})
    return model


def _normalisations(model: MMCNN) -> Iterator[tuple[str, nn.BatchNorm2d]]:
    """Those that follow a convolution, and the name of what both are in."""
    for path, module in model.named_modules():
        if isinstance(module, nn.Sequential) and len(module) > 1 and isinstance(module[1], nn.BatchNorm2d):
            yield path, module[1]


def _node(path: str) -> str:
    """The exporter's name of the convolution of the pair convolution and normalisation at `path`."""
    parent, _, last = path.rpartition(".blocks.")
    return f"/{parent}/blocks.{last}/blocks.{last}.0/Conv" if parent else f"/{path}/{path}.0/Conv"


@torch.no_grad()
def normalised(model: MMCNN, batches: list[tuple[Tensor, Tensor]]) -> None:
    """Statistics of every normalisation from (stack, context) batches; the function stays what it was."""
    seen: dict[nn.BatchNorm2d, list[tuple[Tensor, Tensor]]] = {}

    def keep(module: nn.Module, inputs: tuple[Tensor, ...], _: Tensor) -> None:
        assert isinstance(module, nn.BatchNorm2d)
        x = inputs[0]
        seen.setdefault(module, []).append((x.mean((0, 2, 3)), (x**2).mean((0, 2, 3))))

    normals = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    hooks = [m.register_forward_hook(keep) for m in normals]
    model.eval()
    for stack, context in batches:
        model.parts(stack, context)
    for hook in hooks:
        hook.remove()
    for normal in normals:
        mean, square = (torch.stack(part).mean(0) for part in zip(*seen[normal], strict=True))
        variance = (square - mean**2).clamp_min(1e-8)
        assert normal.running_mean is not None and normal.running_var is not None
        gain = normal.weight / torch.sqrt(normal.running_var + normal.eps)
        normal.bias.add_(gain * (mean - normal.running_mean))
        normal.weight.copy_(gain * torch.sqrt(variance + normal.eps))
        normal.running_mean.copy_(mean)
        normal.running_var.copy_(variance)
