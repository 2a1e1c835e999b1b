"""The stages behind the stub's sheet and analogue part, without board, link and time."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from firmware_stub.sheet import Sheet
from models.bundle import Bundle
from models.shapes import Shape
from protocol.frames import RawFrame
from protocol.scan_setting import COHERENT
from services.pipeline import Pipeline, Result
from services.runtime.config import Skin

TRANSFER = NDArray[np.float64]


@cache
def sheet() -> Sheet:
    return Sheet("square16")


@cache
def transfer(shapes: tuple[Shape, ...] = (), contacts: tuple[tuple[int, float], ...] = ()) -> TRANSFER:
    """(16, 16) ohm of the stub's sheet, touched; contacts: electrode and the factor on its contact impedance."""
    impedance = sheet().skin.contact_impedance.copy()
    for electrode, factor in contacts:
        impedance[electrode] *= factor
    return sheet().model.solve(sheet().model.touched(list(shapes)), impedance).transfer


class StubSkin:
    """Multiplexers, converter and firmware's arithmetic of the stub, then the stages of square16."""

    def __init__(self, snr_db: float, tare: bool = True, skin: Skin | str = "square16") -> None:
        bundle = Bundle.load("square16")
        self.pattern, self.faults, self.scan = np.asarray(bundle.pattern), Faults(), 0
        self.analog = Analog(BoardNoise.of_db(snr_db), self.faults, np.random.default_rng(3))
        self.pipeline = Pipeline(skin, name="palm")
        if tare:
            result = self.rest(72)
            assert result.contact.valid and not result.delta.touched

    def rest(self, frames: int) -> Result:
        for _ in range(frames):
            result = self.feel()
        return result

    def feel(self, shapes: tuple[Shape, ...] = (), contacts: tuple[tuple[int, float], ...] = ()) -> Result:
        return self.see(transfer(shapes, contacts))

    def see(self, t: TRANSFER, end: TRANSFER | None = None) -> Result:
        """One scan of a sheet with these transfer impedances; end: with those when it ends, changing steadily."""
        z, status = self.analog.measure((t, t if end is None else end), self.pattern, COHERENT, 40_000.0, 0.0)
        return self.run(z, status)

    def run(self, z: NDArray[np.complex64], status: NDArray[np.uint8] | None = None) -> Result:
        self.scan += 1
        stamps = {"sample": self.scan * 45_000_000, "read": self.scan * 45_000_000 + 1}
        status = np.zeros(len(z), np.uint8) if status is None else status
        return self.pipeline.run(
            RawFrame(skin="palm", scan=self.scan, stamps=stamps, source="board", valid=True, z=z, status=status)
        )
