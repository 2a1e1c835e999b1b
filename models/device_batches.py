"""Training batches where the network trains: symmetry, noise and pre-reconstruction as a few batched products.

The same arithmetic as `Condition.spoil` and `Operator.stacks`, for several conditions at once and on any device of
PyTorch: with batches of a thousand a GPU would otherwise wait for a processor that makes them scene by scene.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.augmentation import Condition
from models.losses import Target
from models.symmetries import Symmetry


class SceneTensors:
    """Scenes in a device's memory, and what each symmetry of the skin makes of them."""

    def __init__(
        self,
        d: npt.NDArray[np.float32],
        drop: npt.NDArray[np.float16],
        mask: npt.NDArray[np.uint8],
        classes: npt.NDArray[np.uint8],
        symmetries: list[Symmetry],
        device: torch.device,
    ) -> None:
        """Arrays of N scenes as models.samples.Samples has them."""
        self.d = torch.from_numpy(d).to(device)
        self.drop, self.mask, self.classes = (torch.from_numpy(a).flatten(1).to(device) for a in (drop, mask, classes))
        self._measurements = torch.from_numpy(np.stack([s.measurements for s in symmetries])).long().to(device)
        self._pixels = {
            n: torch.from_numpy(
                np.stack([s.turn.image(np.arange(n * n).reshape(n, n)).reshape(-1) for s in symmetries]).copy()
            ).to(device)
            for n in (drop.shape[1], classes.shape[1])
        }

    def pick(self, index: Tensor, turn: Tensor) -> tuple[Tensor, Target]:
        """Clean differences (n, K) and targets (drop in S/m) of the scenes `index`, turned by the symmetries `turn`."""
        d = self.d[index].gather(1, self._measurements[turn])

        def turned(images: Tensor) -> Tensor:
            n = round(images.shape[1] ** 0.5)
            return images[index].gather(1, self._pixels[n][turn]).reshape(-1, n, n)

        drop, mask = turned(self.drop).float()[:, None], turned(self.mask).float()[:, None] / 255
        return d, Target(drop, mask, turned(self.classes).long())


class ConditionTensors:
    """A condition's operator and noise as tensors, those of dead electrodes padded with zeros to K."""

    def __init__(self, condition: Condition, device: torch.device) -> None:
        o, k = condition.operator, len(condition.sigma)
        missing = k - len(o.whiten)

        def padded(values: np.ndarray, dtype: torch.dtype) -> Tensor:
            return torch.from_numpy(np.pad(values, ((0, 0), (0, missing)))).to(device, dtype)

        self.shape, self.scale_index = o.shape, o.scale_index
        self.whiten = padded(o.whiten.T, torch.float64)  # (K, K')
        self.gains = padded(o.gains, torch.float64)
        self.back = padded(o.back, torch.float32)

        def exact(values: np.ndarray | float | tuple[float, float]) -> Tensor:
            return torch.as_tensor(np.array(values, dtype=float), device=device)

        self.variance = torch.as_tensor(o.variance, device=device)
        self.level = torch.as_tensor(o.level, device=device)
        self.error = exact(condition.error.T)
        self.contact = exact(condition.contact.T * condition.drift.contact)
        self.sigma = exact(condition.sigma * np.sqrt(1 + 1 / condition.tare_frames))
        self.drift_scale = exact(condition.drift.scale)
        self.live = torch.as_tensor(condition.live, device=device)
        known = (np.log10(max(o.drift, 1e-7)) + 5.0) / 2.0, 10.0 * (1.0 - o.live)
        self.log_noise = exact(np.log10(o.noise))
        self.known = exact(known)


def measured(bank: list[ConditionTensors], d: Tensor, generator: torch.Generator) -> Tensor:
    """(G, n, K) float64: clean differences under G conditions, with noise, drift and model error."""
    d = d.double()
    g, n, k = d.shape

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, device=d.device, dtype=torch.float64)

    def of(name: str) -> Tensor:
        return torch.stack([getattr(c, name) for c in bank])

    d = d + d.norm(dim=2, keepdim=True) * (normal(g, n, k) @ of("error"))
    d = d + of("sigma")[:, None] * normal(g, n, k)
    contact = of("contact")
    shift = normal(g, n, contact.shape[1]) @ contact
    d = d + (1 + d) * of("drift_scale")[:, None, None] * normal(g, n, 1) + shift
    return d * of("live")[:, None]


def stacks(bank: list[ConditionTensors], d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of measured differences (G, n, K): stack (G n, C, h, w), context (G n, 4), scale (G n,); see Operator.stacks."""
    g, n, _ = d.shape

    def of(name: str) -> Tensor:
        return torch.stack([getattr(c, name) for c in bank])

    coefficients = ((d @ of("whiten"))[:, :, None] * of("gains")[:, None]).float()  # (G, n, C, K')
    c = coefficients.shape[2]
    images = (coefficients.flatten(1, 2) @ of("back").transpose(1, 2)).reshape(g, n, c, -1)
    at, variance = bank[0].scale_index, of("variance")
    floor = (2.0 * variance[:, at].amax(1).sqrt()).clamp_min(1e-9)
    scale = torch.maximum(images[:, :, at].amax(2), floor[:, None])
    size = (scale[:, :, None] * of("level")[:, None])[..., None]
    images = images / torch.sqrt(size**2 + variance[:, None])
    log_scale = torch.log10(scale.double())
    known = of("known")[:, None].expand(g, n, 2)
    context = torch.stack(
        [log_scale + 1.0, (of("log_noise")[:, None] - log_scale + 2.5) / 1.5, known[..., 0], known[..., 1]], dim=2
    )
    h, w = bank[0].shape
    return images.reshape(g * n, c, h, w), context.reshape(g * n, 4).float(), scale.reshape(-1)
