"""The shipped MM-CNN: a small U-Net with CBAM over the pre-reconstruction stack, told the noise it faces.

Inputs are what `prereconstruction.Operator.stack` gives: the stack (N, C, 24, 24), divided by the frame's scale, and its context (N, n).
Outputs: drop (N, 1, 96, 96) in units of that scale, log_sigma (N, 1, 96, 96) of the same, classes (N, 5, 24, 24) logits.

What differs from the published network (published.py): pooling stops at a quarter of the pixels and the image comes out of one
pixel shuffle, so that nearly all arithmetic is on 24 x 24 and fewer; the drop is amplitude times mask, because a touch is a patch of
nearly one drop with a sharp edge; the context sets a gain and an offset of each block's channels (FiLM).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CONTEXT = 4
CLASSES = 5
UPSCALE = 4


@dataclass(frozen=True)
class Config:
    """Sizes of the network. channels: at 24, 12 and 6 pixels a side; blocks: residual blocks at 12 down, 6, 12 up."""

    stack: int = 9
    grid: int = 24
    channels: tuple[int, int, int] = (32, 64, 128)
    blocks: tuple[int, int, int] = (1, 2, 1)
    head: int = 32
    kernel: int = 3

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        return Config(**{**values, "channels": tuple(values["channels"]), "blocks": tuple(values["blocks"])})


FULL = Config()
FAST = Config(channels=(16, 32, 64), blocks=(1, 1, 0), head=16)


class CBAM(nn.Module):
    """Convolutional block attention (Woo et al. 2018): channels first, then places."""

    def __init__(self, channels: int, reduction: int = 4) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, channels // reduction, 1)
        self.excite = nn.Conv2d(channels // reduction, channels, 1)
        self.place = nn.Conv2d(2, 1, 5, padding=2)

    def forward(self, x: Tensor) -> Tensor:
        mean, peak = x.mean((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
        gate = self.excite(F.relu(self.squeeze(mean))) + self.excite(F.relu(self.squeeze(peak)))
        x = x * torch.sigmoid(gate)
        where = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], 1)
        return x * torch.sigmoid(self.place(where))


class Block(nn.Module):
    """Residual block: two 3x3 convolutions; context and place (learned per pixel) shift the features, CBAM weighs them."""

    def __init__(self, channels: int, side: int, context: int, attention: bool = False) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm1 = nn.BatchNorm2d(channels)
        self.place = nn.Parameter(torch.zeros(1, channels, side, side))
        self.film = nn.Linear(context, 2 * channels)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(channels)
        nn.init.constant_(self.norm2.weight, 0.3)
        self.attention = CBAM(channels) if attention else nn.Identity()

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        gain, offset = self.film(context)[:, :, None, None].chunk(2, 1)
        y = self.norm1(self.first(x)) * (1 + gain) + offset + self.place
        y = self.norm2(self.second(F.silu(y)))
        return F.silu(x + self.attention(y))


def _join(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, stride=stride, bias=False), nn.BatchNorm2d(outputs), nn.SiLU()
    )


class MMCNN(nn.Module):
    """See the module's docstring."""

    def __init__(self, config: Config = FULL) -> None:
        super().__init__()
        self.config = config
        a, b, c = config.channels
        n = config.grid
        axis = torch.linspace(-1 + 1 / n, 1 - 1 / n, n)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        self.register_buffer("coordinates", torch.stack([x, y, x * x, y * y])[None], persistent=False)
        self.told = nn.Sequential(nn.Linear(CONTEXT, 32), nn.SiLU(), nn.Linear(32, 32), nn.SiLU())
        self.stem = _join(config.stack + 4, a)
        self.down1 = _join(a, b, 2)
        self.blocks1 = nn.ModuleList(Block(b, n // 2, 32) for _ in range(config.blocks[0]))
        self.down2 = _join(b, c, 2)
        self.blocks2 = nn.ModuleList(Block(c, n // 4, 32, attention=True) for _ in range(config.blocks[1]))
        self.up2 = nn.Conv2d(c, 4 * b, 1)
        self.mix2 = _join(2 * b, b)
        self.blocks3 = nn.ModuleList(Block(b, n // 2, 32, attention=True) for _ in range(config.blocks[2]))
        self.up1 = nn.Conv2d(b, 4 * a, 1)
        self.mix1 = _join(2 * a, config.head)
        # per pixel of 24 x 24: 16 mask logits, 16 log sigmas, amplitude, 5 classes
        self.out = nn.Conv2d(config.head, 2 * UPSCALE**2 + 1 + CLASSES, 3, padding=1)
        with torch.no_grad():
            self.out.weight *= 0.3
            self.out.bias.zero_()
            self.out.bias[: UPSCALE**2] = -2.0

    def parts(self, stack: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """mask logits (N, 1, 96, 96), log amplitude (N, 1, 24, 24), log sigma relative to amplitude (N, 1, 96, 96), classes."""
        told = self.told(context)
        top = self.stem(torch.cat([stack, self.coordinates.expand(stack.shape[0], -1, -1, -1)], 1))
        x = self.down1(top)
        for block in self.blocks1:
            x = block(x, told)
        middle = x
        x = self.down2(x)
        for block in self.blocks2:
            x = block(x, told)
        x = self.mix2(torch.cat([F.pixel_shuffle(self.up2(x), 2), middle], 1))
        for block in self.blocks3:
            x = block(x, told)
        x = self.mix1(torch.cat([F.pixel_shuffle(self.up1(x), 2), top], 1))
        mask, sigma, amplitude, classes = self.out(x).split([UPSCALE**2, UPSCALE**2, 1, CLASSES], 1)
        return F.pixel_shuffle(mask, UPSCALE), amplitude, F.pixel_shuffle(sigma, UPSCALE) - 2.0, classes

    def forward(self, stack: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mask, amplitude, sigma, classes = self.parts(stack, context)
        return (*compose(mask, amplitude, sigma), classes)


def compose(mask: Tensor, amplitude: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """drop = amplitude x mask, and its log_sigma: sigma is relative to the amplitude, so that it is bounded too."""
    log_amplitude = F.interpolate(
        amplitude.clamp(-6.0, 6.0), scale_factor=UPSCALE, mode="bilinear", align_corners=False
    )
    return torch.exp(log_amplitude) * torch.sigmoid(mask), log_amplitude + sigma.clamp(-8.0, 2.0)


def multiply_accumulates(config: Config) -> int:
    """Multiply-accumulates of one frame, convolutions only."""
    model, total = MMCNN(config).eval(), 0

    def count(module: nn.Conv2d, _: object, output: Tensor) -> None:
        nonlocal total
        total += output[0].numel() * module.in_channels * module.kernel_size[0] * module.kernel_size[1]

    hooks = [m.register_forward_hook(count) for m in model.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        model(torch.zeros(1, config.stack, config.grid, config.grid), torch.zeros(1, CONTEXT))
    for hook in hooks:
        hook.remove()
    return total
