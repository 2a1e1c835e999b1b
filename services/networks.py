"""What makes an image: the bundle's network by ONNX Runtime on one thread, or the one-step image.

IO binding was tried: 1.5 % of the run time at best, since inputs are read in place and the outputs' scaling makes new
arrays anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from models.bundle import Bundle, BundleError, read_network
from models.prereconstruction import Operator
from protocol.frames import DeltaFrame
from services.estimation.images import FEWEST

WARM_UP_RUNS = 5
INPUTS, OUTPUTS = ("stack", "context"), ("drop", "log_sigma", "classes")


class Stack(NamedTuple):
    """What a network reads, as `models.prereconstruction.Operator.stack` makes it."""

    images: NDArray[np.float32]  # (C, h, w)
    context: NDArray[np.float32]  # (4,)
    scale: float  # S/m: what the network says times this is in S/m


Pictures = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Conductivity drop (H, W) and its sigma (H, W) or (0, 0) [S/m], class probabilities (5, h, w) or (0, 0, 0)."""


@lru_cache(maxsize=16)
def network(path: str) -> Network:
    """The network in a file, loaded once: skins of one kind share it, and are run in one batch."""
    return Network(path)


class Network:
    """A bundle's ONNX file."""

    def __init__(self, path: str) -> None:
        content = read_network(Path(path))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self.session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
            inputs = {i.name: [d if isinstance(d, int) else 1 for d in i.shape] for i in self.session.get_inputs()}
            for _ in range(WARM_UP_RUNS):
                self.session.run(OUTPUTS, {name: np.zeros(inputs[name], np.float32) for name in INPUTS})
        except Exception as why:  # ONNX Runtime has a dozen kinds of them, none of which it documents
            raise BundleError(
                f"{path} is no network that can be run ({str(why).splitlines()[0][:160]}): build the bundle again"
            ) from None
        self.stack = tuple(inputs["stack"][1:])

    def check(self, bundle: Bundle) -> None:
        """Raises BundleError where the bundle's matrices make another input than this network reads."""
        m = bundle.matrices
        made = (len(m.ladder), *m.inside.shape)
        if self.stack != made:
            raise BundleError(
                f"{bundle.path}: its network reads {list(self.stack)}, its matrices make {list(made)}: "
                "build the bundle again"
            )

    def run(self, stack: Stack) -> Pictures:
        return self.run_many((stack,))[0]

    def run_many(self, stacks: Sequence[Stack]) -> list[Pictures]:
        """Run those of several frames at once: a third less time per frame; the last bits may differ."""
        images, contexts = np.stack([each.images for each in stacks]), np.stack([each.context for each in stacks])
        drop, log_sigma, logits = self.session.run(OUTPUTS, {"stack": images, "context": contexts})
        units = [np.float32(each.scale) for each in stacks]
        return [(drop[n, 0] * unit, np.exp(log_sigma[n, 0]) * unit, softmax(logits[n])) for n, unit in enumerate(units)]


class OneStep:
    """The paper's one-step image, conditioned on the noise that the frames state."""

    def __init__(self, bundle: Bundle) -> None:
        self.pre, self.n = bundle.prereconstructor(), bundle.image_size
        self._operator: Operator | None = None
        self._sigma = b""

    def run(self, frame: DeltaFrame) -> Pictures:
        empty = nothing(self.n)
        sigma = frame.sigma.astype(float)
        live = np.isfinite(sigma)
        if live.sum() < FEWEST:
            return empty
        if self._operator is None or sigma.tobytes() != self._sigma:
            self._operator = self.pre.condition(sigma, weights=live.astype(float))
            self._sigma = sigma.tobytes()
        return np.asarray(self._operator.one_step(frame.difference, self.n), np.float32), *empty[1:]


def nothing(size: int) -> Pictures:
    """Of a frame in which too few measurements count."""
    return np.zeros((size, size), np.float32), np.zeros((0, 0), np.float32), np.zeros((0, 0, 0), np.float32)


def softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over the first axis."""
    e = np.exp(logits - logits.max(axis=0))
    return np.asarray(e / e.sum(axis=0), np.float32)
