"""How much of a changed contact impedance is surely the contact's, and how much may be a touch on its electrode."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from models.measurement.arrays import Array
from services.estimation.values import numbers as n

JUMP = 0.3  # of a change that jumped: so much at most was there before, or came later; a press that takes six scans and
# more has more of both, chosen on presses of 0.1 N on electrodes that take 1 to 20 scans
LEAST_SIZES = 6  # of a line
PACES_S = (float(n.PACE_S), 3 * float(n.PACE_S))  # for which a pace is looked for


@dataclass
class SizeAt:
    """Of a contact's change, by one whole scan."""

    at_s: float
    size: float


@dataclass
class ContactState:
    """All that changes of one contact that has changed. Sizes are relative changes of its impedance."""

    undecided: bool = False  # what goes beyond `decided` may be a touch
    decided: float = 0.0
    over: Annotated[Array | None, "K"] = None  # sum of log |Z| over a skin with what is decided, touches taken off
    scans: int = 0  # of that sum
    seen: int = 0  # whole scans for which it has been undecided
    sizes: list[SizeAt] = field(default_factory=list)  # of the last scans
    pace: float = 0.0  # of a contact that drifts [1/s]
    drifts_until_s: float = -np.inf  # as far as is known
    beside: bool = False  # a touch may be the reason: one reached the electrode, or the scan is explained roughly
    jumps: float = 0.0  # by how much it has jumped before, and no touch was seen
    unsure: float = 0.0  # by how much a scan's size may be off by its noise alone, with nothing to be seen of a touch

    def change(self, decided: float, size: float) -> None:
        """A contact has changed, or changes anew: beyond `decided` nobody knows why, unless it jumps once more."""
        least = min([decided, *(each.size for each in self.sizes)])  # of late: what rises on is no jump
        if self.jumps and size - least < self.jumps + self.least:
            self.end(size)
            return
        self.undecided, self.decided = True, decided
        self.over, self.scans, self.seen = None, 0, 0

    def end(self, size: float) -> None:
        """It is the contact's, all of it."""
        self.undecided, self.decided = False, size
        self.over, self.scans = None, 0

    @property
    def least(self) -> float:
        """Change beyond what is decided that is one: more than is let pass anywhere, and than noise makes."""
        return max(n.CONTACT_STILL * (1 + abs(self.decided)), self.unsure)

    def falls(self, size: float) -> bool:
        """Whether what nobody knows is less than a scan before, and nothing else had changed."""
        known = abs(self.decided) > n.CONTACT_STILL or not self.sizes
        return self.undecided and not known and self.sizes[-1].size - size > n.CONTACT_STILL

    def follow(self, at_s: float, size: float, sd: float, home: float) -> None:
        """A contact goes on: what falls is no touch, nor what drifts on at the pace that it had. sd: of this size;
        home: where it is well, as it was at the tare or as it has become.
        """
        self.unsure = float(np.sqrt(n.FALSE_ALARM_Z2)) * sd
        self.seen += self.undecided
        before = self.sizes[-1] if self.sizes else SizeAt(at_s, size)
        passed_s, step, least = at_s - before.at_s, size - before.size, self.least
        self.sizes = [*(each for each in self.sizes if each.at_s > at_s - PACES_S[-1] - passed_s), SizeAt(at_s, size)]
        if size < self.decided - least or abs(size) < n.CONTACT_STILL:  # or it is what it was at the tare
            self.end(size)
        elif not self.undecided:  # as slowly the untouched skin's contacts are followed as well
            self.decided += min(max(size - self.decided, 0.0), n.PACE_UNSEEN * passed_s)
        steadily = abs(step) < n.PACE_GROWS * self.pace * passed_s + least
        if at_s < self.drifts_until_s and not self.undecided and steadily:
            self.decided = size
        if pace := max(self._pace(each_s) for each_s in PACES_S):
            self.pace, self.drifts_until_s = pace, at_s + n.CONTACT_SETTLES_S
            self.end(size)
        if self.stays(home):
            self.drifts_until_s = at_s
        if not self.undecided and size - self.decided > least:
            self.change(self.decided, size)

    def lately(self, at_s: float) -> float:
        """Mean size of the last scans."""
        return float(np.mean([each.size for each in self.sizes if each.at_s > at_s - n.PACE_S] or [self.decided]))

    def stays(self, home: float) -> bool:
        """Whether it has been well for as long as the slowest pace takes to be seen: then it drifts no more."""
        if not self.sizes or self.sizes[-1].at_s - self.sizes[0].at_s < PACES_S[-1]:
            return False
        sizes = np.array([each.size for each in self.sizes])
        sd = float(sizes.std()) / np.sqrt(len(sizes))
        return bool(abs(float(sizes.mean()) - home) < n.CONTACT_BACK + n.SIGMAS * sd)

    def _pace(self, lasts_s: float) -> float:
        """At which it moved on steadily for so long, longer than a touch takes to come; 0: it did not [1/s]."""
        times, sizes = np.array([(each.at_s, each.size) for each in self.sizes]).T
        before = np.flatnonzero(times <= times[-1] - lasts_s)
        if not before.size or len(times) - before[-1] < LEAST_SIZES:
            return 0.0
        times, sizes = times[before[-1] :] - times[before[-1]], sizes[before[-1] :] - sizes[before[-1]]
        way = float(sizes[-1])
        if abs(way) < n.PACE_LEAST:
            return 0.0
        off = np.abs(sizes / way - times / times[-1]).max()
        return abs(way) / float(times[-1]) if off < n.PACE_BENDS else 0.0

    def add(self, over: Array) -> Array:
        """(K,) mean of the scans of the change that nobody knows, with one more."""
        self.over = over if self.over is None else self.over + over
        self.scans += 1
        return self.over / self.scans
