"""PyTorch -> ONNX: parity checked, batch axis free, an int8 variant calibrated on real stacks, run times measured."""

from __future__ import annotations

import contextlib
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
PARITY = 1e-5
FLOAT = ("/stem/", "/stage2/attention", "/up2/", "/stage3/", "/classes/", "/up1/", "/out/", "/aside/")  # not in int8


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

    Parity is of each output relative to its largest magnitude: 1e-5.
    """
    model = model.eval()
    example = (torch.zeros(1, *stack.shape[1:]), torch.zeros(1, CONTEXT))
    content = exported(model, example, INPUTS, OUTPUTS)
    onnx.checker.check_model(onnx.load_model_from_string(content))
    with torch.no_grad():
        expected = [t.numpy() for t in model(torch.from_numpy(stack), torch.from_numpy(context))]
    for name, found, wanted in zip(OUTPUTS, run(session(content), stack, context), expected, strict=True):
        error = float(np.abs(found - wanted).max() / np.abs(wanted).max())
        if not error <= PARITY:
            raise ParityError(
                f"output {name!r} of the ONNX file differs from PyTorch by {error:.1e}, allowed {PARITY:.0e}"
            )
    return content


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
