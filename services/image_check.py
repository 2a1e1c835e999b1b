"""Does the image explain its frame? Where it does not, the frame is refused (`out_of_distribution`: no touch looks
so), or it is of a touch that changed while it was scanned (`changing`).

The numbers come from services/estimation/quality.py (what an image leaves of its frame) and within_scan.py (what a
touch leaves that came, went or changed meanwhile).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import DeltaFrame, ImageFrame
from services.estimation.quality import NEARLY, SURE, Residual
from services.estimation.within_scan import CHANGING_FRAMES, ChangingTouch
from services.runtime.stage import SEPARATE, add_reason


class ImageCheck:
    """Of the frames of one skin, one after the other. refuses: its images are meant to explain them."""

    def __init__(self, bundle: Bundle, refuses: bool) -> None:
        self._refuses = refuses
        self.residual = Residual(bundle, to_scale=refuses)
        self._changing_touch = ChangingTouch(bundle)  # the bundle's: how a skin is mounted changes 3 % of d by little
        self.forget()

    def follow(self, bundle: Bundle) -> None:
        """Frames are made with the matrices of this bundle from now on."""
        self.residual = Residual(bundle, to_scale=self._refuses)

    def forget(self) -> None:
        """Nothing touches, or nothing is known of it."""
        self.refused = False  # whether the image explains its frame too badly to be that of a touch
        self._fitting = True  # whether the image made last explained its frame well enough by itself
        self._changing = 0  # frames in a row whose touch changed during the scan
        self._changing_scan = 0  # of the last of them whose image shows nothing

    def examine(self, frame: DeltaFrame, out: ImageFrame, alone: bool) -> bool:
        """Say what the image of `frame` in `out` leaves of it; False where the image does not explain the frame and a
        touch that changed during the scan does: then the frame is valid, says `changing`, and its image shows nothing.
        alone: frames do not follow each other.
        """
        out.residual = self.residual(frame.difference, frame.sigma, out.image)
        told = self._refuses and frame.touched and out.residual is not None
        doubtful = told and out.residual is not None and out.residual > NEARLY
        # Where an electrode is left out the skin is nearly blind: what is not explained may be another touch.
        blind = any(reason.startswith("electrode") for reason in out.reasons)
        self.refused = (told and self.residual.refused) or (doubtful and blind)
        fitting, self._fitting = self._fitting, not self.refused
        self.refused |= doubtful and not fitting  # what writes scans may write one like a touch
        doubted = frame.touched and out.residual is not None and out.residual > SURE
        if not doubted or alone or SEPARATE in frame.reasons:  # what stands by itself was still
            self._changing = 0
        elif self.refused and self._changes(frame, out):
            return False
        elif not self._changing_touch.steady(frame.difference, frame.sigma, frame.part):
            self._changing += 1
            if not self.refused:
                add_reason(out.reasons, "changing")
        return True

    def _changes(self, frame: DeltaFrame, out: ImageFrame) -> bool:
        known = self._changing >= CHANGING_FRAMES
        found = None if known else self._changing_touch(frame.difference, frame.sigma, frame.part)
        if found is None:
            return False
        add_reason(out.reasons, "changing")
        out.residual, self.refused = found.left, False
        self._changing = CHANGING_FRAMES if found.ended else self._changing + 1  # what ended does not end again
        self._changing_scan = frame.scan
        return True

    def of_changing(self, scan: int) -> bool:
        """Whether this scan is the last that was explained by a touch that changed meanwhile."""
        return 0 < self._changing_scan == scan

    def held(self) -> None:
        """The next scan is like the one that was examined: neither was written by chance."""
        self.refused &= not self._fitting

    def held_changing(self) -> None:
        """The next scan is like one of a touch that changed: what stays as it is did not change during the scan."""
        self.refused = True

    def warm_up(self, parts: int) -> None:
        """Do once what is slow the first time, of scans in so many parts: the order of parts takes half a second."""
        self._changing_touch.warm_up(parts)

    def prepare(self, sigma: NDArray[np.float32]) -> bool:
        return self.residual.prepare(sigma)

    def state(self) -> dict[str, Any]:
        changing = {"changing": [self._changing, self._changing_scan]}
        return {"refused": self.refused, "fitting": self._fitting, **changing}

    def load(self, state: dict[str, Any]) -> None:
        self._changing, self._changing_scan = (int(n) for n in state.get("changing", (0, 0)))
        self.refused = bool(state.get("refused", False))
        self._fitting = bool(state.get("fitting", not self.refused))
