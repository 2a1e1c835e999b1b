"""Hypotheses over time: a forward filter with hazard rates.

Every hypothesis of a frame is a state; between frames a fault begins and ends at its rate, and so does a touch. What is
given out are the probabilities of the states after each frame's evidence.
"""

from __future__ import annotations

import numpy as np

from services.estimation.hypotheses import Name
from services.estimation.tuning import TUNING, Tuning

SURE = 1e6  # nats that one frame may speak for a state at most: infinite evidence stays arithmetic
WELL: tuple[Name, ...] = (("untouched",), ("touched",))


class ForwardFilter:
    def __init__(self, tuning: Tuning = TUNING) -> None:
        self.tuning = tuning
        self.log: dict[Name, float] = {("untouched",): 0.0}

    def __call__(self, evidence: dict[Name, float], dt: float) -> dict[Name, float]:
        """Probabilities after a frame dt seconds after the one before. evidence: log evidence by hypothesis."""
        predicted = self._predict(list(evidence), dt)
        log = {name: predicted[name] + float(np.clip(evidence[name], -SURE, SURE)) for name in evidence}
        highest = max(log.values())
        total = highest + float(np.log(sum(np.exp(v - highest) for v in log.values())))
        self.log = {name: v - total for name, v in log.items()}
        return {name: float(np.exp(v)) for name, v in self.log.items()}

    @property
    def likeliest(self) -> Name:
        return max(self.log, key=lambda name: self.log[name])

    def _predict(self, names: list[Name], dt: float) -> dict[Name, float]:
        """Log probabilities before the frame is seen."""
        rates = self.tuning
        touch, begin, mend = (-np.expm1(-rate * dt) for rate in (rates.touch_rate, rates.fault_rate, rates.mend_rate))
        was = {name: float(np.exp(v)) for name, v in self.log.items()}
        kinds: dict[str, int] = {}
        for name in names:
            kinds[str(name[0])] = kinds.get(str(name[0]), 0) + 1
        faults = [kind for kind in kinds if (kind,) not in WELL]
        untouched, touched = was.get(("untouched",), 0.0), was.get(("touched",), 0.0)
        well = untouched + touched
        ends = mend * (1.0 - well)
        stays = max(1.0 - begin * len(faults), 0.0)
        now = {}
        for name in names:
            if name == ("untouched",):
                p = stays * ((1 - touch) * untouched + touch * touched) + 0.5 * ends
            elif name == ("touched",):
                p = stays * ((1 - touch) * touched + touch * untouched) + 0.5 * ends
            else:
                p = begin * well / kinds[str(name[0])] + (1 - mend) * was.get(name, 0.0)
            now[name] = float(np.log(max(p, 1e-300)))
        return now
