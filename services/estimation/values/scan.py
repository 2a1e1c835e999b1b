"""The estimator's one input: a scan of the board, or the newest values after a part of one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.arrays import Array, Mask
from models.measurement.numbers import SCAN_S
from protocol.frames import RawFrame, as_sent

NANOSECOND, US = 1e-9, 1e-6  # of clocks [s]
PER_S = 1 / US
CLOCKS_PART = 1e-3  # by which the board's clock and the host's part at most
SHORTEST_S, LONGEST_S = 0.005, 2.0  # of a scan that any board measures


@dataclass(frozen=True)
class Scan:
    """K measurements in the pattern's order. Made once, at the door; nobody changes it."""

    values: Annotated[Array, "K", "gaps"]  # |Z|, ohm or counts
    ages_s: Annotated[Array, "K"]  # by how much each value is older than the newest one's end
    new: Annotated[Mask, "K"]  # measured after the scan that was stepped before
    status: Annotated[NDArray[np.uint8], "K"]  # bits, protocol.frame_types.STATUS_*
    number: int  # the board's
    part: int  # of a scan in parts: the part measured last, from 1 on; 0: a whole scan
    end_us: float  # board's clock at the end of the newest value
    at_ns: int  # the same by the host's monotonic clock
    sample_ns: int  # for when what is said of this scan stands: the frame's stamp `sample`
    duration_s: float  # in which all K values were measured
    board: str
    separate: bool  # stands by itself: it does not follow the scan before it in time
    believed: bool  # acquisition's word
    reasons: tuple[str, ...]  # as they came

    def alone(self) -> Scan:
        """The same of a scan that stands by itself: whoever measured it waited, and nobody knows in which order."""
        return replace(self, separate=True, ages_s=np.full(len(self.values), self.duration_s / 2))

    @classmethod
    def of(cls, frame: RawFrame, before: Scan | None = None) -> Scan:
        """The scan of a raw frame. before: the one that was stepped last; values are new by their instants, so what a
        message that was skipped brought is new too.
        """
        count = len(frame.z)
        if len(frame.age_us):
            ages_s = frame.age_us.astype(float) * US
            newest_s = _spanned_s(ages_s[frame.new != 0] if len(frame.new) else ages_s)
            duration_s = min(max(_spanned_s(ages_s), SHORTEST_S), LONGEST_S)
        else:
            duration_s = newest_s = _duration_s(frame, before)
            ages_s = duration_s * (1 - (np.arange(count) + 0.5) / max(count, 1))
        end_us = frame.device_us + PER_S * newest_s
        sample_ns = frame.stamps.get("sample", 0)
        at_ns = sample_ns + round(newest_s / 2 / NANOSECOND)
        valid, reasons = as_sent(frame)  # measurements that failed are left out
        new = np.ones(count, bool)
        if before is not None and before.board == frame.board and end_us > before.end_us:
            new = end_us - PER_S * ages_s > before.end_us
            passed_ns = round((end_us - before.end_us) * US / NANOSECOND)
            off_ns, most_ns = at_ns - before.at_ns - passed_ns, round(CLOCKS_PART * passed_ns)
            if abs(off_ns) < newest_s / NANOSECOND:  # what the host's clock says of the board's changes as it learns
                at_ns = before.at_ns + passed_ns + min(max(off_ns, -most_ns), most_ns)
        return cls(
            values=np.abs(frame.z.astype(np.complex128)),
            ages_s=ages_s,
            new=new,
            status=frame.status,
            number=frame.scan,
            part=frame.part,
            end_us=end_us,
            at_ns=at_ns,
            sample_ns=sample_ns,
            duration_s=duration_s,
            board=frame.board,
            separate="separate" in frame.reasons,
            believed=valid,
            reasons=tuple(reasons),
        )


def _spanned_s(ages_s: Array) -> float:
    """In which values were measured one after the other; each age is that of its middle."""
    count = len(ages_s)
    return float(ages_s.max()) * count / (count - 0.5) if count else 0.0


def _duration_s(frame: RawFrame, before: Scan | None) -> float:
    """Of a whole scan: what passed since the one before it, as boards measure one after the other."""
    if before is None or before.part:
        return float(SCAN_S)  # a board's clock says nothing yet
    passed_s = (frame.device_us - before.end_us) * US + before.duration_s
    follows = frame.scan == before.number + 1 and SHORTEST_S < passed_s < LONGEST_S
    return passed_s if follows else before.duration_s
