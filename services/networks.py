"""What makes an image of a stack: the bundle's network by ONNX Runtime on one thread, or the one-step image.

IO binding was tried: 1.5 % of the run time at best, since inputs are read in place and the outputs' scaling makes new
arrays anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from models.bundle import Bundle, BundleError, read_network
from models.prereconstruction import Operator
from protocol.frames import DeltaFrame

WARM_UP_RUNS = 5
FEWEST_SIGMA = 2  # finite measurements without which there is nothing to reconstruct
INPUTS, OUTPUTS = ("stack", "context"), ("drop", "log_sigma", "classes")

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

    def run(self, frame: DeltaFrame) -> Pictures:
        drop, log_sigma, logits = self.session.run(
            OUTPUTS, {"stack": frame.stack[None], "context": frame.context[None]}
        )
        return _scaled(frame, drop[0, 0], log_sigma[0, 0], logits[0])

    def run_many(self, frames: Sequence[DeltaFrame]) -> list[Pictures]:
        """Run several frames at once: a third less time per frame; the last bits may differ."""
        stacks, contexts = np.stack([f.stack for f in frames]), np.stack([f.context for f in frames])
        drop, log_sigma, logits = self.session.run(OUTPUTS, {"stack": stacks, "context": contexts})
        return [_scaled(f, drop[n, 0], log_sigma[n, 0], logits[n]) for n, f in enumerate(frames)]


class OneStep:
    """The paper's one-step image, conditioned on the noise that the frames state."""

    def __init__(self, bundle: Bundle) -> None:
        self.pre, self.n = bundle.prereconstructor(), bundle.image_size
        self._operator: Operator | None = None
        self._sigma = b""

    def run(self, frame: DeltaFrame) -> Pictures:
        empty = np.zeros((0, 0), np.float32), np.zeros((0, 0, 0), np.float32)
        sigma = frame.sigma.astype(float)
        live = np.isfinite(sigma)
        if live.sum() < FEWEST_SIGMA:
            return np.zeros((self.n, self.n), np.float32), *empty
        if self._operator is None or sigma.tobytes() != self._sigma:
            self._operator = self.pre.condition(sigma, weights=live.astype(float))
            self._sigma = sigma.tobytes()
        return np.asarray(self._operator.one_step(frame.difference, self.n), np.float32), *empty


def _scaled(
    frame: DeltaFrame, drop: NDArray[np.float32], log_sigma: NDArray[np.float32], logits: NDArray[np.float32]
) -> Pictures:
    scale = np.float32(frame.scale)
    return drop * scale, np.exp(log_sigma) * scale, softmax(logits)


def softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over the first axis."""
    e = np.exp(logits - logits.max(axis=0))
    return np.asarray(e / e.sum(axis=0), np.float32)
