"""Skins that are not the skin of their file: anisotropic, uneven, mounted off, soft at a touch's edge.

`NAMED` is the set that `skin bench accuracy` measures and that `skin stub --mismatch NAME` simulates. Lengths are model
units unless the name says otherwise; the same Mismatch gives the same sheet on every mesh.

    sheet = MismatchedSheet("square16", named("mild"), mesh="stub")
    z0 = sheet.solve().impedances()
    touched = sheet.solve([Shape("circle", 0.2, 0.1, 0.3, 0.15)]).impedances()
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from models import geometry
from models.elements import Elements, barycentric
from models.forward import ForwardModel, Solution
from models.shapes import Shape, drop_image
from protocol.errors import EitskinError

Array = NDArray[np.float64]

WAVES = 48  # random waves that make a smooth field
FIELD_LENGTH = 1.0  # correlation length of a field, model units: half a side of the square skin
BLUR_GRID = 320  # pixels a side on which a soft edge is computed
BLUR_REACH = 4.5  # standard deviations beyond which a blurred edge has ended
NEXT_ELEMENTS = 0.1  # model units: no element is larger
LARGEST_DROP = 0.97  # of the sheet: no touch cuts it through


class MismatchError(EitskinError, ValueError):
    """No such mismatch; the message lists those there are."""


@dataclass(frozen=True)
class Mismatch:
    """What a skin differs by from its file. All zero: not at all.

    anisotropy: the sheet conducts 1 + anisotropy times better along `angle` (radians) than the file says, and as many
    times worse across. field: relative standard deviation of a smooth conductivity field. shift: standard deviation of
    each electrode's place along the outline, as a share of half the skin's extent ("1 % of the side": 0.02).
    contacts: how many electrodes have `contact_factor` times their contact impedance. contact_spread: standard
    deviation of the logarithm of every contact impedance. blur_m: standard deviation [m] of the blur of a touch's edge.
    """

    anisotropy: float = 0.0
    angle: float = 0.0
    field: float = 0.0
    shift: float = 0.0
    contacts: int = 0
    contact_factor: float = 5.0
    contact_spread: float = 0.0
    blur_m: float = 0.0
    seed: int = 0

    def seeded(self, seed: int) -> Mismatch:
        """Another skin of the same kind: other random field, electrodes and direction."""
        return replace(self, seed=seed, angle=float(np.random.default_rng([seed, 5]).uniform(0, np.pi)))


NAMED: dict[str, Mismatch] = {
    "none": Mismatch(),
    "anisotropy5": Mismatch(anisotropy=0.05),
    "anisotropy15": Mismatch(anisotropy=0.15),
    "field5": Mismatch(field=0.05),
    "field10": Mismatch(field=0.10),
    "shift1": Mismatch(shift=0.02),
    "shift3": Mismatch(shift=0.06),
    "contacts": Mismatch(contacts=4),
    "blur": Mismatch(blur_m=3e-3),
    "mild": Mismatch(anisotropy=0.05, angle=0.5, field=0.05, shift=0.02, contact_spread=0.3),
}
"""One thing at a time, and last a little of everything but soft edges."""


def named(name: str) -> Mismatch:
    """One of NAMED. Raises MismatchError."""
    if name not in NAMED:
        raise MismatchError(f"no mismatch {name!r}: expected one of {', '.join(NAMED)}")
    return NAMED[name]


class MismatchedSheet:
    """A skin that differs from its file, on a mesh. `skin` is as mounted; `nominal` as its file says."""

    def __init__(self, skin: geometry.SkinGeometry | str, mismatch: Mismatch, mesh: str = "stub") -> None:
        self.nominal = geometry.load(skin) if isinstance(skin, str) else skin
        self.mismatch = mismatch
        self.skin = mounted(self.nominal, mismatch)
        self.model = ForwardModel(self.skin, mesh=mesh)
        self.root: Array = anisotropy_root(mismatch.anisotropy, mismatch.angle)
        self.field: Array = 1 + SmoothField(self.nominal, mismatch.field, mismatch.seed)(self.model.centroids)

    def solve(
        self, shapes: Sequence[Shape] = (), background: float = 1.0, contact: float | Array | None = None
    ) -> Solution:
        """Fields under touches. background: conductivity of the whole sheet, relative; contact: of the contact
        impedances, relative, one number or one an electrode.
        """
        series = self.skin.contact_impedance * (1.0 if contact is None else contact)
        return self.model.solve(self.conductivity(shapes, background), series)

    def conductivity(self, shapes: Sequence[Shape] = (), background: float = 1.0) -> Array:
        """(n_elements, 3) tensors xx, xy, yy [S]. A touch takes its share of whatever conducts where it is."""
        soft = bool(shapes) and self.mismatch.blur_m > 0
        blur = self.mismatch.blur_m / self.skin.metres_per_unit
        drop = soft_touched(self.model, shapes, blur) if soft else self.model.touched(shapes)
        scaled: Array = drop * (background * self.field)[:, None]
        return turned(scaled, self.root)


def soft_touched(model: Elements, shapes: Sequence[Shape], blur: float) -> Array:
    """(n_elements, 3) conductivity of a sheet of 1 S under touches whose edges are blurred; see soft_drop."""
    image = soft_drop(shapes, blur, BLUR_GRID)
    reach = np.array([np.hypot(*(model.centroids - (s.x, s.y)).T) - s.radius for s in shapes]).min(axis=0)
    near = np.flatnonzero(reach < BLUR_REACH * blur + NEXT_ELEMENTS)
    points = np.einsum("qc,eck->eqk", barycentric(4), model.corners[near])
    place = (points + 1) * BLUR_GRID / 2 - 0.5
    drop = ndimage.map_coordinates(image, [place[..., 1], place[..., 0]], order=1, mode="nearest").mean(axis=1)
    result = np.tile([1.0, 0.0, 1.0], (model.n_elements, 1))
    result[near, 0] = result[near, 2] = 1 - np.minimum(drop, LARGEST_DROP)
    return np.asarray(result)


def soft_drop(shapes: Sequence[Shape], blur: float, n: int) -> Array:
    """(n, n) conductivity drop of touches whose edges are blurred (Gaussian, standard deviation `blur` model units)."""
    fine = n * max(1, BLUR_GRID // n)
    image, spread = drop_image(shapes, fine), blur * fine / 2
    reach = int(np.ceil(BLUR_REACH * spread)) + 1
    window = tuple(
        slice(max(0, int(there[0]) - reach), int(there[-1]) + reach + 1)
        for there in (np.flatnonzero(image.any(axis=axis)) for axis in (1, 0))
    )
    image[window] = ndimage.gaussian_filter(image[window], spread, mode="constant")
    return np.asarray(image.reshape(n, fine // n, n, fine // n).mean(axis=(1, 3)))


def mounted(skin: geometry.SkinGeometry, mismatch: Mismatch) -> geometry.SkinGeometry:
    """The skin with its electrodes where they really are, and the contact impedances that they really have.

    Electrodes that would overlap keep a hundredth of the skin's half extent between them.
    """
    rng = np.random.default_rng([mismatch.seed, 2])
    n = skin.n_electrodes
    shift = mismatch.shift * rng.standard_normal(n)
    shift = np.clip(shift, -2 * mismatch.shift, 2 * mismatch.shift)
    room = (skin.perimeter / n - skin.widths.max()) / 2 - 0.005  # evenly spaced skins never overlap within it
    shift = np.clip(shift, -room, room) if room > 0 else 0 * shift
    contact = skin.contact_impedance * np.exp(mismatch.contact_spread * rng.standard_normal(n))
    contact[rng.choice(n, min(mismatch.contacts, n), replace=False)] *= mismatch.contact_factor
    return skin.moved(shift, contact)


class SmoothField:
    """A random smooth function of the plane: a Gaussian process of correlation length FIELD_LENGTH, by random waves.

    Its mean over the skin is 0 and its root mean square `sd`, exactly, whatever the seed.
    """

    def __init__(self, skin: geometry.SkinGeometry, sd: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        self._waves: Array = rng.standard_normal((2, WAVES)) / FIELD_LENGTH
        self._phases: Array = rng.uniform(0, 2 * np.pi, WAVES)
        self._mean, self._scale = 0.0, 1.0
        axis = np.linspace(-1, 1, 61)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        plain = self(grid[skin.inside(grid)])
        self._mean, self._scale = float(plain.mean()), sd / max(float(plain.std()), 1e-12)

    def __call__(self, points: Array) -> Array:
        """(...,) at points (..., 2)."""
        plain = np.cos(points @ self._waves + self._phases).sum(axis=-1)
        return np.asarray((plain - self._mean) * self._scale)


def anisotropy_root(anisotropy: float, angle: float) -> Array:
    """(2, 2) square root of the tensor that multiplies an isotropic sheet."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return np.asarray(turn @ np.diag([np.sqrt(1 + anisotropy), 1 / np.sqrt(1 + anisotropy)]) @ turn.T)


def turned(tensors: Array, root: Array) -> Array:
    """(m, 3) root S root of each symmetric tensor S (m, 3) as xx, xy, yy."""
    xx, xy, yy = tensors.T
    full = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
    made = root @ full @ root
    return np.column_stack([made[:, 0, 0], made[:, 0, 1], made[:, 1, 1]])
