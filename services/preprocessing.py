"""Preprocessing: from impedances to the network's input, following the paper's equations, and only where something
touches.

    d = (|Z| - |Z0|) / |Z0|                     against the untouched baseline (services/estimation/baseline.py)
    touched = d^T C^-1 d > threshold            C: noise, model error, drift (services/estimation/touch_decision.py)
    stack = RM d for a ladder of lambda         equation 1, RM = (J^T W J + lambda^2 R)^-1 J^T W, W = C^-1
    I_thresh = MReLU(H(I_pre) * I_pre)          equations 2 to 5, where the bundle has no network that does better

The matrices are the bundle's; see models/prereconstruction.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Operator
from protocol.frames import DeltaFrame, Frame, RawFrame, as_sent
from services.estimation.baseline import believed
from services.estimation.contact_drift import Reference
from services.estimation.electrodes import ElectrodeVerdict
from services.estimation.plausibility import impossible
from services.estimation.status_bits import reasons_of
from services.estimation.touch_decision import TouchDecision, sigma_of_mean
from services.estimator_stage import EstimatorStage
from services.runtime.stage import SEPARATE, add_reason, inherited

Array = NDArray[np.float64]

LASTING_S = 2.0  # a change that no touch can make, and that lasts so long, is the skin's or the board's new state


class Preprocessing(EstimatorStage):
    """raw -> delta; of scans in parts also part. K measurements in the bundle's pattern order."""

    reads = "raw"
    writes = ("delta", "part")
    stamp = "preprocess"

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, RawFrame)
        out = DeltaFrame(**inherited(frame), calibration=self.linearisation.name)
        self._counters["frames"] += 1
        self.frame_rate(frame)
        out.valid, out.reasons = as_sent(frame)  # measurements that failed are left out below
        if frame.kind != "sentinel" and self.continuity.broken(frame, frame.parts):
            add_reason(out.reasons, "gap")
            self.rolling_scans.missed()
        for reason in reasons_of(frame.status):
            add_reason(out.reasons, reason)
        if not self.rolling_scans.due(frame, out.stamps, self.baseline_estimator):
            return [*self.rolling_scans.part(out, frame, self.baseline_estimator)]
        made = self._scan(out, frame)
        self.rolling_scans.judged(made, frame, self.baseline_estimator)
        return [made]

    def _scan(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        """What one scan says."""
        if frame.kind == "sentinel":  # of a recording made by an earlier version: no contacts are made of it
            return _unusable(out, "coarse", len(self.bundle.pattern))
        if len(frame.z) != len(self.bundle.pattern):
            return self._no_scan(out, frame)
        self._foreign = ""
        self.baseline_estimator.follow(frame)
        amplitude = np.abs(frame.z.astype(np.complex128))
        known = self.baseline_estimator.baseline
        separate = SEPARATE in frame.reasons
        if known is None or separate:
            self.gain.reset()
        elif not frame.status.any():
            # Frames with marks are passed over: their end would be taken for a step back from a gain never taken over.
            step = self.gain(amplitude, known, out.stamps.get("sample", 0))
            if step is not None:
                self._counters["gain_steps"] += 1
                self.baseline_estimator.rescale(step.factor)
                self.electrodes.rescale(step)
                known = self.baseline_estimator.baseline
            if step is not None or self.gain.gross:
                add_reason(out.reasons, "gain")
        if separate:
            self.electrodes.reset()
            self._begin_anew()
            self._impossible_ns = 0
            known = None if frame.kind == "reference" else known  # of another scan, perhaps of another day
        reference = (
            Reference(known.z0, self.baseline_estimator.normaliser, self.baseline_estimator.sigma) if known else None
        )
        if (placed := self.rolling_scans.placed) is not None:
            self.electrodes.touch_began(placed)
        found = self.electrodes(amplitude, frame.status, reference, out.stamps.get("sample", 0) * 1e-9)
        out.electrodes = found.states
        for reason in found.reasons:
            add_reason(out.reasons, reason)
        if found.order is not None:
            amplitude = amplitude[found.order]
        amplitude[found.failed] = np.nan
        if self.baseline_estimator.offer(amplitude, frame, separate):
            self._begin_anew()
        if self.baseline_estimator.baseline is None:
            reason = "touched_at_start" if self.baseline_estimator.touched_at_start else "stale_baseline"
            return _unusable(out, reason, len(amplitude))
        if self.baseline_estimator.baseline.doubt:
            out.valid = False
            add_reason(out.reasons, "stale_baseline")
        if frame.kind == "reference":  # untouched, as the file says: there is nothing to decide
            out.difference = np.zeros(len(amplitude), np.float32)
            out.sigma = np.asarray(self.baseline_estimator.sigma, np.float32)
            return out
        if not (trusted := believed(frame)):
            self.frame_averager.reset()  # a mean of the same scan again and again is no surer
        return self._compare(out, amplitude - found.shift, found, trusted, separate)

    def _compare(
        self, out: DeltaFrame, amplitude: Array, found: ElectrodeVerdict, trusted: bool, separate: bool
    ) -> DeltaFrame:
        """Difference, decision, and the stack where one is needed."""
        measured = np.isfinite(self.baseline_estimator.sigma)
        live = found.live & measured & np.isfinite(amplitude)
        if not found.usable or live.sum() < len(live) / 2:
            out.valid = False
            live = measured & np.isfinite(amplitude) if np.isfinite(amplitude).sum() > len(live) / 2 else measured
            amplitude = np.where(np.isfinite(amplitude), amplitude, self.baseline_estimator.baseline.z0)  # type: ignore[union-attr]
        now_ns = out.stamps.get("sample", 0)
        still = separate or self.always_reconstruct  # a row of a file: whoever measured it waited
        d, found_now = self.touch_estimator(amplitude, live, now_ns, still)
        if self.touch_estimator.touched and self.rolling_scans.change is not None:
            d = d + self.rolling_scans.change
        if self.touch_estimator.waits:
            out.valid = False
            add_reason(out.reasons, "stale_baseline")
        self.frame_averager.under(live, self.touch_detector.step)
        teaches = learns = trusted and not separate  # whether the baseline is to learn from this frame
        # Measured bundles have no sign model, so this check is skipped.
        if self.bundle.matrices.normalisation == "model" and impossible(
            d, self.baseline_estimator.sigma, live & self.electrodes.check.self_sensing, self.touch_estimator.touched
        ):
            out.valid = False
            add_reason(out.reasons, "out_of_distribution")
            self._impossible_ns = self._impossible_ns or now_ns
            teaches = learns and (now_ns - self._impossible_ns) * 1e-9 >= LASTING_S
        else:
            self._impossible_ns = 0
        out.touched, out.score, out.threshold = self.touch_estimator.touched, found_now.score, found_now.threshold
        out.difference = d.astype(np.float32)
        out.sigma = np.where(live, self.baseline_estimator.sigma, np.inf).astype(np.float32)
        self._counters["touched"] += self.touch_estimator.touched
        if not self.touch_estimator.touched:
            self.frame_averager.reset()
        if teaches:
            self.touch_estimator.learn(amplitude, live, now_ns)
        if self.touch_estimator.touched or self.always_reconstruct or not self.config.touch.skip_untouched:
            self._reconstruct(out, d, found_now.operator, found_now.decision)
        return out

    def _reconstruct(self, out: DeltaFrame, d: Array, operator: Operator, decision: TouchDecision) -> None:
        if self.touch_estimator.touched and self.config.touch.hold and not self.always_reconstruct:
            mean = self.frame_averager(d, out.scan, decision)
            out.reconstructed = self.frame_averager.scan
            if mean is None:
                out.held = True
                self._counters["held"] += 1
                return
            d = mean
            if self.frame_averager.averaged > 1:
                operator = self.touch_detector.of_mean(self.frame_averager.averaged, self.touch_estimator.noise())
            out.difference = d.astype(np.float32)
            out.sigma = sigma_of_mean(out.sigma, self.frame_averager.averaged)
        out.reconstructed = out.scan
        out.stack, out.context, out.scale = operator.stack(d)
        self._counters["reconstructed"] += 1

    def _no_scan(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        """A frame that cannot be compared with the baseline: another skin's."""
        self._counters["foreign"] += 1
        found, expected = len(frame.z), len(self.bundle.pattern)
        self._foreign = f"frames of {found} measurements, the bundle {self.bundle.name} has {expected}"
        return _unusable(out, "out_of_distribution", len(self.bundle.pattern))


def _unusable(out: DeltaFrame, reason: str, measurements: int) -> DeltaFrame:
    out.valid = False
    add_reason(out.reasons, reason)
    out.difference = np.zeros(measurements, np.float32)
    out.sigma = np.full(measurements, np.inf, np.float32)
    return out


if __name__ == "__main__":
    import sys

    from services.pipeline import preprocessing
    from services.process import main, stages

    sys.exit(main("preprocessing", stages(preprocessing)))
