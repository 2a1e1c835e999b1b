"""GainSteps finds steps of the board's gain over a skin's frames. The baseline takes a step over at once, or, where the
gain is grossly off, once it has lasted.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.estimation.gain import common_factor
from services.estimation.saved import shaped
from services.estimation.tare import Baseline
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

GROSS = 0.15  # relative: no gain of a sound board steps by more (RTIA and its calibration, a tenth)
LASTING_S = 1.0
PAST = 5  # frames that are kept: of a touch that moves slowly one alone is mostly noise
BACK = 0.01  # relative: a gross gain that ends leaves the gain that was there before it, within drift


class GainStep(NamedTuple):
    """A factor that the baseline is to take over. lasted: whether it has been there for LASTING_S already."""

    factor: float
    lasted: bool = False


class GainSteps:
    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.reset()

    def reset(self) -> None:
        self._past: list[Array] = []  # (K,) |Z| of the last frames, the newest last
        self._gross_ns = 0  # since when all measurements have another gain by far
        self._taken = 0.0  # gross factor that the baseline took over; 0: none that did not end

    @property
    def gross(self) -> bool:
        """Whether all measurements of the last frame have another gain by far."""
        return self._gross_ns > 0

    def __call__(self, amplitude: Array, baseline: Baseline, now_ns: int) -> GainStep | None:
        """The factor that a sound frame's |Z| (K,) has in common against the sound one before, to be taken over by the
        baseline.
        """
        past, self._past = self._past, [*self._past[1 - PAST :], amplitude.copy()]
        if not past or len(past[-1]) != len(amplitude):
            return None
        gross = self._gross(amplitude, baseline)
        if gross is not None and self._undoes(gross):
            return self._back(gross)
        if gross is not None:
            self._gross_ns = self._gross_ns or now_ns
            if (now_ns - self._gross_ns) * 1e-9 < LASTING_S:
                self._past = past  # a fault, which may end
                return None
            self._gross_ns, self._taken, self._past = 0, gross, self._past[-1:]
            return GainStep(gross, lasted=True)
        self._gross_ns = 0
        factor = self._stepped(past, amplitude, baseline)
        if factor is None:
            return None
        if self._undoes(factor):
            return self._back(factor)
        if abs(factor - 1) <= GROSS:
            return self._step(factor)
        # Under a touch, where the baseline tells nothing: said, and not taken over. The frames before had another gain.
        self._gross_ns, self._past = now_ns, self._past[-1:]
        return None

    def _stepped(self, past: list[Array], amplitude: Array, baseline: Baseline) -> float | None:
        """The factor between two frames: this one and the one before, or the one before that where the step came in
        the midst of a scan.
        """
        for skipped in (0, 1):
            known = past[: len(past) - skipped]
            if not known or not _differs(known[-1], amplitude):
                continue
            factor = _common(known[-1], amplitude, baseline)
            for earlier in known[-2::-1] if factor is None else ():  # a steady motion: the further, the surer
                factor = factor or _common(known[-1], amplitude, baseline, earlier)
            if factor is not None:
                self._past = [*known, amplitude.copy()]  # the scan of the step is of neither gain
                return factor
        return None

    def _undoes(self, factor: float) -> bool:
        """Whether a gross gain that the baseline took over ends: nothing needs to last for that."""
        return bool(self._taken) and abs(factor * self._taken - 1) < BACK

    def _back(self, factor: float) -> GainStep:
        self._gross_ns, self._taken = 0, 0.0
        return self._step(factor)

    def _step(self, factor: float) -> GainStep:
        """What the frames before the step would have been with the new gain is what the next ones are compared with."""
        self._past = [*(row * factor for row in self._past[:-1]), self._past[-1]]
        return GainStep(factor)

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
        return {"past": [row.copy() for row in self._past], "gross_ns": self._gross_ns, "taken": self._taken}

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        if "past" not in state:  # older recordings have the last frame alone
            state = {**state, "past": [] if state["before"] is None else [state["before"]]}
        self._past = [shaped(row, (self._k,), finite=False) for row in state["past"]]
        self._gross_ns, self._taken = int(state["gross_ns"]), float(state.get("taken", 0.0))


def _differs(before: Array, now: Array) -> bool:
    total = float(before.sum())
    return len(before) == len(now) and not abs(float(now.sum()) - total) < TUNING.gain_least * total


def _common(before: Array, now: Array, baseline: Baseline, earlier: Array | None = None) -> float | None:
    """now / before of two frames' |Z| (K,), where it is common to the measurements that count in all."""
    # A reading of zero has no gain to it: taken over, it would leave a baseline that nothing can follow any more.
    live = (baseline.z0 > 0) & np.isfinite(now) & (now > 0) & np.isfinite(baseline.sigma)
    for row in (before,) if earlier is None else (before, earlier):
        live &= np.isfinite(row) & (row > 0)
    sigma = np.where(live, baseline.sigma / np.where(live, baseline.z0, 1.0), np.inf)
    return common_factor(before, now, sigma, live, earlier=earlier)
