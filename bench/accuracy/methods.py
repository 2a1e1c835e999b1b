"""The rows of the accuracy benchmark: every method as a function of one frame, with its tuning parameters."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime

from bench import ROOT
from bench.accuracy import peers as _peers
from models import baselines
from models.bundle import Bundle
from models.forward import ForwardModel
from models.prereconstruction import THRESHOLD_T, Operator, noise_of_frames
from models.shapes import Array
from services.runtime.config import Skin

PUBLISHED = ROOT / "bench" / "published"
N = 48  # pixels a side of the classical images


@dataclass(frozen=True, eq=False)
class Tare:
    """What a method knows before the frames: untouched |Z| (64, 120) and the means of both patterns."""

    untouched: Array
    pairs0: Array
    adjacent0: Array

    @property
    def sigma(self) -> Array:
        """(120,) relative noise of a frame, as found at tare; never quite zero, which no method could weigh by."""
        return np.maximum(noise_of_frames(self.untouched, self.pairs0) / self.pairs0, 1e-7)


Image = Callable[[Array], Array]  # |Z| (K,) -> drop (n, n)


@dataclass(frozen=True)
class Method:
    """`build(tare, value)` prepares for a noise level; `values` are the hyperparameters to choose from.

    gain: scaled so that the touch in the centre, noise-free, has its true drop (what a linear method's amplitude means
    depends on its regularisation). slow: run on a part of the frames.
    """

    name: str
    build: Callable[[Tare, float | None], Image]
    values: tuple[float, ...] = ()
    pattern: str = "pairs"
    gain: bool = True
    slow: bool = False


def _linear(
    name: str,
    make: Callable[[float | None], Callable[[Array], Array]],
    values: tuple[float, ...] = (),
    pattern: str = "pairs",
    slow: bool = False,
) -> Method:
    """Of relative differences. What `make` makes of a hyperparameter is made once."""
    made = cache(make)

    def build(tare: Tare, value: float | None) -> Image:
        method, z0 = made(value), tare.pairs0 if pattern == "pairs" else tare.adjacent0
        return lambda z: method(z / z0 - 1)

    return Method(name, build, values, pattern, slow=slow)


def classical() -> list[Method]:
    """The baselines of models/baselines.py, each also with its hyperparameter tuned to the noise."""
    physics = baselines.PeerPhysics(ForwardModel("square16", mesh="inverse"))
    return [
        _linear("NOSER, lambda 0.15 (published)", lambda v: baselines.noser(physics, n=N)),
        _linear(
            "NOSER, best lambda",
            lambda v: baselines.noser(physics, v or 0.01, n=N, units="relative"),
            (1e-3, 3e-3, 0.01, 0.03, 0.1),
        ),
        _linear(
            "total variation",
            lambda v: baselines.TotalVariation(physics, v or 1e-6),
            (1e-8, 1e-7, 1e-6, 4e-6, 2e-5),
            slow=True,
        ),
        _linear(
            "Gauss-Newton, 3 steps",
            lambda v: baselines.GaussNewton(physics, v or 0.01, n=N, steps=3),
            (1e-3, 3e-3, 0.01, 0.03, 0.1),
            slow=True,
        ),
        _linear("GREIT", lambda v: baselines.greit(physics, n=N, noise_figure=v or 1.0), (0.5, 1.0, 2.0, 4.0)),
    ]


def peers() -> list[Method]:
    """pyEIT's three, on the adjacent pattern's frames; none where it is not installed."""
    if not _peers.installed():
        return []

    def row(label: str, method: str, values: tuple[float, ...] = ()) -> Method:
        return _linear(f"{_peers.name()} {label}", lambda v: _peers.PyEIT(method, v, N), values, "adjacent")

    return [row("JAC", "jac", (1e-3, 0.01, 0.1, 1.0)), row("GREIT", "greit", (1e-3, 0.01, 0.1)), row("BP", "bp")]


def session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def training(network: onnxruntime.InferenceSession) -> str:
    """How long a published network's file was trained, in words: ours has had hours."""
    said = network.get_modelmeta().custom_metadata_map.get("training")
    return f"{json.loads(said)['minutes']:g} min" if said else "training time not recorded"


def _by_network(name: str, bundle: Bundle, image: Callable[[Operator, np.ndarray], Array]) -> Method:
    """image: of the difference that the bundle makes, by the operator for its noise."""

    def build(tare: Tare, value: float | None) -> Image:
        pre = bundle.prereconstructor()
        operator = pre.condition(tare.sigma)
        return lambda z: image(operator, pre.difference(z, tare.pairs0))

    return Method(name, build, gain=False)


def published(bundle: Bundle) -> list[Method]:
    """The paper's network and its twin without attention, where models/published.py has trained them."""

    def row(name: str, path: Path) -> Method:
        network = session(path)

        def image(operator: Operator, difference: np.ndarray) -> Array:
            step = operator.one_step(difference, N, THRESHOLD_T)
            found = network.run(None, {"image": step[None, None].astype(np.float32)})[0]
            return np.asarray(found[0, 0], float)

        return _by_network(f"{name}, {training(network)}", bundle, image)

    files = {"MM-CNN as published": "mmcnn.onnx", "the same without attention": "cnn.onnx"}
    return [row(name, PUBLISHED / file) for name, file in files.items() if (PUBLISHED / file).exists()]


def network_alone(bundle: Bundle) -> list[Method]:
    """The image of the network that runs by default, without the stages that make contacts of it."""
    path = bundle.network_path(Skin.model_fields["network"].default)
    if path is None:
        return []
    network = session(path)

    def image(operator: Operator, difference: np.ndarray) -> Array:
        stack, context, scale = operator.stack(difference)
        drop = network.run(["drop"], {"stack": stack[None], "context": context[None]})[0]
        return np.asarray(drop[0, 0] * scale)

    return [_by_network("eitskin, its network alone", bundle, image)]
