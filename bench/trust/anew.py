"""The estimator built anew as a candidate for the shadow: the stages that are to take over."""

from __future__ import annotations

import os

from bench.trust.candidate import Today
from services.pipeline import Pipeline, build_anew


class Anew(Today):
    """Of one skin; see bench.trust.candidate.Candidate."""

    def reset(self) -> None:
        self.stages = Pipeline(self._skin, f"palm-{os.getpid()}", self._bundle, build=build_anew)
        self.stages.pre.warm_up()

    @property
    def refused(self) -> bool:
        """Its contacts stand on no image."""
        return False
