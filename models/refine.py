"""Fits of touches to frames, in a process of their own beside a service (numpy and scipy).

    python -m models.refine            reads jobs from standard input and writes an answer for each to standard output

Both are pickled, from and to the process that started it, and nobody else (services/refinement.py). It ends when its
standard input does.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.response_error import FrameErrors, frame_errors
from models.shapes import KINDS, Array, Shape
from models.touch_fit import TouchFit, bent
from models.touch_posterior import UNLIKELY_NOW, TouchPosterior
from models.touch_response import TouchResponse
from protocol.errors import EitskinError

CELLS = (12, 20)
CONTACT_TO_SCALE = 4.0  # of drift: standard deviations of contact impedances over that of the whole sheet
NICE = 10  # frames come first
REMEMBERED = 8  # bundles


@dataclass(frozen=True)
class RefineJob:
    """One frame. d, sigma (K,): the difference and its standard deviation, infinite where it is not measured. start:
    where the network sees the touch. radius: of the indenter, model units. drift: rms that drift may have done to d.
    """

    skin: str
    number: int
    bundle: str  # its folder
    d: Array
    sigma: Array
    start: Shape
    kinds: tuple[str, ...]
    radius: float | None = None
    tare_frames: float = 64.0
    drift: float = 0.0
    before: dict[str, Array] = field(default_factory=dict)  # what an earlier frame of the same touch gave


@dataclass(frozen=True)
class RefineAnswer:
    """posterior: None where `problem` says why there is none. live (K,): the measurements that it was fitted to."""

    skin: str
    number: int
    posterior: TouchPosterior | None
    live: NDArray[np.bool_]
    took_s: float
    problem: str = ""


Responses = tuple[TouchResponse, TouchResponse]
"""With few cells, to find the kinds that it may be; with many, to know their parameters."""


def responses_of(bundle: Bundle) -> Responses:
    """Raises BundleError."""
    tables, z0 = bundle.response(), bundle.z0.astype(float)
    coarse, fine = (TouchResponse(tables, bundle.pattern, z0, cells) for cells in CELLS)
    return coarse, fine


def refined_fit(
    coarse: TouchResponse,
    fine: TouchResponse,
    d: Array,
    errors: FrameErrors,
    start: Shape,
    kinds: Sequence[str] = KINDS,
    radius: float | None = None,
    before: Mapping[str, Array] | None = None,
) -> TouchPosterior:
    """As TouchFit, in two steps. Raises ValueError where a covariance is none."""
    before = before or likely(TouchFit(coarse, scales=(1.0,))(d, errors, start, kinds, radius))
    return bent(fine, TouchFit(fine)(d, errors, start, kinds, radius, before))


class Refiner:
    """Answers jobs, one after another. Bundles are read once."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Bundle, Responses]] = {}

    def __call__(self, job: RefineJob) -> RefineAnswer:
        began, live = time.perf_counter(), np.isfinite(job.sigma)
        try:
            posterior, problem = self._fitted(job, live), ""
        except Exception as why:  # the next frame may well be fitted
            said = str(why) if isinstance(why, EitskinError | ValueError) else f"{type(why).__name__}: {why}"
            posterior, problem = None, f"a touch could not be fitted: {said}"
        return RefineAnswer(job.skin, job.number, posterior, live, time.perf_counter() - began, problem)

    def _fitted(self, job: RefineJob, live: NDArray[np.bool_]) -> TouchPosterior:
        bundle, responses = self._of(job.bundle)
        if len(job.d) != len(bundle.z0) or len(job.sigma) != len(bundle.z0):
            raise ValueError(f"a frame of {len(job.d)} measurements, expected {len(bundle.z0)}, as the bundle has")
        if not np.isfinite(job.d[live]).all():
            raise ValueError("a frame with measurements that are no numbers, expected sigma to be infinite there")
        m, d = bundle.matrices, job.d[live]
        drift = None
        if job.drift > 0:
            contact = m.contact[live].astype(float)
            shape = 1.0 + CONTACT_TO_SCALE**2 * contact @ contact.T
            drift = job.drift**2 / float(np.diag(shape).mean()) * shape
        gram = m.gram[np.ix_(live, live)].astype(float)
        errors = frame_errors(gram, job.sigma[live], d, job.start.drop, job.tare_frames, drift)
        coarse, fine = responses if live.all() else (response.of_rows(live) for response in responses)
        return refined_fit(coarse, fine, d, errors, job.start, job.kinds, job.radius, job.before)

    def _of(self, folder: str) -> tuple[Bundle, Responses]:
        if folder not in self._known:
            bundle = Bundle.load(folder)
            if len(self._known) >= REMEMBERED:
                self._known.pop(next(iter(self._known)))
            self._known[folder] = bundle, responses_of(bundle)
        return self._known[folder]


def likely(posterior: TouchPosterior) -> dict[str, Array]:
    """theta of each kind that the touch may be, for the fit of a later frame."""
    return {fit.kind: fit.theta for fit in posterior.fits if posterior.probability[fit.kind] > UNLIKELY_NOW}


def start_of(image: NDArray[np.floating]) -> Shape | None:
    """Where and how large the touch in an image (n, n) of the square [-1, 1]^2 is: the circle of what exceeds half the
    peak. None where it shows nothing.
    """
    peak = float(image.max(initial=0.0))
    if not 0 < peak < np.inf:
        return None
    mask = image > 0.5 * peak
    axis = -1 + 2 * (np.arange(len(image)) + 0.5) / len(image)
    count = int(mask.sum())
    x, y = float(mask.sum(axis=0) @ axis) / count, float(mask.sum(axis=1) @ axis) / count
    return Shape("circle", x, y, float(np.sqrt(4 * count / mask.size / np.pi)), float(np.clip(peak, 0.03, 0.9)))


def main() -> None:
    """Until standard input ends. Whatever is printed goes to standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for who started us
    os.nice(NICE)
    jobs, answers = Connection(os.dup(0), writable=False), Connection(os.dup(1), readable=False)
    os.dup2(2, 1)
    refiner = Refiner()
    try:
        while True:
            answers.send(refiner(jobs.recv()))
    except (EOFError, OSError):
        sys.exit(0)


if __name__ == "__main__":
    from models import refine  # answers are pickled by that name

    refine.main()
