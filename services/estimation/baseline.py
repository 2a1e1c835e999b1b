"""The untouched skin over time: the first baseline, drift followed while nothing touches, the tare on command."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import RawFrame, as_sent
from services.estimation.creep import Creep
from services.estimation.drift import DriftRates
from services.estimation.drift_filter import DriftFilter
from services.estimation.drift_in_touch import drifted, explain
from services.estimation.evidence import Explanation, TouchEvidence, evidence_of
from services.estimation.first_baseline import PRESSED, first_baseline
from services.estimation.references import References
from services.estimation.tare import Baseline, NoBaseline, noisy, plausible_noise, saved_noise
from services.estimation.tare_window import TareWindow

Array = NDArray[np.float64]

TAKING = "taking the baseline"  # what the status says until there is one
SAVE_EVERY = 512  # untouched frames after which the tracked baseline is worth keeping again
STEADY_S = 0.25  # what is known not to have drifted is as good as a baseline of this age
DRIFT_KNOWN_S = 4.0  # a drift that was found under a touch leaves as much open as a baseline of this age


def believed(frame: RawFrame) -> bool:
    """Whether acquisition believes this scan: that it is news, and when it was measured."""
    return as_sent(frame)[0]


class BaselineEstimator:
    """Baseline |Z0| (K,), what differences are divided by, and their noise."""

    def __init__(self, bundle: Bundle, rates: DriftRates, frames: int, tracking_s: float) -> None:
        """frames: that the mean of a baseline is of; tracking_s: see DriftFilter."""
        self.bundle = bundle
        self._evidence: TouchEvidence | None = None
        self.pre = bundle.prereconstructor()
        self.window = TareWindow(self.pre, frames)
        self.drift_filter = DriftFilter(self.pre, rates, tracking_s)
        self.references = References(len(bundle.pattern))
        self.revision = 0  # of the baseline: counts up whenever another one is used, or drift moves it
        self.baseline: Baseline | None
        self.normaliser: NDArray[np.floating]
        self.sigma: Array
        self.reset()

    def reset(self) -> None:
        self.window.reset()
        self.references.reset()
        self._run = 0  # untouched frames since the last touch
        self.source = self._board = ""
        self.last_sample_ns = 0  # stamp `sample` of the newest frame that was believed
        self.undated_s = 0.0  # age of a baseline that an earlier process took, until the first frame
        self.news = False  # whether there is another baseline, or much drift was followed, since somebody kept it
        self.problem = ""  # what stands in the way of valid frames, for a person
        self.touched_at_start = self._surely_touched = False
        self.trusted: Baseline | None = None  # the last one without doubt: it judges the start, if it is of this board
        self._use(None)

    # frames

    def follow(self, frame: RawFrame) -> None:
        """A baseline belongs to one board, and a recording's frames never meet the live board's baseline."""
        if self.source and (self.source == "replay") != (frame.source == "replay"):
            self.reset()
        self.source, self._board = frame.source, frame.board
        if self.baseline is not None and frame.source != "replay" and self.baseline.board != frame.board:
            self.problem = f"the baseline was of board {self.baseline.board}, this is {frame.board}: taking a new one"
            self.window.clear()
            self._use(None)

    def offer(self, amplitude: Array, frame: RawFrame, separate: bool = False) -> bool:
        """A frame's |Z| (K,), NaN where a measurement failed; separate: it stands by itself, and follows no other.
        Whether there is another baseline now.

        A baseline is taken from frames in a row that acquisition believes: scans that repeat tell no noise, and a stamp
        that is wrong tells no age.
        """
        if not believed(frame):
            self.window.clear()
            return False
        self.last_sample_ns = frame.stamps.get("sample", 0)
        self._date()
        if frame.kind == "reference":
            self.window.add(amplitude)
            return self._refer(amplitude, frame)
        self.references.interrupted()
        if separate:
            self._needs_reference(frame)
            return False
        self.window.add(amplitude)
        if self.baseline is None and self.window.due:
            try:
                return self._begin(self.window.baseline(frame.board, self.last_sample_ns))
            except NoBaseline as why:
                self.problem = f"no baseline yet: {why}"
        return False

    @property
    def evidence(self) -> TouchEvidence:
        """Made when it is first asked for, and held from then on."""
        if self._evidence is None:
            self._evidence = evidence_of(self.bundle)
        return self._evidence

    def _begin(self, found: Baseline) -> bool:
        """Use the first baseline, unless something touches: whether there is one now."""
        trusted = self.trusted if self.trusted is not None and self.trusted.board == found.board else None
        first = first_baseline(found, trusted, self.evidence)
        self.touched_at_start, self._surely_touched = first.touched, first.surely
        if first.baseline is None:
            self.problem = first.problem
            return False
        self.set_baseline(first.baseline, self.last_sample_ns)
        if first.drift is not None:
            self.drifted(first.drift, self.last_sample_ns)
        return True

    def explain(self, d: Array, live: NDArray[np.bool_], since_s: float, creep: Array | None = None) -> Explanation:
        """See drift_in_touch.explain."""
        assert self.baseline is not None
        return explain(self.evidence, d, self.sigma**2 * (1 + 1 / self.baseline.frames), live, since_s, creep)

    def drifted(self, drift: Array, sample_ns: int, creep: Array | None = None) -> None:
        """Move the baseline by a drift that was found under a touch, in the order of `explain`'s columns."""
        assert self.baseline is not None
        self._move(drifted(self.baseline.z0, self.normaliser, self.pre, drift, creep))
        self.drift_filter.begin(sample_ns, DRIFT_KNOWN_S)
        self._run = 0

    def undrifted(self, z0: Array, sample_ns: int) -> None:
        """Take such a drift back: a frame has just shown the skin as z0 (K,) has it."""
        self._move(z0)
        self.steady(sample_ns)

    def steady(self, sample_ns: int) -> None:
        """Nothing has drifted: a frame says so."""
        self.drift_filter.begin(sample_ns, STEADY_S)

    def difference(self, amplitude: Array, live: NDArray[np.bool_]) -> Array:
        """d (K,) = (|Z| - |Z0|) / |Z0|, 0 where a measurement does not count."""
        assert self.baseline is not None
        return np.where(live, (amplitude - self.baseline.z0) / self.normaliser, 0.0)

    def since_s(self, sample_ns: int) -> float:
        """Seconds since the baseline last knew the skin as untouched."""
        return self.drift_filter.since_s(sample_ns)

    def begin_touch(self) -> None:
        """The last frame offered was touched, the one before was not."""
        assert self.baseline is not None
        z0 = self.baseline.z0.copy()
        self.drift_filter.begin_touch(z0)
        self._move(z0)
        self._run = 0

    def rescale(self, factor: float) -> None:
        """All measurements are so many times what they were: the board's gain stepped."""
        assert self.baseline is not None
        self.baseline = dataclasses.replace(self.baseline, sigma=self.baseline.sigma * factor)
        self._move(self.baseline.z0 * factor)
        self.drift_filter.rescale(factor)
        self.window.rescale(factor)

    def touched(self, amplitude: Array, live: NDArray[np.bool_], sample_ns: int) -> None:
        """The last frame offered was touched: drift is taken out as far as a held touch shows it."""
        assert self.baseline is not None
        z0 = self.baseline.z0.copy()
        if self.drift_filter.holding(z0, amplitude, live, self.sigma, self.normaliser, sample_ns):
            self._move(z0)

    def untouched(self, amplitude: Array, live: NDArray[np.bool_], sample_ns: int, creep: Creep | None = None) -> None:
        """The last frame offered was not: slow drift is followed."""
        assert self.baseline is not None
        self._run += 1
        z0 = self.baseline.z0.copy()
        if self.drift_filter.untouched(z0, amplitude, live, self.sigma, sample_ns, creep):
            self._move(z0)
        if self._run % SAVE_EVERY == 0:
            self.news = True

    # baselines

    def set_baseline(self, baseline: Baseline, sample_ns: int = 0, age_s: float = 0.0, undated_s: float = 0.0) -> None:
        """Use this baseline from the next frame on. The skin was last known as untouched age_s before the stamp
        sample_ns (0: before the next frame). undated_s: its own newest frame is so much older than the next frame.
        """
        self._run, self.undated_s = 0, undated_s
        self.drift_filter.begin(sample_ns, age_s)
        self._use(baseline)

    def tare(self, touched: bool, force: bool) -> Baseline:
        """A new baseline from the last frames. Raises NoBaseline if they disagree, or while touched (unless forced).

        Where a touch explains the skin at the start, that counts, too: a baseline of a touched skin would hide the
        touch in valid frames.
        """
        needed = self.window.frames
        if self._surely_touched and not force:
            raise NoBaseline(PRESSED.format(" --force"))
        sure = self.baseline is not None and not self.baseline.doubt  # else its word against a touch counts for nothing
        if sure and not force and len(self.window) == needed:
            if touched:
                raise NoBaseline("the skin is touched: free it and try again (or --force, if nothing touches it)")
            if self._run < needed:
                few = f"only {self._run} of {needed} untouched frames since the last touch"
                raise NoBaseline(f"{few}: wait and try again")
        baseline = self.window.baseline(self._board, self.last_sample_ns)
        # Whoever gives the command has looked: no doubt, but that of noise, which looking does not mend.
        doubt = noisy(baseline.z0, baseline.sigma, self.pre)
        self.set_baseline(dataclasses.replace(baseline, doubt=doubt, taken_by="command"), self.last_sample_ns)
        return baseline

    def progress(self) -> str:
        return f"{TAKING}: {len(self.window)} of {self.window.frames} frames"

    def _move(self, z0: Array) -> None:
        """The same baseline, moved by what drifted."""
        assert self.baseline is not None
        self.baseline = dataclasses.replace(self.baseline, z0=z0)
        self.normaliser = self.pre.normaliser(z0)
        self.revision += 1
        if not self.baseline.doubt:
            self.trusted = self.baseline

    def _use(self, baseline: Baseline | None) -> None:
        self.baseline = baseline
        self.revision += 1
        if baseline is not None:
            self.baseline = dataclasses.replace(baseline, sigma=plausible_noise(baseline.z0, baseline.sigma))
            self.normaliser = self.pre.normaliser(baseline.z0)
            self.sigma = self.baseline.sigma / self.normaliser
            self.news = True
            self.problem = baseline.doubt
            self.touched_at_start = self._surely_touched = False
            if not baseline.doubt:
                self.trusted = self.baseline

    def _refer(self, amplitude: Array, frame: RawFrame) -> bool:
        """An imported file says that this frame is untouched: it is the baseline until the next one."""
        found = self.references.baseline(amplitude, frame.scan, frame.board, self.last_sample_ns)
        if found is None:
            self._use(None)
            self.problem = f"scan {frame.scan} is to be the baseline, but half of its measurements give no value"
        else:
            self.set_baseline(found)
            self.sigma = self.references.sigma(found, self.pre)
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
            "follower": self.drift_filter.state(),
            "references": self.references.state(),
            **self.window.state(),
            "run": self._run,
            "last_sample_ns": self.last_sample_ns,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises NoBaseline where the state is of another number of measurements, or not possible; KeyError, TypeError
        or ValueError where a part of it does not fit.

        A state of another bundle still says what the untouched skin measured: so old recordings replay on new bundles.
        """
        self.reset()
        k = len(self.bundle.pattern)
        if state["baseline"] is not None:
            self._use(Baseline.from_dict(state["baseline"], k))
            assert self.baseline is not None
            if state["bundle"] == self.bundle.hash:
                self.normaliser, self.sigma = saved_noise(state, self.baseline)
        if "references" in state:  # older recordings have none
            self.references.load(state["references"])
        self.window.load(state)
        self._run = int(state["run"])
        self.last_sample_ns = int(state["last_sample_ns"])
        self.drift_filter.begin(self.last_sample_ns)
        if "follower" in state and state["bundle"] == self.bundle.hash:
            self.drift_filter.load(state["follower"])

    def succeed(self, before: BaselineEstimator) -> None:
        """Go on where another estimator of the same skin is, whose bundle describes it less well."""
        self.load(before.state())
        self.source, self._board, self.undated_s = before.source, before._board, before.undated_s
        self.revision = before.revision + 1
        self.drift_filter.begin(self.last_sample_ns, before.since_s(self.last_sample_ns))

    def _date(self) -> None:
        """Stamps begin anew with a boot: with the first frame it is known when a restored baseline was taken."""
        if self.undated_s and self.baseline is not None:
            taken_ns = self.last_sample_ns - round(self.undated_s * 1e9)
            self.baseline = dataclasses.replace(self.baseline, taken_ns=taken_ns)
            self.undated_s = 0.0
