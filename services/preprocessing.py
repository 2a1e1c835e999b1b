"""Preprocessing by one model: from impedances to the touches that explain them, and to what an image is made of.

scan -> Estimator (services/estimation/estimator.py) -> Estimate: touches, what is left, judgements
difference -> what an image is to be made of, where something touches and changed
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.calibration_file import found_by
from models.measurement.tables import skin_tables
from protocol.frames import DeltaFrame, EstimatedTouch, Frame, PartFrame, RawFrame, as_sent
from services.contacts.lasting import LASTS_NS
from services.describe import BaselineNews, FrameRate, describe, force, symmetry
from services.estimation.estimator import LAYOUT, Estimator
from services.estimation.faults.advice import sentences, unchecked
from services.estimation.images import Operators, Reconstructed, Reconstruction, sigma_of_mean
from services.estimation.initialisation.baseline import TAKING, Baseline, NoBaseline, References, plausible_noise
from services.estimation.tared import KnownBaseline
from services.estimation.values.estimate import Estimate, Judgement, TouchEstimate
from services.estimation.values.scan import Scan
from services.estimation.values.state import saved
from services.judged import judged
from services.linearisation import Linearisation
from services.runtime.config import Skin
from services.runtime.continuity import Continuity
from services.runtime.stage import SEPARATE, Health, Refused, Stage, add_reason, inherited, invalidate

Array = NDArray[np.float64]

LONGEST_S = 1e9  # an age that is longer is none
SAVE_EVERY = 512  # untouched scans after which the tracked baseline is worth keeping again
PLACE_SIGMA = 1e-4  # m: no table knows a place better
MOST_LOG = 3.0  # of |Z| over the baseline: no image is made of what is larger, no touch does it


class Preprocessing(Stage):
    """raw -> delta; of scans in parts also part; judgements where asked. K measurements in the bundle's order."""

    reads = "raw"
    writes = ("delta", "part", "judgements")
    stamp = "preprocess"
    commands = ("tare", "part")
    persists = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config = skin
        self.linearisation = Linearisation(name, bundle)
        self._unchecked = unchecked(bundle)
        self._force, self._symmetry = force(skin, bundle), symmetry(skin, bundle)
        self.always_reconstruct = False  # offline: an image of every scan, touched or not
        self.each_alone = False  # offline: frames that do not follow each other
        self.frame_rate, self._news = FrameRate(), BaselineNews()
        self.revision = 0  # of the baseline
        self._announced_hash = ""  # of the baseline that info had last
        self._build()
        self.reset()

    def _build(self) -> None:
        """What stands on the bundle in use."""
        self.bundle = self.linearisation.bundle
        self.pre = self.bundle.prereconstructor()
        tare = self.config.tare
        self._reconstruction = Reconstruction(Operators(self.pre, tare.scale_per_s, tare.contact_per_s))

    def reset(self) -> None:
        self._forget_baseline()
        self.continuity = Continuity()
        self.references = References(len(self.bundle.pattern))
        self._counters = dict.fromkeys(("frames", "touched", "reconstructed", "held", "foreign", "gain_steps"), 0)
        self._foreign = self._problem = self._source = self._board = ""
        self._before: Scan | None = None
        self._estimate: Estimate | None = None  # the newest
        self._judged: DeltaFrame | None = None  # frame processed last, where that estimate is its
        self._touched = self._keep = False
        self._announced_ns = -LASTS_NS  # `sample` of the last message that had touches, or their end
        self._part = (-1, -1)  # messages last seen, and last handed on
        self._delta = 0  # scan of the last delta frame
        self._sample_ns, self._since_saved = 0, 0
        self._gain_steps = 0  # of this baseline, that were counted
        self._undated_s = 0.0  # age of a baseline that an earlier process took, until the first scan

    def _forget_baseline(self) -> None:
        self.estimator = Estimator(skin_tables(self.bundle), self.config.tare.frames)
        self._trusted: Baseline | None = None  # too old to be used: the first scans are held against it
        self._use(None)

    def _use(self, baseline: Baseline | None) -> None:
        self.baseline, self._tared = baseline, self.estimator.skin
        self.revision += 1
        if baseline is None:
            return
        if baseline.taken_by == "file" and self.references.now.noise is not None:
            sigma = self.references.sigma(baseline, self.pre)
        else:
            sigma = baseline.sigma / self.pre.normaliser(baseline.z0)
        self._reconstruction.begin(sigma, baseline.frames)

    # --- one scan, or the newest values after a part of one ---

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, RawFrame)
        out = DeltaFrame(**inherited(frame), calibration=self.linearisation.name)
        self._counters["frames"] += 1
        self._judged = None
        self.frame_rate(frame)
        out.valid, out.reasons = as_sent(frame)
        if frame.kind == "sentinel":  # of a recording made by an earlier version: no contacts are made of it
            return [self._unusable(out, "coarse")]
        self._part = (frame.scan, self._part[1])
        if self.continuity.broken(frame, frame.parts):
            add_reason(out.reasons, "gap")
        if len(frame.z) != len(self.bundle.pattern):  # another skin's
            self._counters["foreign"] += 1
            expected = f"the bundle {self.bundle.name} has {len(self.bundle.pattern)}"
            self._foreign = f"frames of {len(frame.z)} measurements, {expected}"
            return [self._unusable(out, "out_of_distribution")]
        self._foreign = ""
        self._follow(frame)
        if frame.kind == "reference":
            return [self._refer(out, frame)]
        self.references.interrupted()
        if SEPARATE in frame.reasons and not self._beside_reference(frame):
            return [self._unusable(out, "stale_baseline")]
        scan = Scan.of(frame, self._before)
        if self.each_alone:
            scan = scan.alone()
        self._before = scan
        estimate = self.estimator.step(scan)
        self._look_at_baseline()
        self._count_gain_steps()
        out.valid = estimate.valid
        for reason in estimate.reasons:
            add_reason(out.reasons, reason)
        self._estimate, self._judged = estimate, out
        if frame.parts > 1 and not estimate.whole:
            return self._part_of(out, estimate)
        self._part = (frame.scan, frame.scan)
        return [self._delta_of(out, estimate)]

    @property
    def judgements(self) -> tuple[Judgement, ...]:
        """Of the frame processed last."""
        return () if self._judged is None or self._estimate is None else self._estimate.judgements

    def beside(self, wanted: frozenset[str]) -> list[Frame]:
        self.estimator.learn()
        return [judged(self._judged, self.judgements)] if self._judged is not None and "judgements" in wanted else []

    def _part_of(self, out: DeltaFrame, estimate: Estimate) -> list[Frame]:
        """Of parts in which nothing touches none travels on."""
        if not self._announces(out, estimate):
            return []
        self._part = (out.scan, out.scan)
        return [PartFrame(**inherited(out), after=self._delta, estimates=self._touches(estimate))]

    def _announces(self, out: DeltaFrame, estimate: Estimate) -> bool:
        """Whether there is something of touches to send; an end for as long as readers are to see it."""
        now_ns = out.stamps.get("sample", 0)
        if estimate.touches or (not estimate.valid and now_ns - self._announced_ns < LASTS_NS):
            self._announced_ns = now_ns
        return 0 <= now_ns - self._announced_ns < LASTS_NS

    def _delta_of(self, out: DeltaFrame, estimate: Estimate) -> DeltaFrame:
        baseline, touch = self.baseline, estimate.touch
        out.after, self._delta = self._delta, out.scan
        out.electrodes = estimate.electrodes
        if baseline is None or touch is None:
            return self._blank(out)
        out.estimates = self._touches(estimate)
        out.touched = self._touched = estimate.touched or bool(out.estimates)
        self._announces(out, estimate)
        out.score, out.threshold = touch.statistic, touch.expected
        self._counters["touched"] += out.touched
        if not estimate.scan.believed:
            self._reconstruction.reset()  # a mean of the same scan again and again is no surer
        live = estimate.live & np.isfinite(self._reconstruction.sigma) & (estimate.difference < MOST_LOG)
        z0 = baseline.z0 * np.exp(self._shift(estimate.scan))
        d = np.where(live, z0 * np.expm1(estimate.difference) / self.pre.normaliser(z0), 0.0)
        out.difference = d.astype(np.float32)
        out.sigma = np.where(live, self._reconstruction.sigma, np.inf).astype(np.float32)
        out.tare_frames = self._reconstruction.frames
        if not out.touched:
            self._reconstruction.reset()
            self._since_saved = (self._since_saved + 1) % SAVE_EVERY
            self._keep |= not self._since_saved
        if out.touched or self.always_reconstruct or not self.config.touch.skip_untouched:
            self._reconstruct(out, d)
        return out

    def _reconstruct(self, out: DeltaFrame, d: Array) -> None:
        holds = out.touched and self.config.touch.hold and not self.always_reconstruct
        made = self._reconstruction(d, out.sigma, out.scan) if holds else Reconstructed(d, 1)
        if made is None:
            out.held, out.reconstructed = self._reconstruction.now.scan > 0, self._reconstruction.now.scan
            self._counters["held"] += out.held
            return
        out.difference = made.difference.astype(np.float32)
        out.sigma = sigma_of_mean(out.sigma, made.averaged)
        out.reconstructed, out.averaged = out.scan, made.averaged
        self._counters["reconstructed"] += 1

    def _touches(self, estimate: Estimate) -> list[EstimatedTouch]:
        return [on_the_wire(touch, self.bundle.metres_per_unit) for touch in estimate.touches]

    def _unusable(self, out: DeltaFrame, reason: str) -> DeltaFrame:
        invalidate(out, reason)
        return self._blank(out)

    def _blank(self, out: DeltaFrame) -> DeltaFrame:
        measurements = len(self.bundle.pattern)
        out.difference = np.zeros(measurements, np.float32)
        out.sigma = np.full(measurements, np.inf, np.float32)
        return out

    # --- scans that stand in a file ---

    def _refer(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        """A scan that is untouched, as the file says: the baseline until the next one."""
        amplitude = np.where(frame.status == 0, np.abs(frame.z.astype(np.complex128)), np.nan)
        found = self.references.baseline(amplitude, frame.scan, frame.board, self._sample_ns, self.pre)
        if found is None:
            self._forget_baseline()
            self._problem = f"scan {frame.scan} is to be the baseline, but half of its measurements give no value"
            return self._unusable(out, "stale_baseline")
        self.set_baseline(found)
        self.estimator.note_untouched()
        out.difference = np.zeros(len(amplitude), np.float32)
        out.sigma = self._reconstruction.sigma.astype(np.float32)
        return out

    def _beside_reference(self, frame: RawFrame) -> bool:
        """A scan that stands by itself is compared with the reference just before it, and with no other."""
        if self.baseline is None or frame.scan != self.references.now.scan + 1:
            self._forget_baseline()
            self._problem = f"the reference of scan {frame.scan} did not come: it cannot be compared"
            return False
        return True

    # --- the baseline ---

    def _follow(self, frame: RawFrame) -> None:
        """A baseline belongs to one board, and a recording's frames never meet the live board's baseline."""
        replayed = frame.source == "replay"
        if self._trusted is not None and (replayed or self._trusted.board != frame.board):
            self._trust(None)
        if self._source and (self._source == "replay") != replayed:
            self.reset()
        elif self.baseline is not None and not replayed and self.baseline.board != frame.board:
            self._problem = f"the baseline was of board {self.baseline.board}, this is {frame.board}: taking a new one"
            self._forget_baseline()
        self._source, self._board = frame.source, frame.board
        if as_sent(frame)[0]:
            self._sample_ns = frame.stamps.get("sample", 0)
            if self._undated_s and self.baseline is not None:
                taken_ns = self._sample_ns - round(self._undated_s * 1e9)
                self.baseline = replace(self.baseline, taken_ns=taken_ns)
                self._undated_s = 0.0

    def _look_at_baseline(self) -> None:
        """Whether the estimator has taken another one."""
        if self.estimator.skin is not self._tared:
            known = self._trusted if self.estimator.now.adopted_age_s is not None else None
            self._undated_s = 0.0 if known is None else self._undated_s
            self._use(self._taken("start") if known is None else replace(known, restored=True))
            self._trusted, self._keep = None, True
        problem = self.estimator.taring.now.problem
        if problem or self.estimator.skin is not None:
            self._problem = problem

    def _count_gain_steps(self) -> None:
        before, skin = self._gain_steps, self.estimator.skin
        self._gain_steps = 0 if skin is None else skin.faults.now.gain_steps
        self._counters["gain_steps"] += max(0, self._gain_steps - before)

    def _taken(self, by: str) -> Baseline:
        skin = self.estimator.skin
        assert skin is not None
        z0 = np.where(skin.live, np.exp(skin.log_z0), 0.0)
        sigma = np.where(skin.live, skin.scatter * z0, np.inf)
        doubt = self.estimator.taring.now.problem
        return Baseline(z0, sigma, skin.frames, self._board, self._sample_ns, doubt=doubt, taken_by=by)

    def _shift(self, scan: Scan) -> Array:
        """(K,) log |Z| of the untouched skin by now over its baseline."""
        skin = self.estimator.skin
        return np.zeros(scan.values.size) if skin is None else skin.drift.shift(scan.at_ns * 1e-9)

    def _by_now(self) -> Baseline | None:
        """The baseline, moved by what drifted."""
        if self.baseline is None or self._before is None or self.estimator.now.adopted_age_s is not None:
            return self.baseline
        return replace(self.baseline, z0=self.baseline.z0 * np.exp(self._shift(self._before)))

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        if name == "part":
            seen, handed = self._part
            return {"seen": seen == args["scan"], "handed_on": handed == args["scan"]}
        if name != "tare":
            return super().command(name, args)
        try:
            self.estimator.tare(bool(args.get("force", False)))
        except NoBaseline as why:
            raise Refused(str(why)) from None
        self._trusted, self._undated_s = None, 0.0
        self._use(self._taken("command"))
        assert self.baseline is not None
        self._keep, self._touched = True, False
        relative = float(np.median(self.baseline.sigma / np.maximum(self.baseline.z0, 1e-12)))
        wanted = self.config.tare.calibrate and args.get("calibrate", True)
        calibrating = wanted and self.linearisation.tared(self.baseline)
        answer = {"frames": self.baseline.frames, "snr_db": -20 * np.log10(max(relative, 1e-12))}
        answer |= {"hash": self.baseline.hash, "calibrating": calibrating}
        return answer | {"problem": self.linearisation.problem if wanted else ""}

    def set_baseline(self, baseline: Baseline, age_s: float = 0.0) -> None:
        """Use this baseline, which is age_s older than the next scan, from that scan on."""
        baseline = replace(baseline, sigma=plausible_noise(baseline.z0, baseline.sigma))
        self.estimator.adopt(self._known(baseline), age_s, self.config.tare.contact_per_s)
        self._use(baseline)

    def _trust(self, baseline: Baseline | None) -> None:
        self._trusted = baseline
        self.estimator.trust(None if baseline is None else self._known(baseline))

    def _known(self, baseline: Baseline) -> KnownBaseline:
        """The baseline in the estimator's words."""
        live = np.isfinite(baseline.sigma) & (baseline.z0 > 0)
        z0 = np.where(live, baseline.z0, self.pre.m.z0)
        scatter = np.where(live, baseline.sigma / z0, 0.0)
        return KnownBaseline(np.log(z0), live, scatter, baseline.frames, baseline.doubt)

    def between_frames(self) -> None:
        """A calibration that is ready is adopted while nothing touches."""
        if not self.linearisation.follows(self._touched):
            return
        self._build()
        self.estimator.use(skin_tables(self.bundle))
        self._use(self.baseline)
        self._news, self._keep = BaselineNews(), True

    # --- kept state ---

    def saved(self) -> dict[str, Any] | None:
        if not self._keep or self._source == "replay" or (baseline := self._by_now()) is None:
            return None
        self._keep = False
        taken_s = self._undated_s or max(0.0, (self._sample_ns - baseline.taken_ns) * 1e-9)
        return {"bundle": self.bundle.hash, "baseline": baseline.to_dict(), "taken_s": taken_s}

    def restore(self, saved: dict[str, Any], age_s: float) -> None:
        if self.config.tare.calibrate and self.linearisation.restore(saved):
            self._build()
            self._forget_baseline()
        try:
            self._take_over(saved, age_s)
        except NoBaseline as why:
            raise Refused(str(why)) from None

    def _take_over(self, saved: dict[str, Any], age_s: float) -> None:
        if not isinstance(saved, dict) or saved.get("bundle") != self.bundle.hash:
            raise Refused("the saved baseline is of another bundle")
        baseline = Baseline.from_dict(saved.get("baseline", {}), len(self.bundle.pattern))
        oldest_s = self.config.tare.max_age_s
        taken_s = saved.get("taken_s", 0.0)  # before it was kept
        if not isinstance(taken_s, int | float) or not 0 <= taken_s <= LONGEST_S:
            raise Refused(f"the saved baseline has no age (found {taken_s!r:.40}): tare again")
        if age_s > oldest_s:
            self._trust(None if baseline.doubt else baseline)
            self._undated_s = age_s + taken_s
            raise Refused(
                f"the saved baseline is {age_s / 3600:.1f} h old, at most {oldest_s / 3600:.1f} h: another is taken, "
                "and held against it"
            )
        self.set_baseline(replace(baseline, restored=True), age_s)
        self._undated_s = age_s + taken_s

    def state(self) -> dict[str, Any]:
        baseline = self.baseline
        return {
            "touched": self._touched,
            "told_ns": self._announced_ns,
            "continuity": self.continuity.state(),
            "hold": saved(self._reconstruction.now),
            "estimator": self.estimator.state(),
            "bundle": self.bundle.hash,
            "baseline": baseline.to_dict() if baseline else None,
            "trusted": self._trusted.to_dict() if self._trusted else None,
            "undated_s": self._undated_s,
            "references": saved(self.references.now),
            "parts": list(self._part),
            "board": self._board,
            "last_sample_ns": self._sample_ns,
            **self.linearisation.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        before, mounted = vars(self).copy(), self.linearisation.mounted
        try:
            self._load(state)
        except (AttributeError, KeyError, TypeError, ValueError) as wrong:
            vars(self).update(before)  # `_load` makes all that it changes anew
            self.linearisation.mounted = mounted
            if isinstance(wrong, NoBaseline):
                raise Refused(str(wrong)) from None
            raise Refused(f"the saved state does not fit ({wrong}): reset") from None

    def _load(self, state: dict[str, Any]) -> None:
        """A state of an earlier version gives its baseline, and what was touched is looked for anew."""
        if self.linearisation.load(state):
            self._news = BaselineNews()
        self._build()
        self.reset()
        kept, k = state["baseline"], len(self.bundle.pattern)
        baseline = None if kept is None else Baseline.from_dict(kept, k)
        self._sample_ns = int(state["last_sample_ns"])
        earlier = state.get("estimator", {}).get("layout") != LAYOUT
        if earlier or state["bundle"] != self.bundle.hash:
            if baseline is not None:
                self.set_baseline(baseline)
            return
        self.estimator.load(state["estimator"])
        skin = self.estimator.skin
        self._gain_steps = 0 if skin is None else skin.faults.now.gain_steps  # whoever saved them has counted them
        trusted = state.get("trusted")
        self._trusted = None if trusted is None else Baseline.from_dict(trusted, k)
        self._undated_s = float(state.get("undated_s", 0.0))
        self.references.load(state["references"])
        self._use(baseline)
        self._before = self.estimator.now.before
        self._reconstruction.load(state["hold"])
        self.continuity.load(state["continuity"])
        self._touched, self._announced_ns = bool(state["touched"]), int(state["told_ns"])
        seen, handed = map(int, state["parts"])
        self._part = (seen, handed)  # but who reads parts from now on may never see the delta frame before
        self._board = str(state["board"])  # whether frames are a recording's, the next one says

    # --- beside frames ---

    def warm_up(self) -> None:
        self.prepare()

    def prepare(self) -> bool:
        return self.baseline is not None and self._reconstruction.prepare()

    def info(self) -> dict[str, Any] | None:
        baseline, rate_hz = self._by_now(), self.frame_rate.found
        if not self._news(baseline, self._sample_ns, rate_hz):
            return None
        if baseline is not None and baseline.hash != self._announced_hash:
            self.revision, self._announced_hash = self.revision + 1, baseline.hash
        info = describe(self.config, self.bundle, self._force, baseline, self.revision, rate_hz)
        info["symmetry"] = self._symmetry
        mounting = found_by(self.bundle)
        return info | {"mounting": mounting} if mounting else info

    def health(self) -> Health:
        problem = self._foreign or self._problem
        if not problem and self.baseline is None:
            latest = self.estimator.taring.latest
            problem = f"{TAKING}: {len(latest)} of {latest.needed} frames"
        electrodes, judgements = np.zeros(0, np.uint8), tuple[Judgement, ...]()
        if self._estimate is not None:
            electrodes, judgements = self._estimate.electrodes, self._estimate.judgements
        silent = any(each.name == "silent" and each.ratio >= 1 for each in judgements)
        advice = sentences(electrodes, self.estimator.wire, silent)
        problems = [*filter(None, (problem, *advice, self.linearisation.problem))]
        unchecked = [self._unchecked] if self._unchecked else []  # as the bundle is made: no warning
        return Health("WARN" if problems else "OK", [*problems, *unchecked], dict(self._counters))


def on_the_wire(touch: TouchEstimate, metres: float) -> EstimatedTouch:
    """metres: of one model unit."""
    values, vectors = np.linalg.eigh(touch.covariance[:2, :2])
    short, long = np.sqrt(np.maximum(values, 0.0) * metres**2 + PLACE_SIGMA**2)
    return EstimatedTouch(
        id=touch.id,
        began=touch.began,
        age_s=touch.age_s,
        position=[metres * touch.x, metres * touch.y],
        velocity=[metres * touch.vx, metres * touch.vy],
        sigma=[float(long), float(short), math.atan2(vectors[1, 1], vectors[0, 1])],
        radius_m=metres * touch.radius,
        radius_sigma=math.sqrt(max(float(touch.covariance[2, 2]), 0.0)),
        drop=max(touch.drop, 0.0),
        drop_sigma=math.sqrt(max(float(touch.covariance[3, 3]), 0.0)),
        strength=metres**2 * max(touch.strength, 0.0),
        strength_sigma=metres**2 * touch.strength_sd,
        z2=touch.z2,
        unexplained=touch.unexplained,
    )


if __name__ == "__main__":
    import sys

    from services.process import main, stages

    sys.exit(main("preprocessing", stages(Preprocessing)))
