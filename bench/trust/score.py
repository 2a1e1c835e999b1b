"""What is counted of a session, as numbers that add up over sessions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

BINS = 40  # a decade of sigma
PHASES = ("begin", "hold", "slide", "end")
NOTES = 60
WORST = ("phantom", "hidden", "never shown", "refused", "aged", "force 6 sigma", "place 6 sigma", "wrong count")
"""What makes a session a failing one, the worst first."""


@dataclass
class TrustScore:
    """counts, sums: by name, some with a phase or a fault after a slash. sigmas: "force/hold/-37" -> how many frames
    had a sigma in that bin.
    """

    seconds: float = 0.0  # simulated
    cpu_s: float = 0.0
    sessions: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    sums: Counter[str] = field(default_factory=Counter)
    sigmas: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def add(self, other: Self) -> None:
        self.seconds += other.seconds
        self.cpu_s += other.cpu_s
        self.sessions += other.sessions
        for mine, more in ((self.counts, other.counts), (self.sums, other.sums), (self.sigmas, other.sigmas)):
            mine.update(more)  # a sum of counters would lose what is below zero
        self.notes = [*self.notes, *other.notes][:NOTES]

    def sigma(self, of: str, phase: str, value: float) -> None:
        self.sigmas[f"{of}/{phase}/{math.floor(math.log10(max(value, 1e-12)) * BINS)}"] += 1

    def median_sigma(self, of: str, phases: tuple[str, ...] = PHASES) -> float | None:
        found: Counter[int] = Counter()
        for key, n in self.sigmas.items():
            name, phase, place = key.split("/")
            if name == of and phase in phases:
                found[int(place)] += n
        if not found:
            return None
        order = sorted(found)
        at = int(np.searchsorted(np.cumsum([found[k] for k in order]), sum(found.values()) / 2))
        return float(10 ** ((order[at] + 0.5) / BINS))

    def percent(self, part: str, whole: str) -> float | None:
        return 100 * self.counts[part] / self.counts[whole] if self.counts[whole] else None

    def beyond(self, of: str, sigmas: int) -> float | None:
        """Percent of frames, all phases, changing and coarse ones too."""
        n = sum(self.counts[f"{of} n/{phase}"] for phase in PHASES)
        return 100 * sum(self.counts[f"{of} {sigmas}/{phase}"] for phase in PHASES) / n if n else None

    def log_score(self, of: str) -> float | None:
        n = sum(self.counts[f"{of} n/{phase}"] for phase in PHASES)
        return self.sums[f"{of} log"] / n if n else None

    def to_dict(self) -> dict[str, Any]:
        return vars(self)

    @classmethod
    def of(cls, found: Mapping[str, Any]) -> Self:
        """From what `to_dict` gave. Raises KeyError, TypeError for something else."""
        counts, sums, sigmas = (Counter(found[name]) for name in ("counts", "sums", "sigmas"))
        return cls(found["seconds"], found["cpu_s"], found["sessions"], counts, sums, sigmas, list(found["notes"]))

    def row(self) -> dict[str, Any]:
        """The figures of a table."""
        said = self.counts
        return {
            "minutes": self.seconds / 60,
            "frames": said["frames"],
            "touches": said["touches"],
            "phantom frames": said["phantom"],
            "phantom incidents": said["phantom incidents"],
            "wrong counts": said["wrong count"],
            "hidden": said["hidden"],
            "hidden briefly": said["hidden briefly"],
            "none shown": said["hidden briefly, none shown"],
            "never shown": said["never shown"],
            "ids": said["id changed"],
            "refused": said["refused"],
            "aged": said["aged"],
            "faults": said["faults"],
            "named": said["named"],
            "late": said["named late"],
            "false": said["named falsely"],
            "ended": said["ended"],
            "back late": said["back late"],
            "back s": self.sums["back s"] / said["ended"] if said["ended"] else None,
            "cpu s": self.cpu_s,
            "force 3 %": self.beyond("force", 3),
            "force 6": sum(said[f"force 6/{phase}"] for phase in PHASES),
            "place 3 %": self.beyond("place", 3),
            "place 6": sum(said[f"place 6/{phase}"] for phase in PHASES),
            "valid untouched %": self.percent("untouched valid", "untouched"),
            "valid touched %": self.percent("touched valid", "touched"),
            "valid in faults %": self.percent("in fault valid", "in fault"),
            "changing %": self.percent("changing", "touched valid"),
            "coarse %": self.percent("coarse", "touched valid"),
            "force sigma": self.median_sigma("force"),
            "force sigma held": self.median_sigma("force", ("hold",)),
            "place sigma mm": _mm(self.median_sigma("place")),
            "place sigma held mm": _mm(self.median_sigma("place", ("hold",))),
            "force log": self.log_score("force"),
            "place log": self.log_score("place"),
            "by fault": {
                name: self.percent(f"in fault valid/{name}", f"in fault/{name}")
                for name in sorted(key.partition("/")[2] for key in said if key.startswith("in fault/"))
            },
            "notes": self.notes,
        }


def _mm(metres: float | None) -> float | None:
    return None if metres is None else metres * 1e3
