"""The estimators of one skin: made for the bundle in use, begun anew by a tare, and kept across restarts.

What they do with a frame is in services/preprocessing.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from models.bundle import Bundle
from services.describe import BaselineNews, FrameRate, describe, force, refinement, symmetry
from services.estimation import checks
from services.estimation.drift import DriftRates
from services.estimation.electrodes import ElectrodeHealth
from services.estimation.gain_steps import GainSteps
from services.estimation.tare import Baseline, NoBaseline
from services.estimation.touch_decision import FrameAverager
from services.estimation.touch_estimator import TouchEstimator
from services.kept_baseline import kept, take_over
from services.linearisation import Linearisation
from services.rolling_scans import RollingScans
from services.runtime.config import Skin
from services.runtime.continuity import Continuity
from services.runtime.stage import Health, Refused, Stage


class EstimatorStage(Stage):
    """Everything of preprocessing but the way of a frame: commands, kept state, what info and status say."""

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
        self.frame_rate, self.continuity = FrameRate(), Continuity()
        self._unchecked = checks.sentence(bundle)
        self._force, self._symmetry = force(skin, bundle), symmetry(skin, bundle)
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

    @property
    def baseline(self) -> Baseline | None:
        return self.baseline_estimator.baseline

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
        self.rolling_scans.reset()
        self.continuity.forget()
        self._impossible_ns = 0  # since when every frame is of no touch
        self.gain.reset()
        self._counters = dict.fromkeys(("frames", "touched", "reconstructed", "held", "foreign", "gain_steps"), 0)
        self._foreign = ""
        self.frame_averager.reset()
        self.electrodes.reset()
        self.touch_estimator.reset()

    def prepare(self) -> bool:
        return self.touch_estimator.prepare()

    def _begin_anew(self) -> None:
        """There is another baseline."""
        self.electrodes.tared()
        self.touch_estimator.begin_anew()
        self.rolling_scans.begin_anew()
        self.gain.reset()
        self.frame_averager.reset()

    def set_baseline(self, baseline: Baseline, age_s: float = 0.0) -> None:
        """Use this baseline, which is age_s older than the next frame, from that frame on."""
        self.baseline_estimator.set_baseline(baseline, age_s=age_s)
        self._begin_anew()

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        if name == "part":
            return {**self.rolling_scans.handed_on(args["scan"])}
        if name != "tare":
            return super().command(name, args)
        try:
            # A baseline with which frames are of no touch is wrong, and so is its word that something touches.
            force = args.get("force", False) or self._impossible_ns > 0
            baseline = self.baseline_estimator.tare(self.touch_estimator.touched, force)
        except NoBaseline as why:
            raise Refused(str(why)) from None
        self._begin_anew()
        relative = float(np.median(baseline.sigma / np.maximum(baseline.z0, 1e-12)))
        wanted = self.config.tare.calibrate and args.get("calibrate", True)
        calibrating = wanted and self.linearisation.tared(baseline)
        answer = {"frames": baseline.frames, "snr_db": -20 * np.log10(max(relative, 1e-12)), "hash": baseline.hash}
        return answer | {"calibrating": calibrating, "problem": self.linearisation.problem if wanted else ""}

    def state(self) -> dict[str, Any]:
        return {
            "touched": self.touch_estimator.touched,
            "waits": self.touch_estimator.state(),
            "rolling": self.rolling_scans.state(),
            "continuity": self.continuity.state(),
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
        self.touch_estimator.load(state.get("waits", {"last": None}))
        self.rolling_scans.load(state.get("rolling", {}))
        self.continuity.load(state.get("continuity"))
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
        if self.config.scan == "rolling":
            self.rolling_scans.warm_up()
        if self.baseline_estimator.baseline is not None:
            live = np.isfinite(self.baseline_estimator.sigma)
            operator, decision = self.touch_detector.operator(live, self.touch_estimator.noise(), 0)
            nothing = np.zeros(len(self.bundle.pattern))
            operator.stack(nothing)
            decision(nothing, False)

    def info(self) -> dict[str, Any] | None:
        estimator, rate_hz = self.baseline_estimator, self.frame_rate.found
        if not self._news(estimator.baseline, estimator.last_sample_ns, rate_hz):
            return None
        said = describe(self.config, self.bundle, self._force, estimator.baseline, estimator.revision, rate_hz)
        said["refinement"] = refinement(self.config, self.bundle, bool(self.linearisation.name))
        said["symmetry"] = self._symmetry
        return said | {"mounting": self.linearisation.found} if self.linearisation.found else said

    def health(self) -> Health:
        problem = self._foreign or self.baseline_estimator.problem
        if not problem and self.baseline_estimator.baseline is None:
            problem = self.baseline_estimator.progress()
        problems = [*([problem] if problem else []), *self.electrodes.problems()]
        problems += [self.linearisation.problem] if self.linearisation.problem else []
        unchecked = [self._unchecked] if self._unchecked else []  # as the bundle is made: no warning
        return Health("WARN" if problems else "OK", [*problems, *unchecked], dict(self._counters))
