"""The forward model of a registered skin: simulated responses warped to those that were measured on it.

`skin register` measures what a press does to each measurement, R(x), as a function of its place x. The simulated skin
answers such a press with S(x), a touch of the size and drop that a press is taken for. A simulated scene with the
difference d and the drop p(x) becomes

    d' = G d + (J' - G J) y,    y = -log(1 - p)

with a gain G for each measurement, the one that brings S nearest to R, J the simulated sensitivities and J' those by
which a press does what was measured. d is nearly J y, so a single press comes out as it was measured, wherever it is;
what several touches, large ones and deep ones do to each other is the simulation's, as far as its gains go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from models.augmentation import OwnSkin
from models.bundle import BUNDLES, Bundle
from models.forward import ForwardModel
from models.geometry import from_dict, is_folder
from models.linearise import linearise
from models.locator import Locator
from models.prereconstruction import Array, Matrices
from models.samples import N, Samples
from protocol.errors import EitskinError

SHIPPED = "square16"
PRESS_RADIUS, PRESS_DROP = 0.2, 0.3  # model units, S/m: what the mean press of a registration is shown as


@dataclass(frozen=True, eq=False)
class WarpedModel:
    """K measurements, P pixels of the bundle's grid."""

    matrices: Matrices  # the bundle's, in the unit in which a mean press is one of PRESS_DROP
    gain: Array  # (K,)
    correction: Array  # (K, P) J' - G J
    own: OwnSkin
    provenance: dict[str, Any]  # for the manifest

    def differences(self, simulated: Array, drop: Array) -> Array:
        """(N, K) of a simulated difference and its drop (N, 96, 96)."""
        n, (h, w) = len(drop), self.matrices.inside.shape
        y = -np.log1p(-np.clip(drop.astype(np.float32), 0.0, 0.97))
        coarse = y.reshape(n, h, N // h, w, N // w).mean(axis=(2, 4)).reshape(n, -1)
        return np.asarray(simulated * self.gain + coarse @ self.correction.T)

    def samples(self, simulated: Samples) -> Samples:
        """The same scenes on the registered skin."""
        parts = np.array_split(np.arange(len(simulated)), max(1, len(simulated) // 512))
        d = [self.differences(simulated.d[rows], simulated.drop[rows]) for rows in parts]
        return replace(simulated, d=np.concatenate(d).astype(np.float32))


class NotRegistered(EitskinError, ValueError):
    """A folder that was to be trained on holds a bundle, but not of a registered skin."""


def registered(skin: str) -> Bundle | None:
    """The registered bundle in a folder; None where `skin` names a shipped skin or a TOML file. Raises NotRegistered,
    BundleError.
    """
    if not is_folder(skin):
        return None
    found = Bundle.load(Path(skin).resolve())
    if found.locator is None:
        raise NotRegistered(
            f"{found.path} holds the bundle of '{found.name}' as it was built, expected one that `skin register` "
            f"wrote: register it, or train the skin by its name, --skin {found.name}"
        )
    return found


def start(registered: Bundle) -> Bundle:
    """The bundle whose network training goes on from: this skin's own, else that of its kind, else the shipped
    square's.
    """
    for each in (registered, *(Bundle.load(name) for name in (registered.name, SHIPPED) if _is_there(name))):
        if each.network_path("full") is not None:
            return each
    raise NotRegistered(f"the shipped bundle {SHIPPED} has no network to go on from: restore models/bundles/{SHIPPED}")


def _is_there(name: str) -> bool:
    return (BUNDLES / name / "manifest.json").is_file()


def warped(bundle: Bundle) -> WarpedModel:
    """Of a registered bundle."""
    assert bundle.locator is not None
    skin, a, m = from_dict(bundle.skin), bundle.locator, bundle.matrices
    places = Locator(a).places / bundle.metres_per_unit
    measured = np.where(a.measured, a.map.astype(float), 0.0)  # (N, K) by a mean press at each of N places
    at = [(places[:, k] + 1) * n / 2 - 0.5 for k, n in zip((1, 0), m.inside.shape, strict=True)]  # rows, columns
    pixel = 4.0 / m.inside.size
    volume = float(-np.log1p(-PRESS_DROP) * np.pi * PRESS_RADIUS**2)
    # The bundle's own sensitivities are the same map in another unit.
    shown = _sampled(m.jacobian.astype(float), m.inside, at, 0.0)
    unit = float((measured * shown).sum() / (shown * shown).sum()) * pixel / volume
    sensitivity = m.jacobian.astype(float) * unit  # (K, P)
    simulated = linearise(ForwardModel(skin), m.normalisation).jacobian.astype(float)
    limit = np.percentile(np.abs(simulated), 99, axis=1, keepdims=True)
    simulated = np.clip(simulated, -limit, limit)  # without the singular points at electrodes
    press = _sampled(simulated, m.inside, at, PRESS_RADIUS) * volume / pixel
    power = (press**2).sum(axis=0)
    gain = np.where(a.measured, (press * measured).sum(axis=0) / np.maximum(power, 1e-30), 0.0)
    left = ((measured - gain * press) ** 2).sum() / (measured**2).sum()
    size = float((measured**2).sum(axis=1).mean())
    error = np.where(np.outer(a.measured, a.measured), a.error, 0.0)
    values, vectors = np.linalg.eigh(error / size)
    return WarpedModel(
        matrices=replace(m, jacobian=sensitivity.astype(np.float32), back=(m.back / unit).astype(np.float32)),
        gain=gain,
        correction=(sensitivity - gain[:, None] * simulated) * m.inside.ravel(),
        own=OwnSkin(vectors * np.sqrt(np.maximum(values, 0.0)), np.where(a.measured, a.noise, 0.0)),
        provenance={
            "press_radius_m": PRESS_RADIUS * bundle.metres_per_unit,
            "press_drop": PRESS_DROP,
            "simulation_explains": round(1 - float(left), 4),
            "unexplained_of_a_press": round(float(np.trace(error)) / size, 4),
        },
    )


def _sampled(fields: Array, inside: npt.NDArray[np.bool_], at: list[Array], radius: float) -> Array:
    """(N, K) of fields (K, P) at N rows and columns, averaged over a disc of `radius` model units, on the skin."""
    h, w = inside.shape
    sigma = 0.5 * radius * w / 2  # a Gaussian of the disc's second moment along each axis
    weight = np.maximum(ndimage.gaussian_filter(inside.astype(float), sigma), 0.05)
    found = [
        ndimage.map_coordinates(
            ndimage.gaussian_filter(row.reshape(h, w) * inside, sigma) / weight, at, order=1, mode="nearest"
        )
        for row in fields
    ]
    return np.array(found).T
