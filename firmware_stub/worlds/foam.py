"""Foam that creeps under a touch and remembers it.

The drop that a force makes grows while the force lasts, J(t) = 1 + c(t) times what it is at once, and each change of
the force adds by itself (Boltzmann's superposition: J. D. Ferry, "Viscoelastic Properties of Polymers", 1980, chapter
1). So what stays after a release is what crept in, and it fades as it came.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise


class CreepLaw(ABC):
    """c(t), what a force that began t seconds ago has added to its drop, relative; 0 until it begins."""

    def added(self, t: float, times: Sequence[float], values: Sequence[float]) -> float:
        """What has been added at t to a drop that follows `values` at `times`, linear in between and 0 outside."""
        keys = [(times[0], 0.0), *zip(times, values, strict=True), (times[-1], 0.0)]
        total = 0.0
        for (a, p), (b, q) in pairwise(keys):
            if b > a:
                total += (q - p) / (b - a) * (self.summed(t - a) - self.summed(t - b))
            else:
                total += (q - p) * self.at(t - a)
        return total

    @abstractmethod
    def at(self, t: float) -> float:
        """c(t)."""

    @abstractmethod
    def summed(self, t: float) -> float:
        """The integral of c from 0 to t."""


@dataclass(frozen=True)
class ExponentialCreep(CreepLaw):
    """c(t) = sum of share (1 - exp(-t / tau))."""

    terms: tuple[tuple[float, float], ...]  # (share, tau [s])

    def at(self, t: float) -> float:
        return 0.0 if t <= 0 else sum(share * -math.expm1(-t / tau) for share, tau in self.terms)

    def summed(self, t: float) -> float:
        if t <= 0:
            return 0.0
        return sum(share * (t + tau * math.expm1(-t / tau)) for share, tau in self.terms)


@dataclass(frozen=True)
class PowerCreep(CreepLaw):
    """c(t) = share ((t + 0.1 s) / 60 s)^exponent, less what that is at 0."""

    share: float  # added in a minute, nearly
    exponent: float
    early_s = 0.1  # before which the power of time says more than anybody measured

    def at(self, t: float) -> float:
        if t <= 0:
            return 0.0
        n = self.exponent
        return float(self.share * (((t + self.early_s) / 60) ** n - (self.early_s / 60) ** n))

    def summed(self, t: float) -> float:
        if t <= 0:
            return 0.0
        n, start = self.exponent, self.early_s / 60
        whole = 60 / (n + 1) * (((t + self.early_s) / 60) ** (n + 1) - start ** (n + 1))
        return float(self.share * (whole - t * start**n))
