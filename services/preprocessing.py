"""Preprocessing: from impedances to the network's input, following the paper's equations, and only where something
touches.

    d = (|Z| - |Z0|) / |Z0|                     against the untouched baseline (services/tare.py)
    touched = d^T C^-1 d > threshold            C: noise, model error, drift (services/touch.py)
    stack = RM d for a ladder of lambda         equation 1, RM = (J^T W J + lambda^2 R)^-1 J^T W, W = C^-1
    I_thresh = MReLU(H(I_pre) * I_pre)          equations 2 to 5, where the bundle has no network that does better

The matrices are the bundle's; see models/prereconstruction.py.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.prereconstruction import Drift, Operator
from protocol.frames import DeltaFrame, Frame, RawFrame
from services.config import Skin
from services.describe import geometry
from services.electrodes import ElectrodeHealth
from services.stage import Health, Refused, Stage, add_reason, inherited
from services.tare import Baseline, noise_of_steps, take
from services.touch import Hold, TouchDecision

Array = NDArray[np.float64]

DRIFT = Drift(scale=5e-5, contact=2e-4)  # what is allowed for since the last untouched frame
RETRY_EVERY = 8  # frames between attempts at the first tare
SAVE_EVERY = 512  # untouched frames after which the tracked baseline is saved again
RENORMALISE_EVERY = 64  # untouched frames after which tracked drift enters the normalisation
LONGEST_STEP_S = 1.0  # of baseline tracking: a longer gap between frames counts as this
TOO_MANY_DEAD = 2  # electrodes with which contacts can still be given
OPERATORS = 8  # sets of live measurements whose operator is kept


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
        self.pre = bundle.prereconstructor()
        self.electrodes = ElectrodeHealth(bundle.pattern)
        self.hold = Hold()
        self.always_reconstruct = False  # offline: an image of every frame, touched or not
        self._operators: dict[tuple[bytes, bytes, int], tuple[Operator, TouchDecision]] = {}
        self.reset()

    def reset(self) -> None:
        self._window: deque[Array] = deque(maxlen=self.config.tare.frames)
        self._references: deque[Array] = deque(maxlen=self.config.tare.frames)  # those in a row
        self._untouched_run = 0
        self._touched = False
        self._source = ""
        self._last_sample_ns = 0
        self._problem = ""
        self._counters = {"frames": 0, "touched": 0, "reconstructed": 0, "held": 0, "foreign": 0}
        self._unsaved = False
        self.hold.reset()
        self._set_baseline(None)

    # the chain

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, RawFrame)
        out = DeltaFrame(**inherited(frame))
        self._counters["frames"] += 1
        if frame.reasons == ["non_finite"]:  # measurements that failed are left out below
            out.valid, out.reasons = True, []
        if frame.kind == "sentinel" or len(frame.z) != len(self.bundle.pattern):
            return [self._no_scan(out, frame)]
        self._follow_source(frame)
        amplitude = np.abs(frame.z.astype(np.complex128))
        baseline = self._baseline
        live, out.electrodes, reasons = self.electrodes(amplitude, frame.status, baseline.z0 if baseline else None)
        for reason in reasons:
            add_reason(out.reasons, reason)
        amplitude[~live] = np.nan
        self._window.append(amplitude)
        if frame.kind != "reference":
            self._references.clear()
        if frame.kind == "reference":
            self._refer(amplitude, frame)
        elif (
            baseline is None
            and len(self._window) == self.config.tare.frames
            and self._counters["frames"] % RETRY_EVERY == 0
        ):
            self._first_tare(frame)
        if self._baseline is None:
            return [_unusable(out, "stale_baseline", len(amplitude))]
        if self._baseline.doubt:
            out.valid = False
            add_reason(out.reasons, "stale_baseline")
        return [self._compare(out, amplitude, live)]

    def _compare(self, out: DeltaFrame, amplitude: Array, live: NDArray[np.bool_]) -> DeltaFrame:
        """Difference, decision, and the stack where one is needed."""
        assert self._baseline is not None
        live &= np.isfinite(self._sigma)
        if (out.electrodes != 0).sum() > TOO_MANY_DEAD or live.sum() < len(live) / 2:
            out.valid = False
            add_reason(out.reasons, "electrode_open")
            live[:] = np.isfinite(self._sigma)
            amplitude = np.where(np.isfinite(amplitude), amplitude, self._baseline.z0)
        operator, decision = self._operator(live)
        d = np.where(live, (amplitude - self._baseline.z0) / self._normaliser, 0.0)
        was_touched = self._touched
        self._touched, out.score, out.threshold = decision(d, was_touched)
        out.touched = self._touched
        out.difference = d.astype(np.float32)
        out.sigma = np.where(live, self._sigma, np.inf).astype(np.float32)
        if not self._touched:
            self.hold.reset()
            self._untouched(amplitude, live, out)
        else:
            self._untouched_run = 0
            self._counters["touched"] += 1
        if self._touched or self.always_reconstruct or not self.config.touch.skip_untouched:
            self._reconstruct(out, d, operator, decision)
        return out

    def _reconstruct(self, out: DeltaFrame, d: Array, operator: Operator, decision: TouchDecision) -> None:
        if self._touched and self.config.touch.hold and not self.always_reconstruct:
            mean = self.hold(d, out.scan, decision)
            out.reconstructed = self.hold.scan
            if mean is None:
                out.held = True
                self._counters["held"] += 1
                return
            d = mean
            out.difference = d.astype(np.float32)
        out.reconstructed = out.scan
        out.stack, out.context, out.scale = operator.stack(d)
        self._counters["reconstructed"] += 1

    def _no_scan(self, out: DeltaFrame, frame: RawFrame) -> DeltaFrame:
        """A frame that cannot be compared with the baseline: a sentinel's short list, or another skin's."""
        if frame.kind != "sentinel":
            self._counters["foreign"] += 1
            found, expected = len(frame.z), len(self.bundle.pattern)
            self._problem = f"frames of {found} measurements, the bundle {self.bundle.name} has {expected}"
        return _unusable(out, "coarse" if frame.kind == "sentinel" else "out_of_distribution", len(self.bundle.pattern))

    # the baseline

    def set_baseline(self, baseline: Baseline) -> None:
        """Use this baseline from the next frame on."""
        self._set_baseline(baseline)
        self._touched, self._untouched_run = False, 0
        self.hold.reset()

    def _set_baseline(self, baseline: Baseline | None) -> None:
        self._baseline = baseline
        self._info_changed = True
        if baseline is not None:
            self._normaliser = self.pre.normaliser(baseline.z0)
            self._sigma = baseline.sigma / self._normaliser
            self._unsaved = True
            self._problem = baseline.doubt

    def _first_tare(self, frame: RawFrame) -> None:
        try:
            self.set_baseline(take(np.array(self._window), self.pre, frame.board, frame.stamps.get("sample", 0)))
        except Refused as why:
            self._problem = f"no baseline yet: {why}"

    def _refer(self, amplitude: Array, frame: RawFrame) -> None:
        """An imported file says that this frame is untouched: it is the baseline until the next one."""
        if not np.isfinite(amplitude).all():
            return
        self._references.append(amplitude)
        if len(self._references) > 1:  # several in a row: the noise is how they differ
            sigma = noise_of_steps(np.array(self._references))
            self.set_baseline(Baseline(amplitude, sigma, 1, frame.board, frame.stamps.get("sample", 0)))
        elif self._baseline is not None:
            self._baseline = dataclasses.replace(self._baseline, z0=amplitude)
            self._normaliser = self.pre.normaliser(amplitude)
            self._touched = False
            self.hold.reset()

    def _untouched(self, amplitude: Array, live: NDArray[np.bool_], out: DeltaFrame) -> None:
        """Slow drift is followed while nothing touches."""
        assert self._baseline is not None
        self._untouched_run += 1
        sample = out.stamps.get("sample", 0)
        step_s = min(max(0.0, (sample - self._last_sample_ns) * 1e-9), LONGEST_STEP_S) if self._last_sample_ns else 0.0
        self._last_sample_ns = sample
        z0 = self._baseline.z0
        z0 += np.where(live, (amplitude - z0) * (step_s / (step_s + self.config.tare.tracking_s)), 0.0)
        if self._untouched_run % RENORMALISE_EVERY == 0:
            self._normaliser = self.pre.normaliser(z0)
        if self._untouched_run % SAVE_EVERY == 0:
            self._unsaved = True

    def _operator(self, live: NDArray[np.bool_]) -> tuple[Operator, TouchDecision]:
        assert self._baseline is not None
        key = live.tobytes(), self._sigma.astype(np.float32).tobytes(), self._baseline.frames
        if key not in self._operators:
            if len(self._operators) >= OPERATORS:
                self._operators.pop(next(iter(self._operators)))
            frames = self._baseline.frames
            operator = self.pre.condition(self._sigma, drift=DRIFT, weights=live.astype(float), tare_frames=frames)
            self._operators[key] = operator, TouchDecision(operator, self.config.touch.false_alarms, frames)
        return self._operators[key]

    def _follow_source(self, frame: RawFrame) -> None:
        """A baseline belongs to one board; a recording's frames never meet the live board's baseline."""
        if self._source and (self._source == "replay") != (frame.source == "replay"):
            self.reset()
        self._source = frame.source
        if self._baseline is not None and frame.source != "replay" and self._baseline.board != frame.board:
            self._problem = f"the baseline was of board {self._baseline.board}, this is {frame.board}: taking a new one"
            self._window.clear()
            self._set_baseline(None)

    # commands, state, health

    def command(self, name: str, args: dict[str, Any]) -> dict[str, Any]:
        if name != "tare":
            return super().command(name, args)
        force = bool(args.get("force", False))
        needed = self.config.tare.frames
        if len(self._window) < needed:
            raise Refused(f"only {len(self._window)} of {needed} frames came so far: wait, or look at `skin top`")
        if self._touched and not force:
            raise Refused("the skin is touched: free it and try again (or --force, if nothing touches it)")
        if self._baseline is not None and self._untouched_run < needed and not force:
            raise Refused(
                f"only {self._untouched_run} of {needed} untouched frames since the last touch: wait and try again"
            )
        board = self._baseline.board if self._baseline else str(args.get("board", ""))
        baseline = take(np.array(self._window), self.pre, board, self._last_sample_ns)
        self.set_baseline(dataclasses.replace(baseline, doubt=""))  # whoever gives the command has looked
        relative = np.median(baseline.sigma / np.maximum(baseline.z0, 1e-12))
        return {"frames": needed, "snr_db": float(-20 * np.log10(max(relative, 1e-12))), "hash": baseline.hash}

    def state(self) -> dict[str, Any]:
        return {
            "bundle": self.bundle.hash,
            "baseline": self._baseline.to_dict() if self._baseline else None,
            "window": np.array(self._window),
            "untouched_run": self._untouched_run,
            "touched": self._touched,
            "last_sample_ns": self._last_sample_ns,
            "frames": self._counters["frames"],
            "normaliser": self._normaliser if self._baseline else None,
            "hold": self.hold.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        if state.get("bundle") != self.bundle.hash:
            raise Refused(f"the state is of bundle {str(state.get('bundle'))[:12]}, this is {self.bundle.hash[:12]}")
        self.reset()
        if state["baseline"] is not None:
            self.set_baseline(Baseline.from_dict(state["baseline"], len(self.bundle.pattern)))
            self._normaliser = np.array(state["normaliser"], dtype=float)
            self._sigma = self._baseline.sigma / self._normaliser  # type: ignore[union-attr]
        self._window.extend(np.array(state["window"], dtype=float))
        self._untouched_run, self._touched = int(state["untouched_run"]), bool(state["touched"])
        self._last_sample_ns = int(state["last_sample_ns"])
        self._counters["frames"] = int(state["frames"])
        self.hold.load(state["hold"])

    def saved(self) -> dict[str, Any] | None:
        if not self._unsaved or self._baseline is None or self._source == "replay":
            return None
        self._unsaved = False
        return {"bundle": self.bundle.hash, "baseline": self._baseline.to_dict()}

    def restore(self, saved: dict[str, Any], age_s: float) -> None:
        if saved.get("bundle") != self.bundle.hash:
            raise Refused("the saved baseline is of another bundle")
        if age_s > self.config.tare.max_age_s:
            raise Refused(
                f"the saved baseline is {age_s / 3600:.1f} h old, at most {self.config.tare.max_age_s / 3600:.1f} h"
            )
        self.set_baseline(Baseline.from_dict(saved["baseline"], len(self.bundle.pattern)))
        self._unsaved = False

    def warm_up(self) -> None:
        if self._baseline is not None:
            operator, decision = self._operator(np.isfinite(self._sigma))
            operator.stack(np.zeros(len(self._sigma)))
            decision(np.zeros(len(self._sigma)), False)

    def info(self) -> dict[str, Any] | None:
        if not self._info_changed:
            return None
        self._info_changed = False
        baseline, skin = self._baseline, self.bundle.skin
        found: dict[str, Any] = {
            "bundle": self.bundle.name,
            "bundle_hash": self.bundle.hash,
            "geometry": geometry(self.bundle),
            "pattern": skin.get("pattern", ""),
            "frame_id": self.config.frame_id,
            "parent_frame_id": self.config.pose.parent,
            "pose": [*self.config.pose.position_m, *self.config.pose.quaternion_xyzw],
            "units": {"z": "ohm", "image": "S/m", "position": "m", "force_n": "N"},
        }
        if baseline is not None:
            found |= {"baseline": baseline.z0.copy(), "baseline_sigma": baseline.sigma, "baseline_hash": baseline.hash}
            found |= {"tare_sample_ns": baseline.taken_ns, "tare_frames": baseline.frames, "board": baseline.board}
        return found

    def health(self) -> Health:
        counters = dict(self._counters)
        if self._problem:
            return Health("WARN", [self._problem], counters)
        if self._baseline is None:
            n = self.config.tare.frames
            return Health("WARN", [f"taking the baseline: {len(self._window)} of {n} frames"], counters)
        return Health("OK", [], counters)


def _unusable(out: DeltaFrame, reason: str, measurements: int) -> DeltaFrame:
    out.valid = False
    add_reason(out.reasons, reason)
    out.difference = np.zeros(measurements, np.float32)
    out.sigma = np.full(measurements, np.inf, np.float32)
    return out


if __name__ == "__main__":
    import sys

    from services.runner import main, stages

    sys.exit(main("preprocessing", stages(Preprocessing)))
