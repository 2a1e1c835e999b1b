"""Steps of the board's gain over a skin's frames: taken over at once, or, where the gain is grossly off, once it has
lasted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.estimation.gain import common_factor
from services.estimation.saved import shaped
from services.estimation.tare import Baseline
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

GROSS = 0.15  # relative: no gain of a sound board steps by more (RTIA and its calibration, a tenth)
LASTING_S = 1.0


class GainSteps:
    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.reset()

    def reset(self) -> None:
        self._before: Array | None = None  # (K,) |Z| of the last frame
        self._total = 0.0  # its sum
        self._gross_ns = 0  # since when all measurements have another gain by far

    def __call__(self, amplitude: Array, baseline: Baseline, now_ns: int) -> float | None:
        """The factor that a sound frame's |Z| (K,) has in common against the sound one before, to be taken over by the
        baseline.
        """
        before, total = self._before, self._total
        self._before, self._total = amplitude.copy(), float(amplitude.sum())
        if before is None or len(before) != len(amplitude):
            return None
        gross = self._gross(amplitude, baseline)
        if gross is not None:
            self._gross_ns = self._gross_ns or now_ns
            if (now_ns - self._gross_ns) * 1e-9 < LASTING_S:
                self._before, self._total = before, total  # a fault, which may end
                return None
        self._gross_ns = 0
        if gross is not None:
            return gross
        if abs(self._total - total) < TUNING.gain_least * total:
            return None
        factor = _common(before, amplitude, baseline)
        return factor if factor is not None and abs(factor - 1) <= GROSS else None

    @staticmethod
    def _gross(amplitude: Array, baseline: Baseline) -> float | None:
        """The factor against the baseline itself where it is gross: many faults come and go with gross steps between
        frames, and errors of steps would add up.
        """
        live = (baseline.z0 > 0) & np.isfinite(amplitude) & np.isfinite(baseline.sigma)
        least, most = 1 - GROSS, 1 + GROSS
        if least * baseline.z0[live].sum() < amplitude[live].sum() < most * baseline.z0[live].sum():
            return None
        return _common(baseline.z0, amplitude, baseline)

    def state(self) -> dict[str, Any]:
        return {"before": None if self._before is None else self._before.copy(), "gross_ns": self._gross_ns}

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        if state["before"] is not None:
            self._before = shaped(state["before"], (self._k,), finite=False)
            self._total = float(self._before.sum())
        self._gross_ns = int(state["gross_ns"])


def _common(before: Array, now: Array, baseline: Baseline) -> float | None:
    """now / before of two frames' |Z| (K,), where it is common to the measurements that count in both."""
    live = (baseline.z0 > 0) & (before > 0) & np.isfinite(now) & np.isfinite(baseline.sigma)
    sigma = np.where(live, baseline.sigma / np.where(live, baseline.z0, 1.0), np.inf)
    return common_factor(before, now, sigma, live)
