"""Touched or not, and by how much drift the frame is to be explained: the operators for it, made ahead of need.

`TouchDetector` compares a difference under the step of the drift prior (services/estimation/drift_prior.py) that
explains it best, of those that the time since the last untouched frame permits. A touch keeps its step until another
one explains it clearly better: a held touch must not fade because time goes on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Operator, PreReconstructor
from services.estimation.creep import Creep
from services.estimation.drift import DriftRates
from services.estimation.drift_prior import DriftPrior, MarginalLikelihood
from services.estimation.saved import shaped
from services.estimation.touch_decision import TouchDecision

Array = NDArray[np.float64]

OPERATORS = 16  # kept; 0.4 MB each
ASK_S = 1.0  # how often a touch's drift is asked for, and over how long its frames are averaged
AGAIN_S, AGAIN_MOST_S = 0.25, 4.0  # how soon a touch that drift alone may be is looked at again, doubling
ALONE_S = 60.0  # without an untouched frame: contacts may have drifted by 5 % (contact_per_s of skin.toml)
STEADY = 2  # steps that are taken without asking: those of the baseline's own delay
DECISIVE = 45.0  # log likelihood by which a touch must explain a frame better than drift that time permits
SUREST = 1e-4  # relative: below it drift and the model are what a mean is wrong by, and they do not average out
CLEARLY = 3.0  # difference of log likelihoods from which another step is taken


class Noise(NamedTuple):
    """What the tare found."""

    sigma: Array  # (K,) of d, one frame
    frames: int  # that the baseline is the mean of
    found_from: int = 0  # frames that sigma was found from; 0: the same

    def of_mean(self, n: int) -> Noise:
        """That of the mean of n frames, as far as noise is what it is wrong by: not below SUREST."""
        finite = self.sigma[np.isfinite(self.sigma)]
        most = int((float(np.median(finite)) / SUREST) ** 2) if finite.size else 1
        n = min(n, max(1, most))
        return self if n == 1 else Noise(self.sigma / np.sqrt(n), max(1, self.frames // n), self.found_from)


class TouchVerdict(NamedTuple):
    touched: bool
    score: float
    threshold: float
    operator: Operator
    decision: TouchDecision


class TouchDetector:
    def __init__(self, pre: PreReconstructor, rates: DriftRates, false_alarms: float) -> None:
        """false_alarms: probability that an untouched frame counts as touched."""
        self.pre, self.false_alarms = pre, false_alarms
        self.drift_prior = DriftPrior(rates)
        self._evidence: MarginalLikelihood | None = None
        self.creep = Creep(pre.measurements)
        self._operators: dict[tuple[bytes, bytes, int, int, int], tuple[Operator, TouchDecision]] = {}
        self.reset()

    def reset(self) -> None:
        self.step = 0  # of the allowance
        self._look_ns, self._again_s = 0, AGAIN_S  # when next, how long after that
        self._permitted = 0
        self.creep.reset()
        self._live = np.ones(self.pre.measurements, dtype=bool)
        self._gather(0)
        self._question: tuple[Array, Array, NDArray[np.bool_], list[int]] | None = None
        self._answers: dict[int, float] = {}

    def _gather(self, now_ns: int) -> None:
        self._sum, self._count, self._since_ns = np.zeros(self.pre.measurements), 0, now_ns

    def __call__(
        self, d: Array, live: NDArray[np.bool_], noise: Noise, since_s: float, now_ns: int, touched: bool
    ) -> TouchVerdict:
        """Judge the difference (K,) of a frame `since_s` after the last untouched one; touched: the frame before."""
        permitted = self._permitted = self.drift_prior.step(since_s)
        if not np.array_equal(live, self._live):
            self._live = live.copy()
            self._gather(now_ns)
            self._question = None
        self.step = permitted if not touched and permitted <= STEADY else min(self.step, permitted)
        found = self._judge(d, live, noise, touched)
        if found.touched and self.step < permitted and now_ns >= self._look_ns:
            if not self._judge(d, live, noise, touched, permitted).touched:  # drift may be all there is
                self._look_ns = now_ns + round(self._again_s * 1e9)
                self._again_s = min(2 * self._again_s, AGAIN_MOST_S)
                found = self._drift_or_touch(d, live, noise, touched) or found
        if found.touched and (rest := self.creep.taken_out(d, found.operator, now_ns)) is not None:
            found = self._judge(rest, live, noise, touched)
        if found.touched:
            self._follow(d, live, noise, now_ns)
        else:
            self.creep.untouched(d, found.operator, now_ns)
            self._look_ns, self._again_s = 0, AGAIN_S
            self._gather(0)
            self._question = None
        return found

    def _drift_or_touch(self, d: Array, live: NDArray[np.bool_], noise: Noise, touched: bool) -> TouchVerdict | None:
        """Untouched, under the likeliest step that says so, unless a touch is likelier by far."""
        cost = self._explain(d, noise.sigma, live, list(range(self._permitted + 1)))
        likeliest = sorted(cost, key=lambda step: cost[step])
        for step in likeliest:
            if cost[step] - cost[likeliest[0]] > DECISIVE:
                return None
            found = self._judge(d, live, noise, touched, step)
            if not found.touched:
                self.step = step
                return found
        return None

    def uncertain(self, since_s: float) -> bool:
        """Whether so much may have drifted since the last untouched frame that drift is read from a touched one.

        After a shorter gap (a fault, a board that was gone) it is not: one frame of a touch that just begins would be
        read as drift, and the baseline moved by it shows phantoms for as long as anything touches.
        """
        return since_s > ALONE_S

    def begin(
        self, d: Array, live: NDArray[np.bool_], noise: Noise, since_s: float, now_ns: int, alone: bool = False
    ) -> TouchVerdict:
        """The same for the first frame of a touch, against the baseline from before it was noticed. alone: against one
        whose drift was found in this very frame.
        """
        permitted = self._permitted = self.drift_prior.step(since_s)
        self._gather(now_ns)
        if alone:
            self.step = permitted
        elif permitted > STEADY:
            self._take(self._explain(d, noise.sigma, live, list(range(permitted + 1))))
        else:
            self.step = min(permitted, 1)
        found = self._judge(d, live, noise, True)
        return found._replace(touched=True)

    def _judge(
        self, d: Array, live: NDArray[np.bool_], noise: Noise, touched: bool, step: int | None = None
    ) -> TouchVerdict:
        operator, decision = self.operator(live, noise, self.step if step is None else step)
        return TouchVerdict(*decision(d, touched), operator, decision)

    # which step explains a touch

    def _follow(self, d: Array, live: NDArray[np.bool_], noise: Noise, now_ns: int) -> None:
        """Ask for a held touch's drift once every ASK_S; what was found is taken over when the next one is asked."""
        self._since_ns = self._since_ns or now_ns
        self._sum += d
        self._count += 1
        if now_ns - self._since_ns < ASK_S * 1e9:
            return
        self.creep.begin(self._sum / self._count, now_ns)
        if self._question is not None:
            while self._answer_one():
                pass
            self._take(self._answers)
        near = [s for s in (self.step, self.step - 1, self.step + 1) if 0 <= s <= self._permitted]
        sigma = noise.sigma * np.sqrt(1 / self._count + 1 / noise.frames)
        self._question = (self._sum / self._count, sigma, live.copy(), near) if len(near) > 1 else None
        self._answers = {}
        self._gather(now_ns)

    def _answer_one(self) -> bool:
        """One part of the work that a question makes; False where there is none left."""
        if self._question is None:
            return False
        d, sigma, live, steps = self._question
        left = [s for s in steps if s not in self._answers]
        if left:
            self._answers |= self._explain(d, sigma, live, left[:1])
        return len(left) > 1

    def _explain(self, d: Array, sigma: Array, live: NDArray[np.bool_], steps: list[int]) -> dict[int, float]:
        if self._evidence is None:
            self._evidence = MarginalLikelihood(self.pre, self.drift_prior)
        if not self._evidence.speaks:
            return {step: float(step == max(steps)) * -2 * CLEARLY for step in steps}
        return {step: self._evidence(d, sigma, live, step) for step in steps}

    def _take(self, cost: dict[int, float]) -> None:
        best = min(cost, key=lambda step: cost[step])
        if best != self.step and cost[best] + CLEARLY < cost.get(self.step, np.inf):
            self.step = best

    # operators

    def operator(self, live: NDArray[np.bool_], noise: Noise, step: int) -> tuple[Operator, TouchDecision]:
        """RM and the touch decision for these measurements, this noise, this allowance: made once, then kept."""
        key = self._key(live, noise, step)
        if key not in self._operators:
            if len(self._operators) >= OPERATORS:
                self._operators.pop(next(iter(self._operators)))
            operator = self.pre.condition(
                self.drift_prior.sigma(noise.sigma, self.pre.m.contact, step),
                drift=self.drift_prior.drift(step),
                weights=live.astype(float),
                tare_frames=noise.frames,
            )
            known_from = noise.found_from or noise.frames
            self._operators[key] = operator, TouchDecision(operator, self.false_alarms, known_from)
        return self._operators[key]

    @staticmethod
    def _key(live: NDArray[np.bool_], noise: Noise, step: int) -> tuple[bytes, bytes, int, int, int]:
        return live.tobytes(), noise.sigma.tobytes(), noise.frames, noise.found_from, step

    def of_mean(self, n: int, noise: Noise) -> Operator:
        """The operator for the mean of n frames of a touch that is held."""
        live = self._live & np.isfinite(noise.sigma)
        return self.operator(live, noise.of_mean(n), self.step)[0]

    def prepare(self, noise: Noise) -> bool:
        """Do one piece of what will be needed next; False where nothing is left. Changes no result."""
        live = self._live & np.isfinite(noise.sigma)
        near = {self.step, max(self.step - 1, 0), self._permitted, min(self._permitted + 1, self.drift_prior.widest)}
        for step in sorted(near):
            if self._key(live, noise, step) not in self._operators:
                self.operator(live, noise, step)
                return True
        if self._evidence is None:
            self._evidence = MarginalLikelihood(self.pre, self.drift_prior)
            return True
        return self._answer_one()

    # state

    def state(self) -> dict[str, Any]:
        question = None
        if self._question is not None:
            d, sigma, live, steps = self._question
            question = {"d": d, "sigma": sigma, "live": live.astype(np.uint8), "steps": list(steps)}
        return {
            "step": self.step,
            "look_ns": self._look_ns,
            "again_s": self._again_s,
            "permitted": self._permitted,
            "live": self._live.astype(np.uint8),
            "sum": self._sum.copy(),
            "count": self._count,
            "since_ns": self._since_ns,
            "question": question,
            "creep": self.creep.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        k = (self.pre.measurements,)
        self.step, self._permitted = (self._checked(int(state[key])) for key in ("step", "permitted"))
        self._look_ns, self._count, self._since_ns = (int(state[k]) for k in ("look_ns", "count", "since_ns"))
        self._again_s = float(state["again_s"])
        self._live, self._sum = shaped(state["live"], k) > 0, shaped(state["sum"], k)
        self.creep.load(state["creep"])
        asked = state["question"]
        if asked is not None:
            steps = [self._checked(int(step)) for step in asked["steps"]]
            sigma = shaped(asked["sigma"], k, finite=False)  # infinite where nothing is measured
            if not (sigma > 0).all():
                raise ValueError(f"a standard deviation of {sigma.min()}, expected all above 0")
            self._question = shaped(asked["d"], k), sigma, shaped(asked["live"], k) > 0, steps

    def _checked(self, step: int) -> int:
        if not 0 <= step <= self.drift_prior.widest:
            raise ValueError(f"step {step} of the drift allowance, expected 0 to {self.drift_prior.widest}")
        return step
