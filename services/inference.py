"""Inference: from the pre-reconstruction stack to the image of the conductivity drop, by the bundle's network.

ONNX Runtime on one thread, warmed up before the stage is ready. A bundle without a network gives the one-step image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from models.bundle import Bundle
from models.prereconstruction import Operator
from protocol.frames import DeltaFrame, Frame, ImageFrame
from services.config import Skin
from services.quality import REFUSED, Residual
from services.sentinel import CoarseImage
from services.stage import Health, Refused, Stage, add_reason, inherited

WARM_UP_RUNS = 5
FEWEST_SIGMA = 2  # finite measurements without which there is nothing to reconstruct


class Inference(Stage):
    """delta -> image [S/m], on the bundle's grid."""

    reads = "delta"
    writes = ("image",)
    stamp = "infer"

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config, self.bundle = skin, bundle
        path = None if skin.network == "none" else bundle.network_path(skin.network) or bundle.network_path("full")
        self._network = Network(str(path)) if path else OneStep(bundle)
        # Only a network's image is meant to explain a frame: a one-step image shows where, not how much.
        self._refuses = isinstance(self._network, Network)
        self._residual = Residual(bundle, to_scale=self._refuses)
        n = bundle.image_size
        self._metres_per_pixel = bundle.metres_per_pixel
        self._coarse = CoarseImage(bundle) if skin.scan == "adaptive" else None
        self._origin = [-0.5 * n * bundle.metres_per_pixel] * 2
        self.reset()

    def reset(self) -> None:
        self._last: ImageFrame | None = None  # of the touch that is being held
        self._last_scan = 0  # of the frame that it was reconstructed from
        self._unseen: DeltaFrame | None = None  # last reconstruction that nobody wanted
        self._counters = {"networks_run": 0, "held": 0, "untouched": 0, "unwanted": 0, "missed": 0, "refused": 0}

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, DeltaFrame)
        if "image" not in wanted:
            self._counters["unwanted"] += 1
            self._unseen = frame if frame.stack.size else self._unseen
            return []
        out = ImageFrame(**inherited(frame), touched=frame.touched)
        out.metres_per_pixel, out.origin = self._metres_per_pixel, self._origin
        if frame.stack.size:
            self._run(frame, out)
        elif frame.held and self._unseen is not None and self._unseen.scan == frame.reconstructed:
            self._run(self._unseen, out)
        elif frame.held:
            self._hold(frame, out)
        elif frame.touched and "coarse" in frame.reasons:
            self._roughly(frame, out)
        else:
            self._counters["untouched"] += 1
            self._last = None
        return [out]

    def _run(self, frame: DeltaFrame, out: ImageFrame) -> None:
        out.image, out.sigma, out.classes = self._network.run(frame)
        out.noise = _rms(frame.sigma)
        out.residual = self._residual(frame.difference, frame.sigma, out.image)
        self._judge(out)
        self._counters["networks_run"] += 1
        self._last, self._unseen = out, None
        self._last_scan = frame.scan

    def _roughly(self, frame: DeltaFrame, out: ImageFrame) -> None:
        """The image of a few measurements, which no network was trained on."""
        self._coarse = self._coarse or CoarseImage(self.bundle)
        out.image, out.sigma, out.classes = self._coarse.run(frame)
        self._last, self._unseen = out, None
        self._last_scan = frame.scan

    def _judge(self, out: ImageFrame) -> None:
        """An image that does not explain the measurements is of no touch."""
        if self._refuses and out.touched and out.residual is not None and out.residual > REFUSED:
            out.valid = False
            add_reason(out.reasons, "out_of_distribution")
            self._counters["refused"] += 1

    def _hold(self, frame: DeltaFrame, out: ImageFrame) -> None:
        """The image of the frame last reconstructed, if we have seen that one."""
        last = self._last
        if last is not None and self._last_scan == frame.reconstructed:
            out.held = True
            out.image, out.sigma, out.classes, out.noise = last.image, last.sigma, last.classes, last.noise
            out.residual = last.residual
            self._judge(out)
            self._counters["held"] += 1
        else:  # skipped, or before we started: not valid until the next reconstruction, at most 16 frames on
            out.valid = False
            out.reasons.append("gap")
            self._counters["missed"] += 1

    def state(self) -> dict[str, Any]:
        last = self._last
        if last is None:
            return {"last": None}
        kept = {"image": last.image, "sigma": last.sigma, "classes": last.classes, "noise": last.noise}
        kept["residual"] = last.residual
        return {"last": {"scan": self._last_scan, **kept}}

    def load(self, state: dict[str, Any]) -> None:
        self.reset()
        last = state.get("last")
        if last is None:
            return
        try:
            self._last = ImageFrame(skin=self.skin, image=last["image"], sigma=last["sigma"], classes=last["classes"])
            self._last.noise, self._last_scan = last.get("noise"), int(last["scan"])
            self._last.residual = last.get("residual")
        except (KeyError, TypeError) as wrong:
            raise Refused(f"no image in the saved state ({wrong})") from None

    def health(self) -> Health:
        if isinstance(self._network, OneStep):
            return Health("OK", [f"bundle {self.bundle.name} has no network: one-step images"], dict(self._counters))
        return Health("OK", [], dict(self._counters))


class Network:
    """The bundle's ONNX file. Output: drop (H, W) and its sigma [S/m], class probabilities (5, h, w)."""

    def __init__(self, path: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs = {i.name: [d if isinstance(d, int) else 1 for d in i.shape] for i in self.session.get_inputs()}
        for _ in range(WARM_UP_RUNS):
            self.session.run(None, {name: np.zeros(shape, np.float32) for name, shape in inputs.items()})

    def run(self, frame: DeltaFrame) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        drop, log_sigma, logits = self.session.run(
            ["drop", "log_sigma", "classes"], {"stack": frame.stack[None], "context": frame.context[None]}
        )
        scale = np.float32(frame.scale)
        return drop[0, 0] * scale, np.exp(log_sigma[0, 0]) * scale, softmax(logits[0])


class OneStep:
    """The paper's one-step image, conditioned on the noise that the frames state."""

    def __init__(self, bundle: Bundle) -> None:
        self.pre, self.n = bundle.prereconstructor(), bundle.image_size
        self._operator: Operator | None = None
        self._sigma = b""

    def run(self, frame: DeltaFrame) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        empty = np.zeros((0, 0), np.float32), np.zeros((0, 0, 0), np.float32)
        sigma = frame.sigma.astype(float)
        live = np.isfinite(sigma)
        if live.sum() < FEWEST_SIGMA:
            return np.zeros((self.n, self.n), np.float32), *empty
        if self._operator is None or sigma.tobytes() != self._sigma:
            self._operator = self.pre.condition(sigma, weights=live.astype(float))
            self._sigma = sigma.tobytes()
        return np.asarray(self._operator.one_step(frame.difference, self.n), np.float32), *empty


def _rms(sigma: NDArray[np.float32]) -> float | None:
    """Of what is finite; None where nothing is."""
    finite = sigma[np.isfinite(sigma)].astype(float)
    return float(np.sqrt((finite**2).mean())) if finite.size else None


def softmax(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over the first axis."""
    e = np.exp(logits - logits.max(axis=0))
    return np.asarray(e / e.sum(axis=0), np.float32)


if __name__ == "__main__":
    import sys

    from services.process import main, stages

    sys.exit(main("inference", stages(Inference)))
