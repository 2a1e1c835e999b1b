"""The shipped MM-CNN: a small U-Net with CBAM over the pre-reconstruction stack; the noise level is one of its inputs.

Inputs are what `prereconstruction.Operator.stack` gives: the stack (N, C, 24, 24), divided by the frame's scale, and
its context (N, n). Outputs: drop (N, 1, 96, 96) in units of that scale, log_sigma (N, 1, 96, 96) of the same, classes
(N, 5, 24, 24) logits.

What differs from the published network (published.py): pooling stops at a quarter of the pixels and the image comes
out of one pixel shuffle, so that nearly all arithmetic is on 24 x 24 and fewer; the drop is amplitude times mask,
because a touch is a patch of nearly one drop with a sharp edge; the context sets a gain and an offset of each block's
channels (FiLM).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CONTEXT = 4
TOLD = 32  # features of the context
CLASSES = 5
ATTENTION = 4  # channels of each hidden unit of the attention
UPSCALE = 4

Model = TypeVar("Model", bound=nn.Module)


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network. channels: at 24, 12 and 6 pixels a side; blocks: residual blocks at 12 down, 6, 12 up."""

    stack: int = 9
    grid: int = 24
    channels: tuple[int, int, int] = (24, 64, 96)
    blocks: tuple[int, int, int] = (1, 3, 1)
    lean: bool = False  # context at the stem only, no attention: each costs the fast network more time than accuracy

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> NetworkConfig:
        return NetworkConfig(**{**values, "channels": tuple(values["channels"]), "blocks": tuple(values["blocks"])})


FULL = NetworkConfig()
FAST = NetworkConfig(channels=(16, 48, 96), blocks=(1, 2, 1), lean=True)


class CBAM(nn.Module):
    """Convolutional block attention (Woo et al. 2018): channels first, then places."""

    def __init__(self, channels: int, reduction: int = ATTENTION) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, channels // reduction, 1)
        self.excite = nn.Conv2d(channels // reduction, channels, 1)
        self.place = nn.Conv2d(2, 1, 5, padding=2)

    def forward(self, x: Tensor) -> Tensor:
        mean, peak = x.mean((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
        gate = self.excite(F.relu(self.squeeze(mean))) + self.excite(F.relu(self.squeeze(peak)))
        x = x * torch.sigmoid(gate)
        where = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], 1)
        attended: Tensor = x * torch.sigmoid(self.place(where))
        return attended


class FiLM(nn.Module):
    """x (1 + gain(context)) + offset(context) + place: what the noise and where on the skin do to features (FiLM)."""

    def __init__(self, channels: int, side: int) -> None:
        super().__init__()
        self.place = nn.Parameter(torch.zeros(1, channels, side, side))
        self.film = nn.Linear(TOLD, 2 * channels)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, told: Tensor) -> Tensor:
        film: Tensor = self.film(told)
        gain, offset = film[:, :, None, None].chunk(2, 1)
        return x * (1 + gain) + (offset + self.place)


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, padding=size // 2, stride=stride, bias=False), nn.BatchNorm2d(outputs)
    )


class ResidualStage(nn.Module):
    """Residual 3x3 convolutions at one resolution; context and place come in at the first."""

    def __init__(self, blocks: int, channels: int, side: int, lean: bool, attention: bool = False) -> None:
        super().__init__()
        self.told = None if lean else FiLM(channels, side)
        self.blocks = nn.ModuleList(_convolution(channels, channels) for _ in range(blocks))
        self.attention = CBAM(channels) if attention else nn.Identity()

    def forward(self, x: Tensor, told: Tensor) -> Tensor:
        x = F.relu(self.told(x, told) if self.told else x)
        for block in self.blocks:
            x = x + F.relu(block(x))
        attended: Tensor = self.attention(x)
        return attended


class MMCNN(nn.Module):
    """See the module's docstring."""

    def __init__(self, config: NetworkConfig = FULL) -> None:
        super().__init__()
        self.config = config
        a, b, c = config.channels
        n = config.grid
        self.context = nn.Sequential(nn.Linear(CONTEXT, TOLD), nn.ReLU(), nn.Linear(TOLD, TOLD), nn.ReLU())
        self.stem, self.told = _convolution(config.stack, a), FiLM(a, n)
        self.down1 = _convolution(a, b, stride=2)
        self.stage1 = ResidualStage(config.blocks[0], b, n // 2, config.lean)
        self.down2 = _convolution(b, c, stride=2)
        self.stage2 = ResidualStage(config.blocks[1], c, n // 4, config.lean, attention=not config.lean)
        self.up2 = _convolution(c, 4 * b, 1)
        self.stage3 = ResidualStage(config.blocks[2], b, n // 2, config.lean)
        self.up1 = _convolution(b, 4 * a, 1)
        # per pixel of 24 x 24: 16 mask logits and the amplitude; 16 log sigmas. What shape it is shows in the wider
        # features.
        self.out = nn.Conv2d(a, UPSCALE**2 + 1, 3, padding=1)
        self.aside = nn.Conv2d(a, UPSCALE**2, 1)
        self.classes = nn.Conv2d(b, 4 * CLASSES, 1)
        with torch.no_grad():
            for layer in (self.out, self.aside):
                assert layer.bias is not None
                layer.weight *= 0.3
                layer.bias.zero_()
                layer.bias[: UPSCALE**2] = -2.0

    def parts(self, stack: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """mask logits (N, 1, 96, 96), log amplitude (N, 1, 24, 24), log sigma over amplitude (N, 1, 96, 96),
        classes.
        """
        told = self.context(context)
        top = F.relu(self.told(self.stem(stack), told))
        middle = self.stage1(self.down1(top), told)
        x = self.stage2(self.down2(middle), told)
        x = self.stage3(F.pixel_shuffle(self.up2(x), 2) + middle, told)
        classes = F.pixel_shuffle(self.classes(x), 2)
        x = F.relu(F.pixel_shuffle(self.up1(x), 2) + top)
        mask, amplitude = self.out(x).split([UPSCALE**2, 1], 1)
        mask, sigma = F.pixel_shuffle(torch.cat([mask, self.aside(x)], 1), UPSCALE).chunk(2, 1)
        return mask, amplitude, sigma, classes

    def forward(self, stack: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mask, amplitude, sigma, classes = self.parts(stack, context)
        return (*compose(mask, amplitude, sigma), classes)


def compose(mask: Tensor, amplitude: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """drop = amplitude x mask, and its log_sigma: sigma is relative to the amplitude, so that it is bounded too."""
    log_amplitude = F.interpolate(
        amplitude.clamp(-6.0, 6.0), scale_factor=UPSCALE, mode="bilinear", align_corners=False
    )
    return torch.exp(log_amplitude) * torch.sigmoid(mask), log_amplitude + sigma.clamp(-8.0, 2.0)


def laid_out(model: Model, layout: torch.memory_format) -> Model:
    """The model, its convolutions' weights in this order of memory; what Module.to does, which takes no layout by its
    annotations.
    """
    for weight in model.parameters():
        if weight.ndim == 4:
            weight.data = weight.data.to(memory_format=layout)
    return model


def multiply_accumulates(config: NetworkConfig) -> int:
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
