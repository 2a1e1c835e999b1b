"""Scans of an adaptive board's short list: they say whether a touch begins between two full scans."""

from __future__ import annotations

from models.bundle import Bundle
from protocol.frames import DeltaFrame, RawFrame
from services.board.scanning import Scanning
from services.estimation.baseline import BaselineEstimator
from services.estimation.sentinel import Coarse, sentinel_of
from services.runtime.config import Skin


class SentinelScans:
    """`scan`: the number of the sentinel scan with a touch that no full scan has confirmed or refuted yet; 0: none."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        self.config, self.bundle = skin, bundle
        self._coarse: Coarse | None = None
        self.scan = 0

    def warm_up(self) -> None:
        self._ready()

    def __call__(
        self,
        out: DeltaFrame,
        frame: RawFrame,
        valid: bool,
        estimator: BaselineEstimator,
        touched: bool,
        reconstructed: int,
    ) -> None:
        """Fill in `out`. valid: whether the scan itself is; touched, reconstructed: what the last full scan said."""
        coarse, known = self._ready(), estimator.baseline
        if known is None or known.doubt or not coarse.fits(frame):
            return
        out.valid = valid
        if touched:  # what touched before goes on until a full scan
            out.touched = out.held = True
            out.reconstructed = reconstructed
        else:
            self.scan = coarse(out, frame, known.z0, estimator.normaliser, estimator.sigma, self.scan)

    def _ready(self) -> Coarse:
        if self._coarse is None:
            rows = self.bundle.pattern[sentinel_of(self.bundle).rows]
            short = Scanning(rows, self.config.dft_points, self.config.rtia_ohm)
            self._coarse = Coarse(self.bundle, short.config, self.config.touch.false_alarms)
        return self._coarse
