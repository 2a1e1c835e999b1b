"""The paper's MM-CNN, to stand beside ours in the benchmark; and the same network without attention.

    python -m models.published --minutes 11                 writes bench/published/mmcnn.onnx
    python -m models.published --minutes 11 --no-attention  writes bench/published/cnn.onnx

As published: three 3x3 convolutions (stride 1), each with batch norm, ReLU and 2x2 max pooling; CBAM; four 3x3
transposed convolutions with 2x2 upsampling, batch norm, ReLU; MSE + MAE jointly; batch 64; Adam. Input is I_thresh of
equations 1 to 5, on 48 x 48 (so that three poolings and four upsamplings end at 96 x 96). Chosen here, because not
stated there: filters 16, 32, 64 down and 64, 32, 16, 8 up, a last 1x1 convolution to the drop, t. Changed, because of
the time a CPU has: Adam at 1e-3 falling to zero instead of 1e-5 for 300 epochs. Training sees our scenes and our
noise, 50 to 100 dB, which the network is not told: neither is the published one.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models import command, data, geometry, samples
from models.augmentation import Condition, condition
from models.export import exported
from models.network import CBAM, laid_out
from models.prereconstruction import THRESHOLD_T, Array, Drift, Operator, PreReconstructor
from models.symmetries import Symmetry, symmetries
from protocol.whole_file import write_whole

IN, OUT = 48, 96
FOLDER = Path(__file__).parents[1] / "bench" / "published"
DOWN, UP = (16, 32, 64), (64, 32, 16, 8)
RATE = 1e-3


class PublishedMMCNN(nn.Module):
    """I_thresh (N, 1, 48, 48) [S/m] -> drop (N, 1, 96, 96) [S/m]."""

    def __init__(self, attention: bool = True) -> None:
        super().__init__()
        down: list[nn.Module] = []
        for inputs, outputs in zip((1, *DOWN), DOWN, strict=False):
            down += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU(), nn.MaxPool2d(2)]
        up: list[nn.Module] = []
        for inputs, outputs in zip((DOWN[-1], *UP), UP, strict=False):
            up += [nn.Upsample(scale_factor=2), nn.ConvTranspose2d(inputs, outputs, 3, padding=1)]
            up += [nn.BatchNorm2d(outputs), nn.ReLU()]
        self.encoder = nn.Sequential(*down)
        self.attention = CBAM(DOWN[-1]) if attention else nn.Identity()
        self.decoder = nn.Sequential(*up, nn.Conv2d(UP[-1], 1, 1))

    def forward(self, image: Tensor) -> Tensor:
        drop: Tensor = self.decoder(self.attention(self.encoder(image)))
        return drop


def inputs(operator: Operator, d: Array) -> Array:
    """I_thresh (N, 1, 48, 48) float32 of differences (N, K)."""
    return np.stack([operator.one_step(row, IN, THRESHOLD_T) for row in d])[:, None]


def train(
    pre: PreReconstructor,
    skin: geometry.SkinGeometry,
    scenes: samples.Samples,
    minutes: float,
    attention: bool,
    seed: int = 0,
) -> tuple[PublishedMMCNN, dict[str, float]]:
    """Trains for so many minutes; prints the loss now and then. Also how far it came, for the file."""
    torch.manual_seed(seed)
    rng, turns = np.random.default_rng(seed), symmetries(skin.to_dict(), skin.pattern)
    bank = [_condition(pre, rng) for _ in range(32)]
    model = laid_out(PublishedMMCNN(attention), torch.channels_last)
    optimizer = torch.optim.Adam(model.parameters(), RATE)
    began, step, mean = time.perf_counter(), 0, 0.0
    while (done := (time.perf_counter() - began) / (60 * minutes)) < 1:
        image, truth = _batch(scenes, bank[step % len(bank)], rng, turns)
        for group in optimizer.param_groups:
            group["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * done))
        found = model(image)
        loss = F.mse_loss(found, truth) + F.l1_loss(found, truth)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        step, mean = step + 1, 0.98 * mean + 0.02 * float(loss.detach())
        if step % 200 == 0:
            print(f"{60 * minutes * done:.0f} s, step {step}: {mean / (1 - 0.98**step):.5f}", flush=True)
    said = {"minutes": minutes, "batches": step, "scenes": len(scenes), "loss": round(mean / (1 - 0.98**step), 6)}
    return laid_out(model.eval(), torch.contiguous_format), said


def _condition(pre: PreReconstructor, rng: np.random.Generator) -> Condition:
    return condition(pre, rng, np.full(pre.measurements, 10 ** (-rng.uniform(50, 100) / 20)), Drift())


def _batch(
    scenes: samples.Samples, spoiled: Condition, rng: np.random.Generator, turns: list[Symmetry]
) -> tuple[Tensor, Tensor]:
    index = rng.integers(len(scenes), size=64)
    turned = [turns[k] for k in rng.integers(len(turns), size=64)]
    d = np.stack([scenes.d[i][t.measurements] for i, t in zip(index, turned, strict=True)])
    truth = np.stack([t.turn.image(scenes.drop[i]) for i, t in zip(index, turned, strict=True)]).astype(np.float32)
    image = torch.from_numpy(inputs(spoiled.operator, spoiled.spoil(d, rng)))
    return image.to(memory_format=torch.channels_last), torch.from_numpy(truth)[:, None]


def to_onnx(model: PublishedMMCNN, said: dict[str, float]) -> bytes:
    """said: how far training came; the benchmark's table names it beside the figures."""
    content = onnx.load_model_from_string(exported(model, (torch.zeros(1, 1, IN, IN),), ["image"], ["drop"]))
    onnx.helper.set_model_props(content, {"training": json.dumps(said)})
    return bytes(content.SerializeToString())


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.published", description="Train the paper's network.")
    parser.add_argument("--skin", default="square16")
    parser.add_argument("--minutes", type=command.minutes, default=11.0)
    parser.add_argument("--no-attention", action="store_true")
    parser.add_argument("--limit", type=int)
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    skin = geometry.load(args.skin)
    pre = command.bundle_of(skin, skin.name).prereconstructor()
    data.check_skin(data.WORK / skin.name, skin)
    scenes = samples.load(data.WORK / skin.name, "train", pre, args.limit)
    model, said = train(pre, skin, scenes, args.minutes, not args.no_attention)
    FOLDER.mkdir(parents=True, exist_ok=True)
    target = FOLDER / ("cnn.onnx" if args.no_attention else "mmcnn.onnx")
    write_whole(target, to_onnx(model, said))
    print(f"{target}: {target.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    command.run("models.published", main)
