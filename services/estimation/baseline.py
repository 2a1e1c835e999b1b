"""The untouched skin over time: the first tare, drift followed while nothing touches, tare on command, what survives a
crash.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import RawFrame, as_sent
from services.estimation.creep import Creep
from services.estimation.drift import DriftProcess
from services.estimation.drift_filter import DriftFilter
from services.estimation.evidence import Explanation, TouchEvidence, evidence_of
from services.estimation.references import References
from services.estimation.start import StartVerdict, judge_start
from services.estimation.tare import Baseline, noisy, plausible_noise, take
from services.estimation.tuning import TUNING
from services.runtime.config import TareConfig
from services.runtime.stage import SEPARATE, Refused

Array = NDArray[np.float64]

UNSURE = (
    "this skin differs from its bundle by as much as a touch may make: see that nothing touches it and run `skin tare` "
    "once"
)
PRESSED = "something touches the skin, and has since the start: free it; if nothing touches it, run `skin tare`"
RETRY_EVERY = 8  # frames between attempts at the first tare
LONGEST_S = 1e9  # a saved time that is longer is none
SAVE_EVERY = 512  # untouched frames after which the tracked baseline is saved again
STEADY_S = 0.25  # what is known not to have drifted is as good as a baseline of this age
DRIFT_KNOWN_S = 4.0  # a drift that was found under a touch leaves as much open as a baseline of this age


def believed(frame: RawFrame) -> bool:
    """Whether acquisition believes this scan: that it is news, and when it was measured."""
    return as_sent(frame)[0]


class BaselineEstimator:
    """Baseline |Z0| (K,), what differences are divided by, and their noise."""

    def __init__(self, bundle: Bundle, config: TareConfig) -> None:
        self.bundle, self.config = bundle, config
        self.pre = bundle.prereconstructor()
        self.follower = DriftFilter(self.pre, config)
        self.references = References(len(bundle.pattern))
        self.revision = 0  # of the baseline: counts up whenever another one is used, or drift moves it
        self.baseline: Baseline | None
        self.normaliser: NDArray[np.floating]
        self.sigma: Array
        self.reset()

    def reset(self) -> None:
        self._window: deque[Array] = deque(maxlen=self.config.frames)
        self.references.reset()
        self._run = 0  # untouched frames since the last touch
        self._seen = 0
        self._source = self._board = ""
        self.last_sample_ns = 0  # stamp `sample` of the newest frame that was believed
        self._restored_s = 0.0  # age of a baseline that an earlier process took, until the first frame
        self._unsaved = False
        self.problem = ""  # what stands in the way of valid frames, for a person
        self.touched_at_start = False
        self._trusted: Baseline | None = None  # the last one without doubt: it judges the start, if it is of this board
        self._use(None)

    # frames

    def follow(self, frame: RawFrame) -> None:
        """A baseline belongs to one board, and a recording's frames never meet the live board's baseline."""
        if self._source and (self._source == "replay") != (frame.source == "replay"):
            self.reset()
        self._source, self._board = frame.source, frame.board
        if self.baseline is not None and frame.source != "replay" and self.baseline.board != frame.board:
            self.problem = f"the baseline was of board {self.baseline.board}, this is {frame.board}: taking a new one"
            self._window.clear()
            self._use(None)

    def offer(self, amplitude: Array, frame: RawFrame) -> bool:
        """A frame's |Z| (K,), NaN where a measurement failed. Whether there is another baseline now.

        A baseline is taken from frames in a row that acquisition believes: scans that repeat tell no noise, and a stamp
        that is wrong tells no age.
        """
        if not believed(frame):
            self._window.clear()
            return False
        self._seen += 1
        self.last_sample_ns = frame.stamps.get("sample", 0)
        self._date()
        if frame.kind == "reference":
            self._window.append(amplitude)
            return self._refer(amplitude, frame)
        self.references.interrupted()
        if SEPARATE in frame.reasons:
            self._needs_reference(frame)
            return False
        self._window.append(amplitude)
        if self.baseline is None and len(self._window) == self.config.frames and self._seen % RETRY_EVERY == 0:
            try:
                return self._begin(take(np.array(self._window), self.pre, frame.board, self.last_sample_ns))
            except Refused as why:
                self.problem = f"no baseline yet: {why}"
        return False

    @property
    def evidence(self) -> TouchEvidence:
        """Made when it is first asked for, which takes a third of a second, and kept for all skins of the bundle."""
        return evidence_of(self.bundle)

    def _begin(self, found: Baseline) -> bool:
        """Use the first baseline, unless something touches: whether there is one now."""
        trusted = self._trusted if self._trusted is not None and self._trusted.board == found.board else None
        start = judge_start(
            found.z0, found.sigma / np.sqrt(found.frames), self.evidence, None if trusted is None else trusted.z0
        )
        self.touched_at_start = start.verdict is StartVerdict.TOUCHED
        if start.verdict is StartVerdict.UNKNOWN and not found.doubt:
            found = dataclasses.replace(found, doubt=UNSURE)
        if not self.touched_at_start:
            self.set_baseline(found, self.last_sample_ns)
            return True
        if trusted is None or start.explanation is None or not start.explanation.fits:
            self.problem = PRESSED
            return False
        self.set_baseline(dataclasses.replace(trusted, sigma=found.sigma), self.last_sample_ns)
        self.drifted(start.explanation.drift, self.last_sample_ns)
        return True

    def explain(self, d: Array, live: NDArray[np.bool_], since_s: float, creep: Array | None = None) -> Explanation:
        """A difference (K,), by touches and by as much drift as `since_s` seconds permit. creep (K,): d of a touch that
        may have left something behind.
        """
        assert self.baseline is not None
        physics, variance = self.evidence.physics, np.where(live, self.sigma, 0.0) ** 2 * (1 + 1 / self.baseline.frames)
        prior = DriftProcess.of_skin(physics.electrodes, creep=False).value_covariance(since_s)
        columns = physics.columns(d)
        if creep is not None:
            columns = np.column_stack([columns, creep])
            prior = np.pad(prior, (0, 1))
            prior[-1, -1] = TUNING.creep_sd**2
        return self.evidence(d, np.diag(variance + TUNING.absolute**2), columns, prior, live)

    def drifted(self, drift: Array, sample_ns: int, creep: Array | None = None) -> None:
        """Move the baseline by a drift that was found under a touch, in the order of `explain`'s columns."""
        assert self.baseline is not None
        change = self.pre.m.contact @ drift[1 : 1 + self.pre.m.contact.shape[1]]
        if creep is not None:
            change = change + creep * drift[-1]
        z0 = (self.baseline.z0 + self.normaliser * change) / (1 - drift[0])
        z0 = np.where(self.baseline.z0 > 0, np.maximum(z0, 0.0), 0.0)
        self._move(z0)
        self.follower.begin(sample_ns, DRIFT_KNOWN_S)
        self._run = 0

    def steady(self, sample_ns: int) -> None:
        """Nothing has drifted: a frame under a touch says so."""
        self.follower.begin(sample_ns, STEADY_S)

    def difference(self, amplitude: Array, live: NDArray[np.bool_]) -> Array:
        """d (K,) = (|Z| - |Z0|) / |Z0|, 0 where a measurement does not count."""
        assert self.baseline is not None
        return np.where(live, (amplitude - self.baseline.z0) / self.normaliser, 0.0)

    def since_s(self, sample_ns: int) -> float:
        """Seconds since the baseline last knew the skin as untouched."""
        return self.follower.since_s(sample_ns)

    def begin_touch(self) -> None:
        """The last frame offered was touched, the one before was not."""
        assert self.baseline is not None
        z0 = self.baseline.z0.copy()
        self.follower.begin_touch(z0)
        self._move(z0)
        self._run = 0

    def rescale(self, factor: float) -> None:
        """All measurements are so many times what they were: the board's gain stepped."""
        assert self.baseline is not None
        self.baseline = dataclasses.replace(self.baseline, sigma=self.baseline.sigma * factor)
        self._move(self.baseline.z0 * factor)
        self.follower.rescale(factor)
        self._window = deque((row * factor for row in self._window), maxlen=self._window.maxlen)

    def touched(self, amplitude: Array, live: NDArray[np.bool_], sample_ns: int) -> None:
        """The last frame offered was touched: drift is taken out as far as a held touch shows it."""
        assert self.baseline is not None
        z0 = self.baseline.z0.copy()
        if self.follower.holding(z0, amplitude, live, self.sigma, self.normaliser, sample_ns):
            self._move(z0)

    def untouched(self, amplitude: Array, live: NDArray[np.bool_], sample_ns: int, creep: Creep | None = None) -> None:
        """The last frame offered was not: slow drift is followed."""
        assert self.baseline is not None
        self._run += 1
        z0 = self.baseline.z0.copy()
        if self.follower.untouched(z0, amplitude, live, self.sigma, sample_ns, creep):
            self._move(z0)
        if self._run % SAVE_EVERY == 0:
            self._unsaved = True

    # baselines

    def set_baseline(self, baseline: Baseline, sample_ns: int = 0, age_s: float = 0.0) -> None:
        """Use this baseline from the next frame on. Its newest frame is age_s older than the stamp sample_ns (0: than
        the next frame).
        """
        self._run, self._restored_s = 0, 0.0
        self.follower.begin(sample_ns, age_s)
        self._use(baseline)

    def tare(self, touched: bool, force: bool) -> Baseline:
        """A new baseline from the newest frames. Raises Refused while touched (unless forced) or if they disagree."""
        needed = self.config.frames
        if len(self._window) < needed:
            raise Refused(f"only {len(self._window)} of {needed} frames came so far: wait, or look at `skin top`")
        sure = self.baseline is not None and not self.baseline.doubt  # else its word against a touch counts for nothing
        if touched and sure and not force:
            raise Refused("the skin is touched: free it and try again (or --force, if nothing touches it)")
        if sure and self._run < needed and not force:
            raise Refused(f"only {self._run} of {needed} untouched frames since the last touch: wait and try again")
        baseline = take(np.array(self._window), self.pre, self._board, self.last_sample_ns)
        # Whoever gives the command has looked: no doubt, but that of noise, which looking does not mend.
        doubt = noisy(baseline.z0, baseline.sigma, self.pre)
        self.set_baseline(dataclasses.replace(baseline, doubt=doubt, taken_by="command"), self.last_sample_ns)
        return baseline

    def progress(self) -> str:
        return f"taking the baseline: {len(self._window)} of {self.config.frames} frames"

    def _move(self, z0: Array) -> None:
        """The same baseline, moved by what drifted."""
        assert self.baseline is not None
        self.baseline = dataclasses.replace(self.baseline, z0=z0)
        self.normaliser = self.pre.normaliser(z0)
        self.revision += 1
        if not self.baseline.doubt:
            self._trusted = self.baseline

    def _use(self, baseline: Baseline | None) -> None:
        self.baseline = baseline
        self.revision += 1
        if baseline is not None:
            self.baseline = dataclasses.replace(baseline, sigma=plausible_noise(baseline.z0, baseline.sigma))
            self.normaliser = self.pre.normaliser(baseline.z0)
            self.sigma = self.baseline.sigma / self.normaliser
            self._unsaved = True
            self.problem = baseline.doubt
            self.touched_at_start = False
            if not baseline.doubt:
                self._trusted = self.baseline

    def _refer(self, amplitude: Array, frame: RawFrame) -> bool:
        """An imported file says that this frame is untouched: it is the baseline until the next one."""
        found = self.references.baseline(amplitude, frame.scan, frame.board, self.last_sample_ns)
        if found is None:
            self._use(None)
            self.problem = f"scan {frame.scan} is to be the baseline, but half of its measurements give no value"
        else:
            self.set_baseline(found)
            # As in a typical one of them, and so the same in all: what is made for a noise is made once.
            typical, known = self.references.typical, self.references.typical > 0
            share = np.divide(typical, self.pre.normaliser(typical), out=np.zeros(len(typical)), where=known)
            self.sigma = np.where(np.isfinite(found.sigma) & known, self.references.noise * share, np.inf)
        return True

    def _needs_reference(self, frame: RawFrame) -> None:
        """A scan that stands by itself is compared with the reference just before it, and with no other."""
        if self.baseline is not None and frame.scan != self.references.scan + 1:
            self._use(None)
            self.problem = f"the reference of scan {frame.scan} did not come: it cannot be compared"

    # state

    def state(self) -> dict[str, Any]:
        return {
            "bundle": self.bundle.hash,
            "baseline": self.baseline.to_dict() if self.baseline else None,
            "normaliser": self.normaliser if self.baseline else None,
            "sigma": self.sigma if self.baseline else None,
            "follower": self.follower.state(),
            "references": self.references.state(),
            "window": np.array(self._window),
            "run": self._run,
            "seen": self._seen,
            "last_sample_ns": self.last_sample_ns,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises Refused where the state is of another number of measurements, or not possible.

        A state of another bundle still says what the untouched skin measured: so old recordings replay on new bundles.
        """
        self.reset()
        k = len(self.bundle.pattern)
        if state["baseline"] is not None:
            self._use(Baseline.from_dict(state["baseline"], k))
            assert self.baseline is not None
            if state["bundle"] == self.bundle.hash:
                normaliser = np.array(state["normaliser"], dtype=float)
                if normaliser.shape != (k,) or not (np.isfinite(normaliser) & (normaliser >= 0)).all():
                    raise Refused(f"the saved normaliser is not {k} numbers from 0 on: tare again")
                self.normaliser = normaliser
                self.sigma = np.array(state.get("sigma", self.baseline.sigma / normaliser), dtype=float)
                self.sigma = np.where(np.isfinite(self.baseline.sigma), self.sigma, np.inf)
                if self.sigma.shape != (k,) or not (self.sigma > 0).all():
                    raise Refused(f"the saved noise is not {k} numbers above 0: tare again")
        if "references" in state:  # older recordings have none
            try:
                self.references.load(state["references"])
            except (KeyError, TypeError, ValueError) as wrong:
                raise Refused(f"the saved reference scans do not fit ({wrong}): reset") from None
        window = np.array(state["window"], dtype=float)
        if window.size and (window.ndim != 2 or window.shape[1] != k):
            raise Refused(f"the saved frames are of shape {window.shape}, expected (n, {k}): tare again")
        self._window.extend(window if window.size else [])
        self._run, self._seen = int(state["run"]), int(state["seen"])
        self.last_sample_ns = int(state["last_sample_ns"])
        self.follower.begin(self.last_sample_ns)
        if "follower" in state and state["bundle"] == self.bundle.hash:
            try:
                self.follower.load(state["follower"])
            except (KeyError, TypeError, ValueError) as wrong:
                raise Refused(f"the saved state of what follows drift does not fit ({wrong}): tare again") from None

    def saved(self) -> dict[str, Any] | None:
        """What is worth keeping across a crash, if it changed."""
        if not self._unsaved or self.baseline is None or self._source == "replay":
            return None
        self._unsaved = False
        taken_s = self._restored_s or max(0.0, (self.last_sample_ns - self.baseline.taken_ns) * 1e-9)
        quiet_s = self.since_s(self.last_sample_ns)
        saved = {"bundle": self.bundle.hash, "baseline": self.baseline.to_dict()}
        return saved | {"taken_s": taken_s, "quiet_s": quiet_s}

    def restore(self, saved: dict[str, Any], age_s: float) -> None:
        """Raises Refused where it does not fit or is too old."""
        if not isinstance(saved, dict) or saved.get("bundle") != self.bundle.hash:
            raise Refused("the saved baseline is of another bundle")
        oldest = self.config.max_age_s
        baseline = Baseline.from_dict(saved.get("baseline", {}), len(self.bundle.pattern))
        if age_s > oldest:
            self._trusted = None if baseline.doubt else baseline
            raise Refused(
                f"the saved baseline is {age_s / 3600:.1f} h old, at most {oldest / 3600:.1f} h: another is taken, and "
                "held against it"
            )
        try:
            taken_s, quiet_s = (float(saved.get(key, 0.0)) for key in ("taken_s", "quiet_s"))
            if not (0 <= taken_s <= LONGEST_S and 0 <= quiet_s <= LONGEST_S):
                raise ValueError(f"found {taken_s:g} s and {quiet_s:g} s")
        except (TypeError, ValueError) as wrong:
            raise Refused(f"the saved baseline has no age ({wrong}): tare again") from None
        self.set_baseline(dataclasses.replace(baseline, restored=True), age_s=age_s + quiet_s)
        self._restored_s = age_s + taken_s
        self._unsaved = False

    def _date(self) -> None:
        """Stamps begin anew with a boot: with the first frame it is known when a restored baseline was taken."""
        if self._restored_s and self.baseline is not None:
            taken_ns = self.last_sample_ns - round(self._restored_s * 1e9)
            self.baseline = dataclasses.replace(self.baseline, taken_ns=taken_ns)
            self._restored_s = 0.0
