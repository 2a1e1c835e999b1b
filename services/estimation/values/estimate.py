"""The estimator's one output: which touches there are, with their uncertainty, and what was judged on the way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from services.estimation.values import judgement
from services.estimation.values.judgement import Judgement, Verdict
from services.estimation.values.scan import Scan

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TouchEstimate:
    """One touch at the scan's `sample`. Model units and S on a sheet of 1 S, seconds; newtons nowhere."""

    id: int  # stays while the touch lasts; counts up in a session
    began: bool  # seen to begin; False: it was there when the estimator first looked
    age_s: float  # since it was first fitted
    x: float
    y: float
    vx: float  # 0 where it is steady
    vy: float
    log_radius: float  # of the disc of its area
    drop: float  # of conductivity, mean over the disc
    covariance: Annotated[Array, "said", "said"]  # (4, 4) of x, y, log radius, drop
    z2: float  # of the disc: how much it explains, in squared sigmas
    strength: float  # integral of drop / (1 - drop / 2): what the measurements tell best
    strength_sd: float
    unexplained: float  # share of the change that the fit leaves

    @property
    def radius(self) -> float:
        return float(np.exp(self.log_radius))


@dataclass(frozen=True)
class Estimate:
    """Of one scan. `valid` and `reasons` are computed from the judgements and what came with the scan."""

    scan: Scan
    whole: bool  # it shares no value with the last one that was whole
    touches: tuple[TouchEstimate, ...]
    electrodes: NDArray[np.uint8]  # (E,) protocol.frame_types.ELECTRODE_STATES
    live: NDArray[np.bool_]  # (K,) measurements that count
    difference: Array  # (K,) log |Z| / Z0 with drift, contact impedances and memory taken out
    sigma: Array  # (K,) its standard deviation
    judgements: tuple[Judgement, ...]

    @cached_property
    def valid(self) -> bool:
        return self.scan.believed and judgement.valid(self.judgements)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*self.scan.reasons, *judgement.reasons(self.judgements)]))

    @cached_property
    def touch(self) -> Judgement | None:
        """Whether something touches; None before there is a baseline."""
        return next((each for each in self.judgements if each.name == "touch"), None)

    @property
    def touched(self) -> bool:
        return self.touch is not None and self.touch.verdict is Verdict.NOTE
