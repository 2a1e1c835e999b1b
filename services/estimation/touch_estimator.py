"""Whether something touches, decided together with drift: the baseline estimator and the touch detector at work."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.baseline import STEADY_S, BaselineEstimator
from services.estimation.drift import DriftRates
from services.estimation.evidence import Explanation
from services.estimation.saved import shaped
from services.estimation.tare import Baseline
from services.estimation.touch_detector import Noise, TouchDetector, TouchVerdict

Array = NDArray[np.float64]

STILL = 0.1  # of |d|: two scans that differ by less felt the same
READ_WITHIN = 5  # frames, after which drift is read from a touch that does not hold still
AS_BEFORE = 2.0  # standard deviations, rms over a frame: so far off an older baseline, that one was right


class TouchEstimator:
    """`touched` is what the last frame said."""

    def __init__(self, bundle: Bundle, rates: DriftRates, frames: int, tracking_s: float, false_alarms: float) -> None:
        """frames, tracking_s: see BaselineEstimator; false_alarms: see TouchDetector."""
        self.false_alarms = false_alarms
        self.baseline_estimator = BaselineEstimator(bundle, rates, frames, tracking_s)
        self.touch_detector = TouchDetector(self.baseline_estimator.pre, rates, false_alarms)
        self.touched = False
        self._forget()

    def _forget(self) -> None:
        """No touch waits for its drift to be read, and none was read from this one."""
        self._last: Array | None = None  # |Z| (K,) of the frame before, of a touch that waits
        self._waited = 0  # frames
        self._undrifted: Array | None = None  # |Z0| (K,) from before drift was read from this touch

    def reset(self) -> None:
        self.begin_anew()
        self.baseline_estimator.reset()

    def begin_anew(self) -> None:
        """There is another baseline."""
        self.touched = False
        self._forget()
        self.touch_detector.reset()

    @property
    def waits(self) -> bool:
        """Whether what drifted before this touch is not known yet: nothing measured under it is to be believed."""
        return self._last is not None

    def __call__(
        self, amplitude: Array, live: NDArray[np.bool_], now_ns: int, still: bool = False
    ) -> tuple[Array, TouchVerdict]:
        """The difference (K,) of a frame's |Z| (K,) and what it says. A touch that begins is compared with an older
        baseline. live (K,): measurements that count. still: nothing began or ended during this scan.
        """
        estimator, detector, noise = self.baseline_estimator, self.touch_detector, self.noise()
        self._take_back(amplitude, live, now_ns)
        d = estimator.difference(amplitude, live)
        since_s = estimator.since_s(now_ns)
        if self.waits or (not self.touched and detector.uncertain(since_s)):
            explained = estimator.explain(d, live, since_s, detector.creep.direction(now_ns))
            if explained.fits:
                return self._alone(d, amplitude, live, explained, now_ns, still)
            self._forget()
        found = detector(d, live, noise, since_s, now_ns, self.touched)
        if found.touched and not self.touched:
            estimator.begin_touch()
            d = estimator.difference(amplitude, live)
            found = detector.begin(d, live, noise, estimator.since_s(now_ns), now_ns)
        self.touched = found.touched
        return d, found

    def _alone(
        self, d: Array, amplitude: Array, live: NDArray[np.bool_], explained: Explanation, now_ns: int, still: bool
    ) -> tuple[Array, TouchVerdict]:
        """The same for a frame that no untouched one precedes for long: drift is estimated in the frame itself.

        Not in the first one of a touch: one that began during the scan is in some measurements only, and its shape
        there would be read as drift.
        """
        estimator, detector = self.baseline_estimator, self.touch_detector
        noise, limit = self.noise(), -float(np.log(self.false_alarms))
        self.touched = explained.odds > limit
        if not self.touched:
            self._forget()
        elif not (still or self._still(d, amplitude, live)):
            self._last, self._waited = amplitude.copy(), self._waited + 1
        else:
            self._forget()
            creep = detector.creep.direction(now_ns)
            if estimator.explain(d, live, STEADY_S, creep).as_good(explained):
                estimator.steady(now_ns)  # no drift is read into noise
            else:
                self._undrifted = self.baseline.z0.copy()
                estimator.drifted(explained.drift, now_ns, creep)
                d = estimator.difference(amplitude, live)
        found = detector.begin(d, live, noise, estimator.since_s(now_ns), now_ns, alone=self.touched)
        return d, found._replace(touched=self.touched, score=explained.odds, threshold=limit)

    def _take_back(self, amplitude: Array, live: NDArray[np.bool_], now_ns: int) -> None:
        """Nothing had drifted where the skin is as it was before: what was read as drift was a part of the touch."""
        if self._undrifted is None:
            return
        estimator = self.baseline_estimator
        known = live & (self._undrifted > 0) & np.isfinite(estimator.sigma)
        off = (amplitude - self._undrifted)[known] / (estimator.normaliser * estimator.sigma)[known]
        if 2 * known.sum() >= len(known) and float(np.mean(off**2)) <= AS_BEFORE**2:
            estimator.undrifted(self._undrifted, now_ns)
            self._undrifted = None

    def _still(self, d: Array, amplitude: Array, live: NDArray[np.bool_]) -> bool:
        """Whether the frame before felt the same touch, or enough were waited for."""
        if self._last is None:
            return False
        changed = np.where(live & np.isfinite(self._last), amplitude - self._last, 0.0)
        small = np.linalg.norm(changed / self.baseline_estimator.normaliser) <= STILL * np.linalg.norm(d)
        return bool(small) or self._waited >= READ_WITHIN

    def learn(self, amplitude: Array, live: NDArray[np.bool_], now_ns: int) -> None:
        """The baseline follows the frame that was decided last."""
        if self.touched:
            self.baseline_estimator.touched(amplitude, live, now_ns)
        else:
            self._undrifted = None
            self.baseline_estimator.untouched(amplitude, live, now_ns, self.touch_detector.creep)

    def state(self) -> dict[str, Any]:
        last, undrifted = (None if row is None else row.copy() for row in (self._last, self._undrifted))
        return {"last": last, "waited": self._waited, "undrifted": undrifted}

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self._forget()
        shape = (self.baseline_estimator.pre.measurements,)
        if state["last"] is not None:
            self._last = shaped(state["last"], shape, finite=False)
            self._waited = int(state["waited"])
        if state.get("undrifted") is not None:
            self._undrifted = shaped(state["undrifted"], shape)

    @property
    def baseline(self) -> Baseline:
        found = self.baseline_estimator.baseline
        assert found is not None, "no frame is judged before there is a baseline"
        return found

    def noise(self) -> Noise:
        baseline = self.baseline
        return Noise(self.baseline_estimator.sigma, baseline.frames, baseline.noise_frames)

    def prepare(self) -> bool:
        """Do one piece of what will be needed next; False where nothing is left."""
        return self.baseline_estimator.baseline is not None and self.touch_detector.prepare(self.noise())
