"""A smaller network as a part of a trained one: the channels and blocks that its answers need most.

What a channel or a block is worth is what the loss rises by without it, each taken out alone. Training then mends what
was cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from models import samples
from models.losses import losses, total
from models.network import ATTENTION, CBAM, MMCNN, NetworkConfig
from protocol.errors import EitskinError

BATCHES = 1  # that the worth is taken over


class NoPart(EitskinError, ValueError):
    """A configuration that is no part of the network's; says what is larger."""


@dataclass
class Worth:
    """What the loss rises by without each channel of the three widths, hidden unit of the attention, and block."""

    channels: list[Tensor]
    hidden: Tensor
    blocks: list[Tensor]


@torch.no_grad()
def worth(model: MMCNN, batches: samples.Batches, count: int = BATCHES) -> Worth:
    """Over `count` batches, in eval mode; the model is left as it was."""
    model.eval()
    drawn = [batches.draw() for _ in range(count)]

    def loss() -> float:
        return sum(float(total(losses(model.parts(b.stack, b.context), b.target))) for b in drawn) / count

    before = loss()

    def rise(weights: Sequence[Tensor]) -> float:
        """Of the loss, or its fall, where these views of weights are zero."""
        kept = [w.clone() for w in weights]
        for w in weights:
            w.zero_()
        found = abs(loss() - before)
        for w, value in zip(weights, kept, strict=True):
            w.copy_(value)
        return found

    stages = [[_pair(block) for block in stage.blocks] for stage in (model.stage1, model.stage2, model.stage3)]
    inner = [[convolution for convolution, _ in stage] for stage in stages]
    readers = [
        [_pair(model.down1)[0], model.out, model.aside],
        [_pair(model.down2)[0], _pair(model.up1)[0], model.classes, *inner[0], *inner[2]],
        [_pair(model.up2)[0], *inner[1]],
    ]
    attention = model.stage2.attention
    hidden = list(attention.excite.weight.unbind(1)) if isinstance(attention, CBAM) else []
    return Worth(
        channels=[
            torch.tensor([rise([r.weight[:, k] for r in of]) for k in range(width)])
            for of, width in zip(readers, model.config.channels, strict=True)
        ],
        hidden=torch.tensor([rise([unit]) for unit in hidden]),
        blocks=[torch.tensor([rise([normal.weight, normal.bias]) for _, normal in stage]) for stage in stages],
    )


def _pair(module: nn.Module) -> tuple[nn.Conv2d, nn.BatchNorm2d]:
    """Convolution and normalisation."""
    assert isinstance(module, nn.Sequential)
    convolution, normal = module
    assert isinstance(convolution, nn.Conv2d) and isinstance(normal, nn.BatchNorm2d)
    return convolution, normal


def is_part(config: NetworkConfig, larger: NetworkConfig) -> bool:
    """Whether a network of `config` can be made of the channels and blocks of a larger one."""
    sizes = [*zip(config.channels, larger.channels, strict=True), *zip(config.blocks, larger.blocks, strict=True)]
    return all(a <= b for a, b in sizes) and (config.lean or not larger.lean) and config.stack == larger.stack


@dataclass(frozen=True)
class _Left:
    """The channels that are left: those that each module gives and reads, the attention's hidden units, the widest."""

    rows: dict[str, Tensor]
    columns: dict[str, Tensor]
    hidden: Tensor
    widest: Tensor

    def of(self, place: list[str], value: Tensor) -> Tensor:
        """What is left of the weight of this name."""
        at = self.rows.get(place[0])
        if "squeeze" in place or "excite" in place:
            out, into = (self.hidden, self.widest) if "squeeze" in place else (self.widest, self.hidden)
            return value[out] if value.ndim == 1 else value[out][:, into]
        if "attention" in place or value.ndim == 0 or place[0] == "context":
            return value
        if "film" in place:  # gains and offsets
            assert at is not None
            return value[torch.cat([at, at + len(value) // 2])]
        if place[-1] == "place":
            return value[:, at]
        value = value if at is None else value[at]
        return value[:, self.columns[place[0]]] if value.ndim == 4 and place[0] in self.columns else value


def _best(value: Tensor, count: int) -> Tensor:
    return value.topk(count).indices.sort().values


def part(model: MMCNN, config: NetworkConfig, lost: Worth) -> MMCNN:
    """The network of `config` with the weights of the most valuable channels. Raises NoPart."""
    mine = model.config
    if not is_part(config, mine):
        raise NoPart(f"{config} is no part of a network of {mine}: it may have fewer channels and blocks, not more")

    a, b, c = (_best(value, n) for value, n in zip(lost.channels, config.channels, strict=True))
    hidden = _best(lost.hidden, 0 if config.lean else len(c) // ATTENTION)
    shuffled = {n: (4 * left[:, None] + torch.arange(4)).reshape(-1) for n, left in (("a", a), ("b", b))}
    rows = {
        "stem": a, "told": a, "down1": b, "stage1": b, "down2": c, "stage2": c, "stage3": b,
        "up2": shuffled["b"], "up1": shuffled["a"],
    }  # fmt: skip
    columns = {
        "down1": a, "stage1": b, "down2": b, "stage2": c, "up2": c, "stage3": b, "up1": b,
        "out": a, "aside": a, "classes": b,
    }  # fmt: skip
    left = _Left(rows, columns, hidden, c)
    blocks = [_best(value, n) for value, n in zip(lost.blocks, config.blocks, strict=True)]
    source = model.state_dict()
    small = MMCNN(config)
    state = {}
    for name, wanted in small.state_dict().items():
        place = name.split(".")
        if place[1:2] == ["blocks"]:
            place[2] = str(int(blocks[int(place[0][-1]) - 1][int(place[2])]))
        value = left.of(place, source[".".join(place)])
        assert value.shape == wanted.shape, name
        state[name] = value.clone()
    small.load_state_dict(state)
    return small
