"""The foam sheet that the stub's board measures: from a world to the transfer impedances between its electrodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models import geometry
from models.bundle import Bundle
from models.mismatch import MismatchedSheet, named
from models.shapes import Shape

from .world import Touch, World

MOST_DROP = 0.97  # S/m: a contact never cuts the sheet through


class Sheet:
    """Forward model on the mesh "stub", which nothing is trained or inverted on. Units: ohm, metres.

    `of`: a skin of models/skins, a TOML file, or the folder of a bundle, whose manifest says its geometry. `mismatch`:
    how the sheet differs from that, one of models.mismatch.NAMED. `skin` is the file's, `model` the sheet's.
    """

    def __init__(self, of: str = "square16", mismatch: str = "none") -> None:
        self.mismatch = mismatch
        differs = named(mismatch)  # first, because it fails early
        in_bundle = (Path(of) / "manifest.json").is_file()
        self.skin = geometry.from_dict(Bundle.load(of).skin) if in_bundle else geometry.load(of)
        self._real = MismatchedSheet(self.skin, differs, mesh="stub")
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
            min(touch.drop, MOST_DROP),
            touch.rotation,
            touch.aspect,
        )

    def outline(self, touch: Touch) -> NDArray[np.float64]:
        """(m, 2) corners in metres."""
        return np.asarray(self.shape(touch).outline() * self.skin.metres_per_unit)

    def transfer(self, world: World) -> NDArray[np.float64]:
        """(n, n) ohm: potential of each electrode over the last, for unit currents from each of them to the last."""
        shapes = [self.shape(touch) for touch in world.touches if touch.drop > 0]
        contact = np.array(world.contact) if world.contact else 1.0
        if self.mismatch == "none":
            plain = self.model.touched(shapes, world.background)
            return self.model.solve(plain, self.skin.contact_impedance * contact).transfer
        return self._real.solve(shapes, world.background, contact).transfer

    def inside(self, x: float, y: float) -> bool:
        """Whether the point (metres) is on the skin."""
        return bool(self.skin.inside(np.array([x, y]) / self.skin.metres_per_unit))

    def size_text(self) -> str:
        corners = self.skin.polygon() * self.skin.metres_per_unit
        (x0, y0), (x1, y1) = corners.min(0), corners.max(0)
        return f"x {x0:.3g} to {x1:.3g}, y {y0:.3g} to {y1:.3g} m"
