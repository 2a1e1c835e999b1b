"""The foam sheet that the stub's board measures: from a world to the transfer impedances between its electrodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models import geometry
from models.bundle import Bundle
from models.mismatch import Mismatch, MismatchedSheet, named
from models.shapes import Shape

from .world import Touch, World

MOST_DROP = 0.97  # S/m: a contact never cuts the sheet through


class Sheet:
    """Forward model on the mesh "stub", which nothing is trained or inverted on. Units: ohm, metres.

    `of`: a skin of models/skins, a TOML file, or the folder of a bundle, whose manifest says its geometry. `mismatch`:
    how the sheet differs from that, one of models.mismatch.NAMED or one of its own. `skin` is the file's, `model` the
    sheet's.
    """

    def __init__(self, of: str = "square16", mismatch: str | Mismatch = "none", mesh: str = "stub") -> None:
        differs = named(mismatch) if isinstance(mismatch, str) else mismatch  # first, because it fails early
        self.mismatch = mismatch if isinstance(mismatch, str) else ("none" if differs == Mismatch() else "its own")
        in_bundle = (Path(of) / "manifest.json").is_file()
        self.skin = geometry.from_dict(Bundle.load(of).skin) if in_bundle else geometry.load(of)
        self._real = MismatchedSheet(self.skin, differs, mesh=mesh)
        self.model = self._real.model

    @property
    def electrodes(self) -> int:
        return self.skin.n_electrodes

    def shape(self, touch: Touch) -> Shape:
        """A touch in the forward model's units."""
        scale = self.skin.metres_per_unit
        return Shape(
            touch.kind,
            touch.x / scale,
            touch.y / scale,
            touch.radius / scale,
            min(touch.felt, MOST_DROP),
            touch.rotation,
            touch.aspect,
        )

    def outline(self, touch: Touch) -> NDArray[np.float64]:
        """(m, 2) corners in metres."""
        return np.asarray(self.shape(touch).outline() * self.skin.metres_per_unit)

    def transfer(self, world: World) -> NDArray[np.float64]:
        """(n, n) ohm: potential of each electrode over the last, for unit currents from each of them to the last."""
        shapes = [self.shape(touch) for touch in world.touches if touch.felt > 0]
        contact = np.array(world.contact) if world.contact else 1.0
        if self.mismatch == "none":
            sheet, series = self.model.touched(shapes, world.background), self.skin.contact_impedance
        else:
            sheet, series = self._real.conductivity(shapes, world.background), self._real.skin.contact_impedance
        return self.model.solve(sheet * self._beside(world)[:, None], series * contact).transfer

    def _beside(self, world: World) -> NDArray[np.float64]:
        """(n_elements,) what residues and warmth leave of the conductivity, or (1,) where there are none."""
        share = np.ones(1)
        if world.residues:  # they are faint: their outlines need no laminate
            xx, _, yy = self.model.touched(self.shape(touch) for touch in world.residues).T
            share = share * (xx + yy) / 2
        if world.gradient != (0.0, 0.0) or world.spots:
            place = self.model.centroids * self.skin.metres_per_unit
            warm = 1 + place @ np.array(world.gradient)
            for spot in world.spots:
                far = ((place - (spot.x, spot.y)) ** 2).sum(axis=1)
                warm += spot.share * np.exp(-far / (2 * spot.radius**2))
            share = share * warm
        return share

    def contact_slopes(self) -> NDArray[np.float64]:
        """(n, n, n) ohm: how the untouched sheet's transfer impedances change with the logarithm of each electrode's
        contact impedance, which is the first index.
        """
        solved = self._real.solve()
        n = self.electrodes
        pairs = [(i, n - 1, j, n - 1) for i in range(n - 1) for j in range(n - 1)]
        slopes = np.zeros((n, n, n))
        slopes[:, :-1, :-1] = (solved.jacobian_contact(pairs) * solved.contact_impedance).T.reshape(n, n - 1, n - 1)
        return slopes

    def inside(self, x: float, y: float) -> bool:
        """Whether the point (metres) is on the skin."""
        return bool(self.skin.inside(np.array([x, y]) / self.skin.metres_per_unit))

    def size_text(self) -> str:
        corners = self.skin.polygon() * self.skin.metres_per_unit
        (x0, y0), (x1, y1) = corners.min(0), corners.max(0)
        return f"x {x0:.3g} to {x1:.3g}, y {y0:.3g} to {y1:.3g} m"
