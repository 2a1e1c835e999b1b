"""float32 against float64 stage by stage, ONNX Runtime against PyTorch, int8 against float32."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import scipy.sparse as sparse

from bench.accuracy.methods import session
from bench.stability.run import METRES, NOISE_FREE, InProcessStages, Row, Setting, mean_iou, noisy, share, summary
from models import metrics
from models.prereconstruction import Array, Drift, PreReconstructor
from models.shapes import Shape
from services.contacts.images.segmentation import segment

USUAL_DB = 70.0
FLOATS: tuple[type[np.floating], ...] = (np.float64, np.float32)
PARITY_MM = 0.05  # what ONNX Runtime and PyTorch may differ by in position
OUTPUTS = ["drop", "log_sigma", "classes"]


def stages(setting: Setting) -> Iterator[Row]:
    """Each stage in float32 where the others are in float64: error of its own output, and of the noise it adds to."""
    scenes, rng, pre = setting.scenes(), setting.rng("precision"), setting.bundle.prereconstructor()
    relative = share(USUAL_DB)
    yield {"case": "forward model's solve", **_forward(setting)}
    z, z0 = scenes[1].z, scenes[1].z0
    d = z / z0 - 1
    wire = np.abs(z.astype(np.complex64).astype(complex)) / z0 - 1
    yield {"case": "Z on the wire (float32)", **_errors(wire, d), "of_noise": _rms(wire - d) / relative}
    small: Array = np.divide(z.astype(np.float32) - z0.astype(np.float32), z0.astype(np.float32))
    yield {"case": "difference", **_errors(small, d), "of_noise": _rms(small - d) / relative}
    frames = noisy(z0, relative, rng, 64)
    mean = frames.astype(np.float32).mean(axis=0, dtype=np.float32)
    off = mean / frames.mean(axis=0) - 1
    yield {"case": "tare: mean of 64", **_errors(mean, frames.mean(axis=0)), "of_noise": _rms(off) / relative * 8}
    spread = frames.astype(np.float32).var(axis=0, ddof=1, dtype=np.float32)
    yield {"case": "tare: variance of 64", **_errors(spread, frames.var(axis=0, ddof=1))}
    for name, drift in (("no drift", Drift()), ("long drift", Drift(2.6e-2, 0.26))):
        for decibel in (USUAL_DB, np.inf):
            noise = "noise-free" if np.isinf(decibel) else f"{decibel:g} dB"
            yield {"case": f"eigen-decomposition, {noise}, {name}", **_operator(pre, share(decibel), drift, d)}
    operator = pre.condition(np.full(pre.measurements, relative), drift=Drift(5e-5, 2e-4))
    exact = (operator.gains * (operator.whiten @ d)) @ operator.back.T.astype(float)
    yield {"case": "stack", **_errors(operator.images(d[None])[0], exact)}
    image = 0.3 * np.asarray(scenes[1].touch.fraction(96))
    yield {"case": "segmentation", "moved_mm": _apart(image.astype(np.float32), image), "error": 0.0}


def networks(setting: Setting) -> Iterator[Row]:
    """The network: PyTorch in float32 and float64 against ONNX Runtime, and the other network files against "full"."""
    bundle = setting.bundle
    full = bundle.network_path("full")
    if full is None:
        yield {"case": "no network in this bundle", "broken": {}}
        return
    feeds = _feeds(setting)
    yours = _run(full, feeds)
    try:
        import torch

        from bench.stability.graph import Graph

        for name, dtype in (("float32", torch.float32), ("float64", torch.float64)):
            graph = Graph(full, dtype)
            theirs = [[graph.run(feed)[o] for o in OUTPUTS] for feed, _, _ in feeds]
            yield {"case": f"PyTorch {name} against ONNX Runtime", **_compared(yours, theirs, feeds, PARITY_MM)}
    except ImportError as missing:
        yield {"case": f"PyTorch against ONNX Runtime: not measured ({missing})", "broken": {}}
    for variant in ("int8", "fast"):
        path = bundle.network_path(variant)
        if path is not None:
            yield {"case": f"{variant} against full", **_compared(yours, _run(path, feeds), feeds, None)}
    for variant in ("full", "int8", "fast"):
        if bundle.network_path(variant) is not None:
            yield {"case": f"{variant} against the truth, {USUAL_DB:g} dB", **_truth(setting, variant)}


Feed = tuple[dict[str, Array], float, Shape]


def _feeds(setting: Setting) -> list[Feed]:
    """Inputs of the network, the scale of its output, and the touch, at the usual noise and without any."""
    pre, rng, feeds = setting.bundle.prereconstructor(), setting.rng("network"), []
    for relative in (NOISE_FREE, share(USUAL_DB)):
        operator = pre.condition(np.full(pre.measurements, relative), drift=Drift(5e-5, 2e-4))
        for scene in setting.scenes():
            d = pre.difference(noisy(scene.z, relative, rng), scene.z0)
            stack, context, scale = operator.stack(d)
            feeds.append(({"stack": stack[None], "context": context[None]}, scale, scene.touch))
    return feeds


def _run(path: Path, feeds: list[Feed]) -> list[list[Array]]:
    network = session(path)
    return [network.run(OUTPUTS, feed) for feed, _, _ in feeds]


def _compared(ours: list[list[Array]], theirs: list[list[Array]], feeds: list[Feed], most_mm: float | None) -> Row:
    """Largest difference of each output over its largest magnitude; what it moves a contact by, and its force."""
    row: Row = {"frames": len(feeds)}
    for k, name in enumerate(OUTPUTS):
        row[f"{name}_error"] = max(
            float(np.abs(b[k] - a[k]).max() / np.abs(a[k]).max()) for a, b in zip(ours, theirs, strict=True)
        )
    images = [
        (a[0][0, 0].astype(float) * scale, b[0][0, 0].astype(float) * scale)
        for a, b, (_, scale, _) in zip(ours, theirs, feeds, strict=True)
    ]
    moved = [_apart(b, a) for a, b in images]
    row["error"] = row["drop_error"]
    row["moved_mm"] = max(moved)
    row["force_changed_N"] = 10 * max(abs(float(b.max() - a.max())) for a, b in images)
    row["mean_iou_change"] = float(
        np.mean([mean_iou(b, t) - mean_iou(a, t) for (a, b), (_, _, t) in zip(images, feeds, strict=True)])
    )
    too_far = most_mm is not None and not row["moved_mm"] < most_mm
    row["broken"] = {f"contacts differ by {row['moved_mm']:.2f} mm": 1} if too_far else {}
    return row


def _truth(setting: Setting, variant: str) -> Row:
    runner, rng, relative = InProcessStages(setting.bundle, variant), setting.rng("variants"), share(USUAL_DB)
    answers = []
    for scene in setting.scenes():
        baseline = runner.tare(scene.z0, relative, rng)
        for _ in range(1 if setting.quick else 20):
            answers.append((runner.once(baseline, noisy(scene.z, relative, rng)), scene.touch))
    return summary(answers)


def _forward(setting: Setting) -> Row:
    """Error of the difference signal where the factorisation is done in float32."""
    model = setting.model()
    signals = []
    for dtype in (np.float64, np.float32):
        z = []
        for shapes in ([], [setting.scenes()[1].touch]):
            matrix = sparse.csc_matrix(model.matrix(model.touched(shapes)), dtype=dtype)
            fields = model.factorise(matrix).solve(model.currents.astype(dtype))
            n = model.skin.n_electrodes
            transfer = np.zeros((n, n))
            transfer[:-1, :-1] = fields[model._position][model.n_nodes :]
            drive_plus, drive_minus, plus, minus = model.pattern.T
            z.append(
                np.abs(
                    transfer[plus, drive_plus]
                    - transfer[plus, drive_minus]
                    - transfer[minus, drive_plus]
                    + transfer[minus, drive_minus]
                )
            )
        signals.append(z[1] / z[0] - 1)
    return {**_errors(signals[1], signals[0]), "of_noise": _rms(signals[1] - signals[0]) / share(USUAL_DB)}


def _operator(pre: PreReconstructor, relative: float, drift: Drift, d: Array) -> Row:
    """Images of an operator whose Cholesky factor and eigenvectors were found in float32, against float64's."""
    m, sigma = pre.m, np.full(pre.measurements, relative)
    noise = sigma**2 * (1 + 1 / 64) + m.model_error**2
    covariance = np.diag(noise) + drift.scale**2 + drift.contact**2 * m.contact @ m.contact.T
    images = []
    for dtype in FLOATS:
        try:
            inverse = np.linalg.inv(np.linalg.cholesky(covariance.astype(dtype)))
        except np.linalg.LinAlgError:
            return {"error": float("inf"), "note": "not positive definite in float32", "broken": {}}
        gram = inverse @ m.gram.astype(dtype) @ inverse.T
        values, vectors = np.linalg.eigh((gram + gram.T) / 2)
        mean = dtype(np.trace(m.gram) / len(noise) / noise.mean())
        back = m.back.astype(dtype) @ inverse.T @ vectors
        white = vectors.T @ (inverse @ d.astype(dtype))
        gains = [1 / (np.maximum(values, 0) + dtype(rung) * mean) for rung in m.ladder]
        images.append(np.array([(back * gain) @ white for gain in gains], dtype=float))
    worst = [float(np.abs(b - a).max() / np.abs(a).max()) for a, b in zip(*images, strict=True)]
    return {"error": max(worst), "error_scale_rung": worst[m.scale_index], "broken": {}}


def _apart(a: Array, b: Array) -> float:
    """Millimetres between the strongest touches of two images (n, n) of the whole skin."""
    nothing = np.zeros((0, 0))
    p, q = (segment(image, nothing) for image in (a, b))
    if not p or not q:
        return float("inf") if bool(p) != bool(q) else 0.0
    pixel = metrics.SIDE * METRES / len(a)
    return 1e3 * pixel * float(np.hypot(p[0].x - q[0].x, p[0].y - q[0].y))


def _errors(found: Array, exact: Array) -> Row:
    return {"error": float(np.abs(found - exact).max() / np.abs(exact).max()), "broken": {}}


def _rms(v: Array) -> float:
    return float(np.sqrt(np.mean(np.asarray(v, float) ** 2)))


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "float32 against float64, by stage": stages,
    "network: runtimes and files": networks,
}
