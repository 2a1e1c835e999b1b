"""The first baseline of a skin, from its first frames: theirs, an earlier one that is trusted, or none yet."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.estimation.evidence import TouchEvidence
from services.estimation.start import StartVerdict, judge_start
from services.estimation.tare import Baseline

UNSURE = (
    "this skin differs from its bundle by as much as a touch may make: see that nothing touches it and run `skin tare` "
    "once"
)
PRESSED = "something touches the skin, and has since the start: free it; if nothing touches it, run `skin tare{}`"


class FirstBaseline(NamedTuple):
    touched: bool
    baseline: Baseline | None  # None: something touches, and hides the untouched skin
    drift: NDArray[np.float64] | None = None  # of a trusted baseline since it was taken: it is to be moved by it
    problem: str = ""  # where there is no baseline: why, and what to do
    surely: bool = False  # whether the touch explains the skin: a tare's word does not count against it


def first_baseline(found: Baseline, trusted: Baseline | None, evidence: TouchEvidence) -> FirstBaseline:
    """found: the mean of the first frames; trusted: the last baseline of this skin and board without doubt."""
    noise = found.sigma / np.sqrt(found.frames)
    start = judge_start(found.z0, noise, evidence, None if trusted is None else trusted.z0)
    if start.verdict is not StartVerdict.TOUCHED:
        unsure = start.verdict is StartVerdict.UNKNOWN and not found.doubt
        return FirstBaseline(False, dataclasses.replace(found, doubt=UNSURE) if unsure else found)
    if trusted is None or start.explanation is None or not start.explanation.fits:
        return FirstBaseline(True, None, problem=PRESSED.format(" --force" * start.sure), surely=start.sure)
    return FirstBaseline(True, dataclasses.replace(trusted, sigma=found.sigma), start.explanation.drift)
