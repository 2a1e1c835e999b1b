"""A touch refined by physics: its place, size, drop and kind fitted to the measurements (models/touch_fit.py), where
skin.toml names the `indenter`.

    delta, image --> job --> services/refine_process.py   (refine_took_ms in the counters)
                       |<----------- answer
    image frames carry it as `refined` from the next frame on

No frame waits for a fit. An answer belongs to the frame it was made of; for later ones it moves along by one
Gauss-Newton step, to second order in place, while that explains how the measurements have changed, and goes where it
does not. While a fit runs, the newest frame waits for its turn, and older ones are skipped and counted. A fit begins
where the last one ended, or, of a touch that has slid further than one step goes, at that moved along with the image:
then it takes a few frames' time less, and its answer is young enough to be followed.
"""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.refine import RefineJob, likely, start_of
from models.shapes import KINDS, Shape
from models.touch_posterior import TouchPosterior
from protocol.frames import DeltaFrame, ImageFrame, RefinedTouch
from services.refine_process import RefineHere, RefineProcess, shared
from services.runtime.config import Skin

log = logging.getLogger(__name__)

MOST_ASKED = 1000  # frames whose fits are waited for: of older ones no answer comes any more
QUIET_DRIFT = 1e-6  # rms: less is none


class _Asked(NamedTuple):
    """A frame that is fitted: its scan, difference (K,), the difference's standard deviation, and where its image shows
    the touch.
    """

    scan: int
    d: NDArray[np.float64]
    sigma: NDArray[np.float64]
    seen: Shape


class Refinement:
    """Of one skin."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle, fits: RefineProcess | RefineHere | None = None) -> None:
        """Raises BundleError where the bundle's tables cannot be read."""
        assert skin.indenter is not None
        self.name, self.bundle = name, bundle
        bundle.response()
        self._fits = fits
        self._folder = str(bundle.path.resolve())
        self._kinds = KINDS if skin.indenter.kind == "any" else (skin.indenter.kind,)
        radius = skin.indenter.radius_m
        self._radius = None if radius is None else radius / bundle.metres_per_unit
        self._number, self._single, self._tare = 0, 0.0, skin.tare.frames
        self._counted = {"fits": 0, "refined": 0, "unexplained": 0, "took_ms": 0}  # took_ms: of the newest fit
        self.forget()

    @property
    def counters(self) -> dict[str, int]:
        skipped = 0 if self._fits is None else self._fits.skipped.get(self.name, 0)
        return {f"refine_{name}": n for name, n in (self._counted | {"skipped": skipped}).items()}

    @property
    def problem(self) -> str:
        return "" if self._fits is None else self._fits.problem

    def warm_up(self) -> None:
        """Start the process now: the first touch would wait for it."""
        self._fits = self._fits or shared()
        self._fits.start()

    def fit_by(self, fits: RefineProcess | RefineHere) -> None:
        self._fits = fits

    def fit_here(self) -> None:
        """From now on each frame waits for its fit: offline."""
        if not isinstance(self._fits, RefineHere):
            self._fits = RefineHere()

    def forget(self) -> None:
        """Nothing touches, or nothing is known of what does."""
        self._asked: dict[int, _Asked] = {}  # by number
        self._answer: tuple[_Asked, TouchPosterior, NDArray[np.bool_]] | None = None
        self._now: _Asked | None = None  # frame last reconstructed
        self._touch: RefinedTouch | None = None

    def __call__(self, frame: DeltaFrame, out: ImageFrame, drift: float) -> RefinedTouch | None:
        """The refined touch of this frame, or None. out: the image made of it, or of what it holds; drift: what may
        have changed since the last untouched frame, rms of the difference.
        """
        news = self._take_answer()
        if not frame.touched or not out.valid or "changing" in out.reasons:
            self.forget()
            return None
        if frame.averaged:
            if (start := start_of(out.image)) is None:
                self.forget()
                return None
            now = _Asked(frame.scan, frame.difference.astype(float), frame.sigma.astype(float), start)
            self._single = max(self._single, _typical(now.sigma)) if self._now else _typical(now.sigma)
            self._now = now
            moved = self._moved()
            self._ask(now, drift, self._slid() if moved is None else likely(moved))
            if self._take_answer():  # where a frame waits for its fit
                moved = self._moved()
            self._touch = self._told(moved)
        elif news:
            self._touch = self._told(self._moved())
        self._counted["refined"] += self._touch is not None
        return self._touch

    def _ask(self, now: _Asked, drift: float, before: dict[str, Any]) -> None:
        """A frame that is reconstructed is to be fitted."""
        self._number += 1
        self._asked[self._number] = now
        self._asked.pop(self._number - MOST_ASKED, None)
        self._fits = self._fits or shared()
        self._fits.offer(
            RefineJob(
                skin=self.name,
                number=self._number,
                bundle=self._folder,
                d=now.d,
                sigma=now.sigma,
                start=now.seen,
                kinds=self._kinds,
                radius=self._radius,
                tare_frames=self._tare / max(1.0, (self._single / max(_typical(now.sigma), 1e-12)) ** 2),
                drift=drift if drift > QUIET_DRIFT else 0.0,
                before=before,
            )
        )

    def _take_answer(self) -> bool:
        """Whether there is news of the touch."""
        answer = None if self._fits is None else self._fits.poll(self.name)
        if answer is None or answer.number not in self._asked:  # of a touch that is gone
            return False
        asked = self._asked[answer.number]
        self._asked = {number: each for number, each in self._asked.items() if number > answer.number}
        self._counted["fits"] += 1
        self._counted["took_ms"] = round(1e3 * answer.took_s)
        if answer.problem:
            log.warning("%s: %s", self.name, answer.problem)
        found = answer.posterior
        if found is None or not found.fits_frame:
            self._counted["unexplained"] += 1
            self._answer = None
        else:
            self._answer = asked, found, answer.live
        return True

    def _moved(self) -> TouchPosterior | None:
        """The answer, moved along to the frame that was reconstructed last."""
        if self._answer is None or self._now is None:
            return None
        before, found, live = self._answer
        now = self._now
        if now.scan == before.scan:
            return found
        if not np.array_equal(np.isfinite(now.sigma), live):
            return None
        noise = np.sqrt(now.sigma[live] ** 2 + before.sigma[live] ** 2 + self.bundle.matrices.model_error**2)
        return found.followed((now.d - before.d)[live], noise)

    def _slid(self) -> dict[str, Any]:
        """Where a fit begins if the answer cannot be followed: as far on as the image has moved, if that is no further
        than the touch's radius. Else it may be another touch, of another kind.
        """
        if self._answer is None or self._now is None:
            return {}
        before, found, _ = self._answer
        step = self._now.seen.centroid - before.seen.centroid
        if not math.hypot(*step) <= before.seen.radius:
            return {}
        return {kind: theta + np.concatenate([step, np.zeros(len(theta) - 2)]) for kind, theta in likely(found).items()}

    def _told(self, found: TouchPosterior | None) -> RefinedTouch | None:
        if found is None or self._answer is None:
            return None
        return told(found, self._answer[0].scan, self.bundle.metres_per_unit)


def told(found: TouchPosterior, scan: int, unit: float) -> RefinedTouch:
    """What a fit to a scan says, in metres; unit: metres per model unit."""
    shape = found.fits[0].shape
    (xx, xy), (_, yy) = found.position_covariance.tolist()
    middle, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return RefinedTouch(
        kind=shape.kind,
        probability=min(1.0, found.probability[shape.kind]),
        probabilities=[min(1.0, float(share)) for share in found.classes],
        position=[float(v) * unit for v in found.position],
        sigma=[
            math.sqrt(middle + spread) * unit,
            math.sqrt(max(middle - spread, 0.0)) * unit,
            0.5 * math.atan2(2 * xy, xx - yy),
        ],
        drop=found.drop[0],
        drop_sigma=found.drop[1],
        integral=found.integral[0] * unit**2,
        integral_sigma=found.integral[1] * unit**2,
        area_m2=found.area[0] * unit**2,
        area_sigma_m2=found.area[1] * unit**2,
        centre=[shape.x * unit, shape.y * unit],
        radius_m=shape.radius * unit,
        rotation=shape.rotation,
        aspect=shape.aspect,
        scan=scan,
        between_kinds=list(found.between_kinds),
    )


def _typical(sigma: NDArray[np.float64]) -> float:
    """Root mean square of the finite ones."""
    finite = sigma[np.isfinite(sigma)]
    return math.sqrt(float(finite @ finite) / max(len(finite), 1))
