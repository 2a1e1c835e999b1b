"""A scan with what is needed to ask about it, and what the one before it left open."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.touch import ACTION, PLACE, RATE, VELOCITY, TouchPrior
from services.estimation.hypotheses.innovation import Innovation, StepBudget, begun_at
from services.estimation.values.scan import Scan

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Observation:
    """One scan as it was observed: log |Z|, which measurements count, and when each was taken."""

    scan: Scan
    log_z: Array  # (K,) 0 where a measurement does not count
    live: NDArray[np.bool_]  # (K,)
    whole: bool  # it shares no value with the last one that was whole
    budget: StepBudget

    @property
    def span_s(self) -> float:
        return self.scan.duration_s

    @property
    def middle_s(self) -> float:
        return self.scan.at_ns * 1e-9 - self.scan.duration_s / 2

    @property
    def oldest_s(self) -> float:
        return self.middle_s - self.span_s / 2

    @property
    def end_s(self) -> float:
        return self.middle_s + self.span_s / 2

    @property
    def sample_s(self) -> float:
        """For when what touches is said, from the middle of the scan on."""
        return self.scan.sample_ns * 1e-9 - self.middle_s

    @property
    def times_s(self) -> Array:
        """(K,) from the middle of the scan."""
        return self.span_s / 2 - self.scan.ages_s

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """(K,) rank in time, 0 the oldest."""
        return np.argsort(np.argsort(-self.scan.ages_s, kind="stable"), kind="stable")

    def innovation(
        self,
        y: Array,
        covariance: Array,
        live: NDArray[np.bool_],
        information: NDArray[np.float32],
        candidates: tuple[TouchPrior, ...],
        places: tuple[int, ...] = (),
    ) -> Innovation:
        """About this scan."""
        return Innovation(
            y=y,
            covariance=covariance,
            live=live,
            times_s=self.times_s,
            span_s=self.span_s,
            sample_s=self.sample_s,
            order=self.order,
            part=self.scan.part,
            information=information,
            budget=self.budget,
            candidates=candidates,
            places=places,
            by_evidence=self.whole,
        )


@dataclass(frozen=True)
class OpenTouch:
    """A touch that nearly explained the last scan, or did so and is not sure."""

    state: Annotated[Array, "states"]
    since_s: float  # host's clock
    id: int = 0  # of the one that it continues; 0: none

    def begun(self, measured: Observation) -> TouchPrior:
        """Anywhere in the next scan, searched from where it was at the end of that one: how it goes on nobody knows."""
        state, half_s = self.state.copy(), measured.span_s / 2
        state[PLACE] += half_s * state[VELOCITY]
        state[ACTION] += half_s * state[RATE]
        state[RATE:] = 0.0
        return begun_at(state, measured.span_s, self.since_s - measured.middle_s)
