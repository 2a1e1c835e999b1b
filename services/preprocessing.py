"""Preprocessing: from impedances to the network's input, following the paper's equations, and only where something
touches.

    d = (|Z| - |Z0|) / |Z0|                     against the untouched baseline (services/estimation/baseline.py)
    touched = d^T C^-1 d > threshold            C: noise, model error, drift (services/estimation/touch_decision.py)
    stack = RM d for a ladder of lambda         equation 1, RM = (J^T W J + lambda^2 R)^-1 J^T W, W = C^-1
    I_thresh = MReLU(H(I_pre) * I_pre)          equations 2 to 5, where the bundle has no network that does better

The matrices are the bundle's; see models/prereconstruction.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.prereconstruction import Operator
from protocol.frames import DeltaFrame, Frame, RawFrame, as_sent
from services.describe import BaselineNews, describe, force
from services.estimation import checks
from services.estimation.baseline import believed
from services.estimation.contact_drift import Reference
from services.estimation.drift import DriftRates
from services.estimation.electrodes import ElectrodeHealth, Verdict
from services.estimation.gain_steps import GainSteps
from services.estimation.plausibility import impossible
from services.estimation.status_bits import reasons_of
from services.estimation.tare import Baseline, NoBaseline
from services.estimation.touch_decision import FrameAverager, TouchDecision, sigma_of_mean
from services.estimation.touch_estimator import TouchEstimator
from services.kept_baseline import kept, take_over
from services.linearisation import Linearisation
from services.rolling_scans import RollingScans
from services.runtime.config import Skin
from services.runtime.stage import SEPARATE, Health, Refused, Stage, add_reason, inherited
from services.sentinel_scans import SentinelScans

Array = NDArray[np.float64]

LASTING_S = 2.0  # a change that no touch can make, and that lasts so long, is the skin's or the board's new state


class Preprocessing(Stage):
    """raw -> delta. K measurements in the bundle's pattern order."""

    reads = "raw"
    writes = ("delta",)
    stamp = "preprocess"
    commands = ("tare", "part")
    persists = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config = skin
        self.linearisation = Linearisation(name, bundle)
        self._build()
        self.gain = GainSteps(len(bundle.pattern))
        self.frame_averager = FrameAverager()
        self._news = BaselineNews()
        self._unchecked = checks.sentence(bundle)
        self._force = force(skin, bundle)
        self.sentinel_scans = SentinelScans(skin, bundle)
        self.rolling_scans = RollingScans(bundle)
        self.always_reconstruct = False  # offline: an image of every frame, touched or not
        self.reset()

    def _build(self) -> None:
        """What stands on the bundle in use."""
        self.bundle, skin = self.linearisation.bundle, self.config
        self.electrodes = ElectrodeHealth(self.bundle)
        rates = DriftRates(skin.tare.scale_per_s, skin.tare.contact_per_s)
        self.touch_estimator = TouchEstimator(
            self.bundle, rates, skin.tare.frames, skin.tare.tracking_s, skin.touch.false_alarms
        )
        self.baseline_estimator = self.touch_estimator.baseline_estimator
        self.touch_detector = self.touch_estimator.touch_detector
        self.pre = self.baseline_estimator.pre

    def between_frames(self) -> None:
        """A calibration that is ready is adopted while nothing touches."""
        if not self.linearisation.follows(self.touch_estimator.touched):
            return
        before, health = self.baseline_estimator, self.electrodes.state()
        self._build()
        self.baseline_estimator.succeed(before)
        self.electrodes.load(health)
        self._begin_anew()
        self._news = BaselineNews()

    def reset(self) -> None:
        self.sentinel_scans.scan = 0
        self.rolling_scans.reset()
        self._impossible_ns = 0  # since when every frame is of no touch
        self.gain.reset()
        self._counters = dict.fromkeys(("frames", "touched", "reconstructed", "held", "foreign", "gain_steps"), 0)
        self._foreign = ""
        self.frame_averager.reset()
        self.electrodes.reset()
        self.touch_estimator.reset()

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, RawFrame)
        out = DeltaFrame(**inherited(frame), calibration=self.linearisation.name)
        self._counters["frames"] += 1
        out.valid, out.reasons = as_sent(frame)  # measurements that failed are left out below
        for reason in reasons_of(frame.status):
            add_reason(out.reasons, reason)
        if not self.rolling_scans.due(frame, out.stamps):
            return [*self.rolling_scans.part(out, frame, self.baseline_estimator)]
        made = self._scan(out, frame)
        self.rolling_scans.judged(made, frame)
        return [made]

    def _scan(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        """What one scan says."""
        if frame.kind == "sentinel":
            return self._sentinel(out, frame)
        self.sentinel_scans.scan = 0
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
        found = self.electrodes(amplitude, frame.status, reference)
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
        return self._compare(out, amplitude - found.shift, found, learns=trusted and not separate)

    def _compare(self, out: DeltaFrame, amplitude: Array, found: Verdict, learns: bool) -> DeltaFrame:
        """Difference, decision, and the stack where one is needed."""
        measured = np.isfinite(self.baseline_estimator.sigma)
        live = found.live & measured & np.isfinite(amplitude)
        if not found.usable or live.sum() < len(live) / 2:
            out.valid = False
            live = measured & np.isfinite(amplitude) if np.isfinite(amplitude).sum() > len(live) / 2 else measured
            amplitude = np.where(np.isfinite(amplitude), amplitude, self.baseline_estimator.baseline.z0)  # type: ignore[union-attr]
        now_ns = out.stamps.get("sample", 0)
        d, found_now = self.touch_estimator(amplitude, live, now_ns)
        self.frame_averager.under(live, self.touch_detector.step)
        teaches = learns  # whether the baseline is to learn from this frame
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

    def prepare(self) -> bool:
        return self.touch_estimator.prepare()

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

    def _sentinel(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        valid = out.valid
        _unusable(out, "coarse", len(self.bundle.pattern))
        touched, reconstructed = self.touch_estimator.touched, self.frame_averager.scan
        self.sentinel_scans(out, frame, valid, self.baseline_estimator, touched, reconstructed)
        return out

    def _begin_anew(self) -> None:
        """There is another baseline."""
        self.electrodes.tared()
        self.touch_estimator.begin_anew()
        self.gain.reset()
        self.frame_averager.reset()

    def set_baseline(self, baseline: Baseline, age_s: float = 0.0) -> None:
        """Use this baseline, which is age_s older than the next frame, from that frame on."""
        self.baseline_estimator.set_baseline(baseline, age_s=age_s)
        self._begin_anew()

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        if name == "part":
            return {**self.rolling_scans.handed_on(int(args.get("scan", -1)))}
        if name != "tare":
            return super().command(name, args)
        try:
            baseline = self.baseline_estimator.tare(self.touch_estimator.touched, force=bool(args.get("force", False)))
        except NoBaseline as why:
            raise Refused(str(why)) from None
        self._begin_anew()
        relative = float(np.median(baseline.sigma / np.maximum(baseline.z0, 1e-12)))
        wanted = self.config.tare.calibrate and bool(args.get("calibrate", True))
        calibrating = wanted and self.linearisation.tared(baseline)
        answer = {"frames": baseline.frames, "snr_db": -20 * np.log10(max(relative, 1e-12)), "hash": baseline.hash}
        return answer | {"calibrating": calibrating, "problem": self.linearisation.problem if wanted else ""}

    def state(self) -> dict[str, Any]:
        return {
            "touched": self.touch_estimator.touched,
            "coarse": self.sentinel_scans.scan,
            "rolling": self.rolling_scans.state(),
            "impossible_ns": self._impossible_ns,
            "gain": self.gain.state(),
            "hold": self.frame_averager.state(),
            "electrodes": self.electrodes.state(),
            "judge": self.touch_detector.state(),
            **self.baseline_estimator.state(),
            **self.linearisation.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        try:
            self._load(state)
        except NoBaseline as why:
            raise Refused(str(why)) from None
        except (KeyError, TypeError, ValueError) as wrong:
            raise Refused(f"the saved state does not fit ({wrong}): reset") from None

    def _load(self, state: dict[str, Any]) -> None:
        if self.linearisation.load(state):
            self._build()
            self._news = BaselineNews()
        self.baseline_estimator.load(state)
        self.touch_estimator.touched = bool(state["touched"])
        self.sentinel_scans.scan = int(state.get("coarse", 0))
        self.rolling_scans.load(state.get("rolling", {}))
        self._impossible_ns = int(state.get("impossible_ns", 0))
        self.frame_averager.load(state["hold"], len(self.bundle.pattern))
        self.touch_detector.reset()
        # Older recordings have no more than that.
        if "judge" in state:
            self.touch_detector.load(state["judge"])
        if "gain" in state:
            self.gain.load(state["gain"])
        if "electrodes" in state:
            self.electrodes.load(state["electrodes"])

    def saved(self) -> dict[str, Any] | None:
        return kept(self.baseline_estimator)

    def restore(self, saved: dict[str, Any], age_s: float) -> None:
        if self.config.tare.calibrate and self.linearisation.restore(saved):
            self._build()
        try:
            take_over(self.baseline_estimator, saved, age_s, self.config.tare.max_age_s)
        except NoBaseline as why:
            raise Refused(str(why)) from None

    def warm_up(self) -> None:
        _ = self.baseline_estimator.evidence
        if self.config.scan == "adaptive":
            self.sentinel_scans.warm_up()
        if self.config.scan == "rolling":
            self.rolling_scans.warm_up()
        if self.baseline_estimator.baseline is not None:
            live = np.isfinite(self.baseline_estimator.sigma)
            operator, decision = self.touch_detector.operator(live, self.touch_estimator.noise(), 0)
            nothing = np.zeros(len(self.bundle.pattern))
            operator.stack(nothing)
            decision(nothing, False)

    def info(self) -> dict[str, Any] | None:
        if not self._news(self.baseline_estimator.baseline, self.baseline_estimator.last_sample_ns):
            return None
        estimator = self.baseline_estimator
        said = describe(self.config, self.bundle, self._force, estimator.baseline, estimator.revision)
        return said | {"mounting": self.linearisation.found} if self.linearisation.found else said

    def health(self) -> Health:
        problem = self._foreign or self.baseline_estimator.problem
        if not problem and self.baseline_estimator.baseline is None:
            problem = self.baseline_estimator.progress()
        problems = [*([problem] if problem else []), *self.electrodes.problems()]
        problems += [self.linearisation.problem] if self.linearisation.problem else []
        unchecked = [self._unchecked] if self._unchecked else []  # as the bundle is made: no warning
        return Health("WARN" if problems else "OK", [*problems, *unchecked], dict(self._counters))


def _unusable(out: DeltaFrame, reason: str, measurements: int) -> DeltaFrame:
    out.valid = False
    add_reason(out.reasons, reason)
    out.difference = np.zeros(measurements, np.float32)
    out.sigma = np.full(measurements, np.inf, np.float32)
    return out


if __name__ == "__main__":
    import sys

    from services.process import main, stages

    sys.exit(main("preprocessing", stages(Preprocessing)))
