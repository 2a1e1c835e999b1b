"""What a further disc would explain of what is left of a scan, and since when it would act."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from models.measurement.arrays import Array, Mask, Single
from models.measurement.noise import BURST_BLOCK
from models.measurement.numbers import COURSE_S, LEAST_TOLD
from models.measurement.response import DiscGrid
from models.measurement.touch import LOG_RADIUS, PLACE
from models.measurement.whitening import Whitening, leave_out
from services.estimation.hypotheses.innovation import ONSETS, Innovation, Observation, ScoredAnswer
from services.estimation.values import numbers as n

MOST_SMALL = 400  # discs of which all pairs are tried: on a map of 2,000 places they would take 0.3 s
PAIRS = 3  # from which a third disc is looked for; with 1, one in five threes of tips is not found, with 6 as many


class Detection(NamedTuple):
    """A further disc of the grid."""

    z2: float
    disc: int
    action: float
    since_s: float  # it acts


class DiscActions(NamedTuple):
    """Normal equations of the actions of n discs, of which a few explain a scan."""

    gram: Array  # (n, n)
    along: Array  # (n,)
    energy: float  # of the scan
    apart: Mask  # (n, n) none on the other one

    def solved(self, chosen: list[int], more: Array) -> Array:
        """(t, ...) least squares of those discs to (n, ...)."""
        return np.asarray(np.linalg.solve(self.gram[np.ix_(chosen, chosen)], more[chosen]))

    def left(self, chosen: list[int]) -> float:
        """Energy that they leave."""
        return self.energy - float(self.along[chosen] @ self.solved(chosen, self.along))

    def pairs(self) -> list[list[int]]:
        """Pairs that leave least, the best one first, none with a disc of another one."""
        own, along = np.diag(self.gram), self.along
        action = own * along[:, None] - self.gram * along  # of each beside each, times the determinant
        explains = action * along[:, None] / np.maximum(own * own[:, None] - self.gram**2, n.TINY)
        explains = np.where(self.apart & (action > 0) & (action.T > 0), explains + explains.T, 0.0)
        found = list[list[int]]()
        for k in np.argsort(-explains.max(axis=1)).tolist():
            pair = [k, int(explains[k].argmax())]
            if explains[k].max() > 0 and not any({*pair} & {*other} for other in found):
                found.append(pair)
            if len(found) == PAIRS:
                break
        return found

    def beside(self, before: list[int]) -> tuple[list[int], float]:
        """Some discs and one more, each where it leaves least beside the others, and what they leave."""
        chosen, left, own = [*before, -1], self.energy, np.diag(self.gram)
        for k in [len(before), *range(len(before)), len(before)]:
            others = chosen[:k] + chosen[k + 1 :]
            known = self.solved(others, self.gram)
            along = np.maximum(self.along - self.along[others] @ known, 0.0)
            precision = np.maximum(own - np.sum(self.gram[others] * known, axis=0), float(LEAST_TOLD) * own)
            explains = np.where(self.apart[:, others].all(axis=1), along**2 / precision, 0.0)
            if explains.max() <= 0:
                return before, np.inf
            chosen[k], left = int(explains.argmax()), self.left(others) - float(explains.max())
        return chosen, left


class TouchDetector:
    """The generalised likelihood ratio of one further disc, over all discs of a grid and instants at which it may have
    begun. wrong: share of a touch's change that its response gets wrong.
    """

    def __init__(self, grid: DiscGrid, wrong: float) -> None:
        self._grid, self._wrong = grid, wrong
        self._squares = grid.responses**2
        small = np.flatnonzero(grid.discs[:, LOG_RADIUS] == grid.discs[:, LOG_RADIUS].min())
        self._small = small[:: len(small) // MOST_SMALL + 1]  # (S,) of which several tell most

    @cached_property
    def _apart(self) -> Mask:
        """(S, S) discs that are no neighbours."""
        discs = self._grid.discs[self._small]
        away = np.hypot(*(discs[:, None, PLACE] - discs[:, PLACE]).transpose(2, 0, 1))
        return np.asarray(away > 2 * np.exp(discs[0, LOG_RADIUS]) + n.NEIGHBOURS)

    def best(self, innovation: Innovation, answer: ScoredAnswer, onsets: Sequence[float] = ()) -> Detection:
        """The disc that would explain most of what an answer leaves. onsets: shares of the scan after which it may have
        begun. One that acts in the whole scan is so unless that leaves more than its response gets wrong.
        """
        weighted_residual = answer.weighted_residual
        since_s = np.array([-np.inf, *((share - 0.5) * innovation.span_s for share in onsets)])
        acts = (innovation.times_s[:, None] >= since_s).astype(np.float32)  # (K, n)
        shares = self._shares(acts, answer.white) if onsets else np.ones((1, 1), np.float32)
        along = np.maximum(self._grid.responses @ (acts * weighted_residual[:, None].astype(np.float32)), 0)
        discs = (along**2 / (innovation.information[:, None] * shares)).argmax(axis=0)  # (n,)
        columns = self._grid.responses[discs].T.astype(float) * acts
        along = np.maximum(weighted_residual @ columns, 0.0)
        exact = answer.informations(columns)
        z2 = along**2 / exact - np.where(since_s > -np.inf, float(n.ONSET_Z2), 0.0)
        found = zip(z2.tolist(), discs.tolist(), (along / exact).tolist(), since_s.tolist(), strict=True)
        whole, *begun = (Detection(*each) for each in found)
        if not begun:
            return whole
        sharper = self._sharper(innovation, answer, max(whole, *begun))
        return sharper if sharper.z2 > whole.z2 * (1 + 2 * self._wrong) else whole

    def several(self, innovation: Innovation, since_s: float, least: int) -> list[list[Detection]]:
        """Two, three and four discs that explain a scan together, none of them on another one, all since an instant
        that is known roughly. At least so many, in a whole scan as many as leave least, where one more leaves less than
        SEVERAL of what fewer do; with 1, none where that is one. None either where one leaves no more than noise, or
        than the best disc of the grid leaves of one touch.
        """
        covariance = innovation.covariance.copy()
        leave_out(covariance, np.abs(innovation.times_s - since_s) > COURSE_S)
        y = np.clip(np.where(innovation.live, innovation.y, 0.0), -1.0, 1.0)
        weight = np.exp(-y) * (innovation.times_s >= since_s)  # slopes of the logarithm, once all is explained
        white = Whitening.of(covariance).w
        weighted, target = (white * weight).astype(np.float32), white @ (1 - np.exp(-y))
        energy, responses = float(target @ target), self._grid.responses
        along = np.maximum(responses @ (weighted.T @ target.astype(np.float32)), 0.0)
        disc = int((along**2 / (self._squares @ np.sum(weighted**2, axis=0) + n.TINY)).argmax())
        for discs in (responses[[disc]], responses):  # one is enough where one touches, and all take a millisecond
            columns = weighted @ discs.T
            own = np.sum(columns**2, axis=0) + n.TINY
            one = energy - float((np.maximum(target @ columns, 0.0) ** 2 / own).max())
            if one < max(n.GRID_MISSES * energy, n.GOOD * int(innovation.live.sum())):
                return []
        columns = columns[:, self._small].astype(float)
        actions = DiscActions(columns.T @ columns, columns.T @ target, energy, self._apart)
        if not (pairs := actions.pairs()):
            return []
        three = min((actions.beside(pair) for pair in pairs), key=lambda each: each[1])
        found = [([-1], one), (pairs[0], actions.left(pairs[0])), three, actions.beside(three[0])]
        likely = len(min(found, key=lambda each: each[1] * n.SEVERAL ** -len(each[0]))[0])
        if max(likely, least) < 2:
            return []
        least = max(least, likely if innovation.whole else 2)  # no part follows that tells more
        enough = [chosen for chosen, left in found if len(chosen) >= least and left < np.inf]
        each = [zip(self._small[k].tolist(), actions.solved(k, actions.along).tolist(), strict=True) for k in enough]
        return [[Detection(np.inf, disc, action, since_s) for disc, action in discs] for discs in each]

    def _sharper(self, innovation: Innovation, answer: ScoredAnswer, best: Detection) -> Detection:
        """The same disc since the likeliest instant: a strong touch tells it to a measurement or two, and must."""
        instants = innovation.instants
        column = self._grid.responses[best.disc].astype(float)
        columns = column[:, None] * (innovation.times_s[:, None] >= instants)
        along, exact = np.maximum(columns.T @ answer.weighted_residual, 0.0), answer.informations(columns)
        more = 2 * np.log(len(instants) / len(ONSETS))  # so many were tried
        z2 = along**2 / np.maximum(exact, n.TINY) - n.ONSET_Z2 - more
        k = int(z2.argmax())
        if z2[k] <= best.z2:
            return best
        return Detection(float(z2[k]), best.disc, float(along[k] / exact[k]), float(instants[k]))

    def _shares(self, acts: Single, white: Whitening) -> Single:
        """(A, n) share of each disc's information in the values in which it acts (K, n); the first acts in all."""
        precision = white.conditional_precisions().astype(np.float32)
        information = self._squares @ (precision[:, None] * acts)
        shares = information / information[:, :1] + np.float32(1e-3)
        shares[:, 0] = 1.0
        return np.asarray(shares)


def newest_z2(measured: Observation, white: Whitening, weighted_residual: Array) -> float:
    """Energy of the newest block of measurements beyond what it is expected to have, all others given."""
    newest = measured.order >= len(weighted_residual) - BURST_BLOCK
    own, left = white.w[:, newest], weighted_residual[newest]
    return float(left @ np.linalg.solve(own.T @ own, left)) - BURST_BLOCK
