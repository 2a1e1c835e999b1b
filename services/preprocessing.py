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
from services.board.boardlink import Scanning
from services.describe import BaselineNews, describe
from services.estimation import checks
from services.estimation.baseline import STEADY_S, BaselineEstimator, believed
from services.estimation.contact_drift import Reference
from services.estimation.electrodes import ElectrodeHealth, Verdict
from services.estimation.evidence import Explanation
from services.estimation.gain_steps import GainSteps
from services.estimation.plausibility import impossible
from services.estimation.sentinel import Coarse, sentinel_of
from services.estimation.status_bits import reasons_of
from services.estimation.tare import Baseline
from services.estimation.touch_decision import FrameAverager, TouchDecision, sigma_of_mean
from services.estimation.touch_detector import Noise, TouchDetector, TouchVerdict
from services.runtime.config import Skin
from services.runtime.stage import SEPARATE, Health, Refused, Stage, add_reason, inherited

Array = NDArray[np.float64]

LASTING_S = 2.0  # a change that no touch can make, and that lasts so long, is the skin's or the board's new state


class Preprocessing(Stage):
    """raw -> delta. K measurements in the bundle's pattern order."""

    reads = "raw"
    writes = ("delta",)
    stamp = "preprocess"
    commands = ("tare",)
    persists = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config, self.bundle = skin, bundle
        self.electrodes = ElectrodeHealth(bundle)
        self.untouched = BaselineEstimator(bundle, skin.tare)
        self.pre = self.untouched.pre
        self.judge = TouchDetector(self.pre, skin)
        self.gain = GainSteps(len(bundle.pattern))
        self.hold = FrameAverager()
        self._news = BaselineNews()
        self._unchecked = checks.sentence(bundle)
        self._coarse: Coarse | None = None  # made with the first sentinel scan
        self.always_reconstruct = False  # offline: an image of every frame, touched or not
        self.reset()

    def reset(self) -> None:
        self._touched = False
        self._coarse_scan = 0  # of the coarse touch that no full scan has answered yet
        self._impossible_ns = 0  # since when every frame is of no touch
        self.gain.reset()
        self._counters = dict.fromkeys(("frames", "touched", "reconstructed", "held", "foreign", "gain_steps"), 0)
        self._foreign = ""
        self.hold.reset()
        self._live: NDArray[np.bool_] | None = None  # measurements that counted in the last frame
        self.electrodes.reset()
        self.judge.reset()
        self.untouched.reset()

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, RawFrame)
        out = DeltaFrame(**inherited(frame))
        self._counters["frames"] += 1
        out.valid, out.reasons = as_sent(frame)  # measurements that failed are left out below
        for reason in reasons_of(frame.status):
            add_reason(out.reasons, reason)
        if frame.kind == "sentinel":
            return [self._sentinel(out, frame)]
        self._coarse_scan = 0
        if len(frame.z) != len(self.bundle.pattern):
            return [self._no_scan(out, frame)]
        self._foreign = ""
        self.untouched.follow(frame)
        amplitude = np.abs(frame.z.astype(np.complex128))
        known = self.untouched.baseline
        separate = SEPARATE in frame.reasons
        if known is None or separate:
            self.gain.reset()
        elif not frame.status.any():
            # Frames with marks are passed over: their end would be taken for a step back from a gain never taken over.
            step = self.gain(amplitude, known, out.stamps.get("sample", 0))
            if step is not None:
                self._counters["gain_steps"] += 1
                self.untouched.rescale(step.factor)
                self.electrodes.rescale(step)
                known = self.untouched.baseline
            if step is not None or self.gain.gross:
                add_reason(out.reasons, "gain")
        if separate:
            self.electrodes.reset()
            self._begin_anew()
            self._impossible_ns = 0
            known = None if frame.kind == "reference" else known  # of another scan, perhaps of another day
        reference = Reference(known.z0, self.untouched.normaliser, self.untouched.sigma) if known else None
        found = self.electrodes(amplitude, frame.status, reference)
        out.electrodes = found.states
        for reason in found.reasons:
            add_reason(out.reasons, reason)
        if found.order is not None:
            amplitude = amplitude[found.order]
        amplitude[found.failed] = np.nan
        if self.untouched.offer(amplitude, frame):
            self._begin_anew()
        if self.untouched.baseline is None:
            reason = "touched_at_start" if self.untouched.touched_at_start else "stale_baseline"
            return [_unusable(out, reason, len(amplitude))]
        if self.untouched.baseline.doubt:
            out.valid = False
            add_reason(out.reasons, "stale_baseline")
        if frame.kind == "reference":  # untouched, as the file says: there is nothing to decide
            out.difference = np.zeros(len(amplitude), np.float32)
            out.sigma = np.asarray(self.untouched.sigma, np.float32)
            return [out]
        if not (trusted := believed(frame)):
            self.hold.reset()  # a mean of the same scan again and again is no surer
        return [self._compare(out, amplitude - found.shift, found, learns=trusted and not separate)]

    def _compare(self, out: DeltaFrame, amplitude: Array, found: Verdict, learns: bool) -> DeltaFrame:
        """Difference, decision, and the stack where one is needed."""
        measured = np.isfinite(self.untouched.sigma)
        live = found.live & measured & np.isfinite(amplitude)
        if not found.usable or live.sum() < len(live) / 2:
            out.valid = False
            live = measured & np.isfinite(amplitude) if np.isfinite(amplitude).sum() > len(live) / 2 else measured
            amplitude = np.where(np.isfinite(amplitude), amplitude, self.untouched.baseline.z0)  # type: ignore[union-attr]
        if self._live is not None and (self._live != live).any():
            self.hold.reset()  # its frames had other measurements
        self._live = live
        d = self.untouched.difference(amplitude, live)
        d, found_now = self._decide(d, amplitude, live, out.stamps.get("sample", 0))
        now_ns = out.stamps.get("sample", 0)
        teaches = learns  # whether the baseline is to learn from this frame
        # Measured bundles have no sign model, so this check is skipped.
        if self.bundle.matrices.normalisation == "model" and impossible(
            d, self.untouched.sigma, live & self.electrodes.check.self_sensing, self._touched
        ):
            out.valid = False
            add_reason(out.reasons, "out_of_distribution")
            self._impossible_ns = self._impossible_ns or now_ns
            teaches = learns and (now_ns - self._impossible_ns) * 1e-9 >= LASTING_S
        else:
            self._impossible_ns = 0
        out.touched, out.score, out.threshold = self._touched, found_now.score, found_now.threshold
        out.difference = d.astype(np.float32)
        out.sigma = np.where(live, self.untouched.sigma, np.inf).astype(np.float32)
        if self._touched:
            self._counters["touched"] += 1
            if teaches:
                self.untouched.touched(amplitude, live, now_ns)
        else:
            self.hold.reset()
            if teaches:
                self.untouched.untouched(amplitude, live, now_ns, self.judge.creep)
        if self._touched or self.always_reconstruct or not self.config.touch.skip_untouched:
            self._reconstruct(out, d, found_now.operator, found_now.decision)
        return out

    def _decide(self, d: Array, amplitude: Array, live: NDArray[np.bool_], now_ns: int) -> tuple[Array, TouchVerdict]:
        """Touched or not, and the difference, which a touch that begins has against an older baseline."""
        noise, step = self._noise(), self.judge.step
        if not self._touched and self.judge.uncertain(self.untouched.since_s(now_ns)):
            creep = self.judge.creep.direction(now_ns)
            explained = self.untouched.explain(d, live, self.untouched.since_s(now_ns), creep)
            if explained.fits:
                return self._decide_alone(d, amplitude, live, explained, now_ns)
        found = self.judge(d, live, noise, self.untouched.since_s(now_ns), now_ns, self._touched)
        if found.touched and not self._touched:
            self.untouched.begin_touch()
            d = self.untouched.difference(amplitude, live)
            found = self.judge.begin(d, live, noise, self.untouched.since_s(now_ns), now_ns)
        elif self.judge.step != step:
            self.hold.reset()  # the same frames make another image now
        self._touched = found.touched
        return d, found

    def _decide_alone(
        self, d: Array, amplitude: Array, live: NDArray[np.bool_], explained: Explanation, now_ns: int
    ) -> tuple[Array, TouchVerdict]:
        """The same for a frame that no untouched one precedes for long: drift is estimated in the frame itself."""
        noise, limit = self._noise(), -float(np.log(self.config.touch.false_alarms))
        self._touched = explained.odds > limit
        if self._touched:
            creep = self.judge.creep.direction(now_ns)
            if self.untouched.explain(d, live, STEADY_S, creep).as_good(explained):
                self.untouched.steady(now_ns)  # no drift is read into noise
            else:
                self.untouched.drifted(explained.drift, now_ns, creep)
                d = self.untouched.difference(amplitude, live)
        found = self.judge.begin(d, live, noise, self.untouched.since_s(now_ns), now_ns, alone=self._touched)
        return d, found._replace(touched=self._touched, score=explained.odds, threshold=limit)

    def _noise(self) -> Noise:
        assert self.untouched.baseline is not None
        return Noise(self.untouched.sigma, self.untouched.baseline.frames, self.untouched.baseline.noise_frames)

    def prepare(self) -> bool:
        return self.untouched.baseline is not None and self.judge.prepare(self._noise())

    def _reconstruct(self, out: DeltaFrame, d: Array, operator: Operator, decision: TouchDecision) -> None:
        if self._touched and self.config.touch.hold and not self.always_reconstruct:
            mean = self.hold(d, out.scan, decision)
            out.reconstructed = self.hold.scan
            if mean is None:
                out.held = True
                self._counters["held"] += 1
                return
            d = mean
            if self.hold.averaged > 1:
                operator = self.judge.of_mean(self.hold.averaged, self._noise())
            out.difference = d.astype(np.float32)
            out.sigma = sigma_of_mean(out.sigma, self.hold.averaged)
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
        """A scan of the short list: whether something begins to touch. What touched before goes on until a full one."""
        valid, known = out.valid, self.untouched.baseline
        _unusable(out, "coarse", len(self.bundle.pattern))
        if self._coarse is None:
            self._coarse = self._coarse_judge()
        if known is None or known.doubt or not self._coarse.fits(frame):
            return out
        out.valid = valid
        if self._touched:
            out.touched = out.held = True
            out.reconstructed = self.hold.scan
        else:
            self._coarse_scan = self._coarse(
                out, frame, known.z0, self.untouched.normaliser, self.untouched.sigma, self._coarse_scan
            )
        return out

    def _coarse_judge(self) -> Coarse:
        short = Scanning(
            self.bundle.pattern[sentinel_of(self.bundle).rows], self.config.dft_points, self.config.rtia_ohm
        )
        return Coarse(self.bundle, short.config, self.config.touch.false_alarms)

    def _begin_anew(self) -> None:
        """There is another baseline."""
        self.electrodes.tared()
        self.judge.reset()
        self.gain.reset()
        self._touched = False
        self.hold.reset()

    def set_baseline(self, baseline: Baseline, age_s: float = 0.0) -> None:
        """Use this baseline, which is age_s older than the next frame, from that frame on."""
        self.untouched.set_baseline(baseline, age_s=age_s)
        self._begin_anew()

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        if name != "tare":
            return super().command(name, args)
        baseline = self.untouched.tare(self._touched, force=bool(args.get("force", False)))
        self._begin_anew()
        relative = float(np.median(baseline.sigma / np.maximum(baseline.z0, 1e-12)))
        return {"frames": baseline.frames, "snr_db": -20 * np.log10(max(relative, 1e-12)), "hash": baseline.hash}

    def state(self) -> dict[str, Any]:
        return {
            "touched": self._touched,
            "coarse": self._coarse_scan,
            "impossible_ns": self._impossible_ns,
            "gain": self.gain.state(),
            "hold": self.hold.state(),
            "electrodes": self.electrodes.state(),
            "judge": self.judge.state(),
            **self.untouched.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        self.untouched.load(state)
        k, hold = len(self.bundle.pattern), state["hold"]
        for rows in (hold["reference"], *hold["recent"]):
            if rows is not None and np.shape(rows) != (k,):
                raise Refused(f"the saved hold is of shape {np.shape(rows)}, expected ({k},): reset")
        self._touched = bool(state["touched"])
        self._coarse_scan = int(state.get("coarse", 0))
        self._impossible_ns = int(state.get("impossible_ns", 0))
        self.hold.load(state["hold"])
        self.judge.reset()
        if "judge" in state:  # older recordings have none
            try:
                self.judge.load(state["judge"])
            except (KeyError, TypeError, ValueError) as wrong:
                raise Refused(f"the saved decision on drift does not fit ({wrong}): reset") from None
        if "gain" in state:  # older recordings have none
            self.gain.load(state["gain"])
        if "electrodes" in state:  # older recordings have none
            self.electrodes.load(state["electrodes"])

    def saved(self) -> dict[str, Any] | None:
        return self.untouched.saved()

    def restore(self, saved: dict[str, Any], age_s: float) -> None:
        self.untouched.restore(saved, age_s)

    def warm_up(self) -> None:
        _ = self.untouched.evidence
        if self.config.scan == "adaptive":
            self._coarse = self._coarse_judge()
        if self.untouched.baseline is not None:
            operator, decision = self.judge.operator(np.isfinite(self.untouched.sigma), self._noise(), 0)
            nothing = np.zeros(len(self.bundle.pattern))
            operator.stack(nothing)
            decision(nothing, False)

    def info(self) -> dict[str, Any] | None:
        if not self._news(self.untouched.baseline, self.untouched.last_sample_ns):
            return None
        return describe(self.config, self.bundle, self.untouched.baseline, self.untouched.revision)

    def health(self) -> Health:
        problem = self._foreign or self.untouched.problem
        if not problem and self.untouched.baseline is None:
            problem = self.untouched.progress()
        problems = [*([problem] if problem else []), *self.electrodes.problems()]
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
