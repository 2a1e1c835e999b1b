"""PyTorch -> ONNX: parity checked, batch axis free, an int8 variant calibrated on real stacks, run times measured."""

from __future__ import annotations

import contextlib
import copy
import io
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnxruntime import quantization
from torch import Tensor, nn

from models.network import CONTEXT, MMCNN
from models.prereconstruction import Array
from protocol.errors import EitskinError

OPSET = 17  # onnxruntime 1.20 and later read it
INPUTS, OUTPUTS = ("stack", "context"), ("drop", "log_sigma", "classes")
PARITY = 1e-4  # ONNX Runtime's sigmoid is wrong by up to 6e-8 whatever its value: gates that are all but closed let
# that much of activations of some hundreds through, which made 1.8e-5 and 4.2e-5 of an output
LOSS = 10.0  # times what PyTorch's own float32 loses against float64 on the same frames, where that is more than PARITY
# Not in int8. The first two read the widest features: converting those takes longer than int8 saves.
FLOAT = ("/stem/", "/down1/", "/stage2/attention", "/up2/", "/stage3/", "/classes/", "/up1/", "/out/", "/aside/")


class ParityError(EitskinError):
    """The exported network does not compute what PyTorch computes."""


def exported(model: nn.Module, example: tuple[Tensor, ...], inputs: Sequence[str], outputs: Sequence[str]) -> bytes:
    """ONNX of a network that takes and gives tensors by these names; the first axis of each is free."""
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")  # the TorchScript exporter announces its successor, which needs onnxscript
        path = Path(folder, "network.onnx")
        torch.onnx.export(
            model,
            example,
            path,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: {0: "frames"} for name in (*inputs, *outputs)},
            opset_version=OPSET,
            dynamo=False,
        )
        return path.read_bytes()


def to_onnx(model: MMCNN, stack: Array, context: Array) -> bytes:
    """ONNX of a network in eval mode, checked against PyTorch on (N, C, h, w), (N, n). Raises ParityError.

    The reference is PyTorch in float64: two float32 programs order their sums differently, and how much of that a
    network amplifies depends on its weights. An output may differ from it, relative to its largest magnitude, by
    PARITY, or by LOSS times what PyTorch in float32 differs by.
    """
    model = model.eval()
    example = (torch.zeros(1, *stack.shape[1:]), torch.zeros(1, CONTEXT))
    content = exported(model, example, INPUTS, OUTPUTS)
    onnx.checker.check_model(onnx.load_model_from_string(content))
    inputs = torch.from_numpy(stack), torch.from_numpy(context)
    with torch.no_grad():
        single = [t.numpy() for t in model(*inputs)]
        double = [t.numpy() for t in copy.deepcopy(model).double()(*(t.double() for t in inputs))]
    found = run(session(content), stack, context)
    for name, output, float32, expected in zip(OUTPUTS, found, single, double, strict=True):
        error, loss = _difference(output, expected), _difference(float32, expected)
        if not error <= max(PARITY, LOSS * loss):
            raise ParityError(
                f"output {name!r} of the ONNX file differs from PyTorch in float64 by {error:.1e}: allowed are "
                f"{PARITY:.0e}, or {LOSS:g} times what PyTorch in float32 differs by, {loss:.1e}"
            )
    return content


def _difference(found: Array, expected: Array) -> float:
    """Largest difference, relative to the largest magnitude expected."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def to_int8(content: bytes, stack: Array, context: Array) -> bytes:
    """The network with most of its encoder's convolutions in int8 (per channel, QDQ), calibrated on stacks (N, C, h, w)
    and contexts (N, n).

    The decoder and the outputs stay float32: their logits and log amplitudes are the result's own resolution, and so
    small a network gains nothing there, since what int8 saves goes into converting to and fro.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, prepared, target = (Path(folder, name) for name in ("float.onnx", "prepared.onnx", "int8.onnx"))
        source.write_bytes(content)
        quantization.quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        nodes = [n for n in onnx.load(str(prepared)).graph.node if n.op_type == "Conv"]
        keep = [n.name for n in nodes if n.name.startswith(FLOAT)]
        with contextlib.redirect_stdout(io.StringIO()):  # it prints how it counts
            quantization.quantize_static(
                str(prepared),
                str(target),
                _Calibration(stack, context),
                quant_format=quantization.QuantFormat.QDQ,
                op_types_to_quantize=["Conv"],
                nodes_to_exclude=keep,
                per_channel=True,
                reduce_range=True,  # AVX2 without VNNI saturates sums of full-range products
                activation_type=quantization.QuantType.QUInt8,
                weight_type=quantization.QuantType.QInt8,
                calibrate_method=quantization.CalibrationMethod.Percentile,
            )
        return target.read_bytes()


class _Calibration:
    """Batches of stacks and contexts, as onnxruntime's quantisation asks for them."""

    def __init__(self, stack: Array, context: Array, size: int = 16) -> None:
        self._feeds: Iterator[dict[str, Array]] = (
            {"stack": stack[k : k + size], "context": context[k : k + size]}
            for k in range(0, len(stack) // size * size, size)
        )

    def get_next(self) -> dict[str, Array] | None:
        return next(self._feeds, None)


def session(content: bytes | Path, threads: int = 1) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    source = content if isinstance(content, bytes) else str(content)
    return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])


def run(network: onnxruntime.InferenceSession, stack: Array, context: Array) -> list[Array]:
    found: list[Array] = network.run(list(OUTPUTS), {"stack": stack, "context": context})
    return found


def run_time_ms(content: bytes, stack: Array, context: Array, repeats: int = 400) -> dict[str, float]:
    """Milliseconds of one frame on one thread: median and the fastest tenth (the machine may be shared)."""
    network, times = session(content), []
    for k in range(repeats):
        at = k % len(stack)
        began = time.perf_counter()
        run(network, stack[at : at + 1], context[at : at + 1])
        times.append(1e3 * (time.perf_counter() - began))
    return {"median": float(np.median(times[20:])), "p10": float(np.percentile(times[20:], 10))}
