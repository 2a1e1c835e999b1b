"""An ONNX network evaluated by PyTorch, node by node, in any precision: a second opinion on ONNX Runtime.

It reads the very file that is shipped, so no checkpoint is needed. Only the operators that our exports use are there;
another one raises NotImplementedError by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import numpy_helper
from torch import Tensor

from models.prereconstruction import Array


class Graph:
    """dtype: torch.float32 or torch.float64, of all that is not an index."""

    def __init__(self, path: Path, dtype: torch.dtype) -> None:
        model = onnx.load(str(path))
        self.nodes, self.dtype = model.graph.node, dtype
        self.outputs = [o.name for o in model.graph.output]
        self.constants = {i.name: self._tensor(numpy_helper.to_array(i)) for i in model.graph.initializer}

    def _tensor(self, array: Array) -> Tensor:
        tensor = torch.from_numpy(np.array(array))
        return tensor.to(self.dtype) if tensor.is_floating_point() else tensor

    def run(self, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Named outputs for named inputs."""
        known: dict[str, Tensor] = self.constants | {k: self._tensor(v) for k, v in inputs.items()}
        with torch.no_grad():
            for node in self.nodes:
                attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
                values = [known[name] if name else None for name in node.input]
                made = self._apply(node.op_type, values, attributes, len(node.output))
                known.update(zip(node.output, made, strict=True))
        return {name: known[name].numpy() for name in self.outputs}

    def _apply(self, kind: str, x: list[Any], a: dict[str, Any], outputs: int) -> tuple[Tensor, ...]:
        if kind == "Constant":
            return (self._tensor(numpy_helper.to_array(a["value"])),)
        if kind == "Split":
            return tuple(torch.split(x[0], x[1].tolist(), a["axis"]))
        if kind not in OPERATORS:
            raise NotImplementedError(f"operator {kind}: add it to bench/stability/graph.py")
        assert outputs == 1
        return (OPERATORS[kind](x, a),)


def _conv(x: list[Any], a: dict[str, Any]) -> Tensor:
    top, left, bottom, right = a["pads"]
    padded = F.pad(x[0], (left, right, top, bottom))
    bias = x[2] if len(x) > 2 else None
    return F.conv2d(padded, x[1], bias, stride=a["strides"], dilation=a["dilations"], groups=a["group"])


def _gemm(x: list[Any], a: dict[str, Any]) -> Tensor:
    left = x[0].T if a.get("transA") else x[0]
    right = x[1].T if a.get("transB") else x[1]
    product: Tensor = a.get("alpha", 1.0) * left @ right + a.get("beta", 1.0) * x[2]
    return product


def _slice(x: list[Any], a: dict[str, Any]) -> Tensor:
    axes = x[3].tolist() if len(x) > 3 else range(x[0].ndim)
    at = [slice(None)] * x[0].ndim
    for axis, start, end in zip(axes, x[1].tolist(), x[2].tolist(), strict=True):
        at[axis] = slice(start, end)
    part: Tensor = x[0][tuple(at)]
    return part


def _unsqueeze(x: list[Any], a: dict[str, Any]) -> Tensor:
    found: Tensor = x[0]
    for axis in sorted(x[1].tolist()):
        found = found.unsqueeze(axis)
    return found


def _divide(x: list[Any], a: dict[str, Any]) -> Tensor:
    return torch.div(x[0], x[1], rounding_mode=None if x[0].is_floating_point() else "trunc")


def _resize(x: list[Any], a: dict[str, Any]) -> Tensor:
    if a["mode"] != b"linear" or a["coordinate_transformation_mode"] != b"half_pixel":
        raise NotImplementedError(f"Resize {a['mode']!r}: add it to bench/stability/graph.py")
    scale = [float(s) for s in x[2][2:]]
    return F.interpolate(x[0], scale_factor=scale, mode="bilinear", align_corners=False)


OPERATORS: dict[str, Callable[[list[Any], dict[str, Any]], Tensor]] = {
    "Add": lambda x, a: x[0] + x[1],
    "Mul": lambda x, a: x[0] * x[1],
    "Div": _divide,
    "Relu": lambda x, a: F.relu(x[0]),
    "Sigmoid": lambda x, a: torch.sigmoid(x[0]),
    "Exp": lambda x, a: torch.exp(x[0]),
    "Clip": lambda x, a: torch.clamp(x[0], x[1], x[2]),
    "Conv": _conv,
    "Gemm": _gemm,
    "Slice": _slice,
    "Unsqueeze": _unsqueeze,
    "Shape": lambda x, a: torch.tensor(x[0].shape),
    "Gather": lambda x, a: torch.index_select(x[0], a.get("axis", 0), x[1].reshape(-1)).reshape(x[1].shape),
    "Concat": lambda x, a: torch.cat(x, a["axis"]),
    "ReduceMean": lambda x, a: x[0].mean(tuple(a["axes"]), keepdim=bool(a["keepdims"])),
    "ReduceMax": lambda x, a: x[0].amax(tuple(a["axes"]), keepdim=bool(a["keepdims"])),
    "DepthToSpace": lambda x, a: F.pixel_shuffle(x[0], a["blocksize"]),
    "Resize": _resize,
}
