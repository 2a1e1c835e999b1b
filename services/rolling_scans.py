"""Messages of a scan in parts: which of them preprocessing takes for a whole scan, and what it says of the others."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import DeltaFrame, FollowedTouch, Frame, PartFrame, RawFrame, as_sent
from services.estimation.baseline import BaselineEstimator
from services.estimation.part_course import PartPlaces
from services.estimation.part_evidence import PartEvidence
from services.estimation.part_filter import PartFilter
from services.estimation.part_image import COARSE, PartImage, PartTouch
from services.estimation.rolling import WholeScans, parts_of
from services.runtime.stage import add_reason, inherited

Array = NDArray[np.float64]

SUSPECTED = 5.0  # sigmas of the newest part, below which it is not looked at further
WIDER = 1.05  # noise is estimated from a few dozen scans
DRIFT = 3e-5  # relative, since the untouched scans that parts are compared with
LONGEST_PRESS_US = 300_000.0  # after a touch began a whole scan is taken, although its force still grows
SAID_LATELY = 2  # messages, of which one said where the touch is: else nothing would be said until the whole scan
KNOWN = 0.05  # model units of uncertainty, from which on a touch that began is not looked for elsewhere
ANYWHERE = 0.12  # model units of uncertainty, beyond which a place is not said
JUMPS = 3.0  # standard deviations of both places, by which no touch that began is elsewhere a few parts later
REMEMBERED = 8  # untouched whole scans whose mean that is


class PartModels(NamedTuple):
    """What tells a touch from the parts of a scan: made when it is first needed."""

    evidence: PartEvidence
    image: PartImage
    places: PartPlaces
    filter: PartFilter


class RollingScans:
    """Of one skin. A message has the newest value of every measurement, so each could stand for a whole scan; those
    that share no value with the one before do, so that noise, electrodes and drift are judged as in whole scans.

    The other messages say only, and only where the last whole scan was sound, where a touch began, by the values
    measured since (services/estimation/part_evidence.py); or that the touch ended. Then the next whole scan is the
    first of values that are all newer than that. In between they say where a touch that was there is by now
    (services/estimation/part_filter.py), where that explains them.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._bundle, self._parts = bundle, parts_of(bundle)
        self._coarse = 2 * COARSE * bundle.half_width  # model units of uncertainty, beyond which a part says nothing
        self._whole = WholeScans()
        self._made: PartModels | None = None
        self.reset()

    def reset(self) -> None:
        self._whole.last = -1
        self._seen = self._handed_on = -1  # scans of messages
        self._delta_scan = 0  # of the last message that a delta frame was made of; 0: of none
        self._placed_scan = 0  # of the last message that said where a touch is that began
        self._sample_ns = 0  # of the last delta frame
        self.begin_anew()

    def begin_anew(self) -> None:
        """There is another baseline, or none: parts say nothing before an untouched whole scan."""
        self._rest: Array | None = None  # difference of the untouched skin lately
        self._rests = 0  # whole scans that it is the mean of
        self.change: Array | None = None  # to the whole scan's difference, for its values to be of one instant
        self._know_nothing()

    def missed(self) -> None:
        """Something is missing before the next message: that one is taken for a whole scan, and what touches is judged
        by it alone. The untouched skin is what it was.
        """
        self._whole.last = -1
        self._know_nothing()

    def _know_nothing(self) -> None:
        """Of what touches."""
        self._held: Array | None = None  # difference of the touch that the last whole scan saw
        self._sound = False  # the last whole scan
        self._moved = False  # the next whole scan was put off since the last one
        self._ended = False  # the touch of the last whole scan has
        self._began_us: float | None = None  # when a touch began, by the board's clock less the length of a part
        self._began: PartTouch | None = None  # as the newest parts have it
        self._shown: PartTouch | None = None  # as it was said last
        self._one = True  # no other one began since; else a whole scan tells
        self._doubted = False  # a contact that changed may be all that it is: a whole scan tells
        if self._made is not None:
            self._made.filter.forget()

    def warm_up(self) -> None:
        _ = self._models

    @property
    def _models(self) -> PartModels:
        if self._made is None:
            evidence, image = PartEvidence(self._bundle, self._parts), PartImage(self._bundle)
            self._made = PartModels(evidence, image, PartPlaces(image), PartFilter(self._bundle))
        return self._made

    def due(self, frame: RawFrame, stamps: dict[str, int], estimator: BaselineEstimator) -> bool:
        """Whether the message is to be taken for a whole scan; then `sample` in stamps is set to the mean time of its
        values, for which what is made of it stands, and never before what was said last.
        """
        self.change = None
        if frame.parts == 1:
            return True
        self._seen = frame.scan
        if not self._fits(frame):
            return True  # another skin's: said once a message, as of whole scans
        if not self._whole.due(frame.scan, frame.parts):
            return False
        values = self._values(frame, estimator)
        if values is not None and not self._moved and (self._changes(values) or self._models.filter.jumps(*values)):
            self._moved = True  # a touch that began, ended or jumped within them is seen in the next whole scan
            return False
        if not self._doubted and self._grows(frame, values):
            self._whole.last = frame.scan - frame.parts + 1
            return False
        new = frame.new.astype(bool)
        sample = mean = stamps.get("sample", 0)
        if not self._follows(frame, values):
            mean -= round(1e3 * float(frame.age_us.mean() - frame.age_us[new].mean()))
        stamps["sample"] = self._sample_ns = max(mean, min(self._sample_ns, sample))
        self._handed_on = frame.scan
        return True

    @property
    def placed(self) -> tuple[float, float] | None:
        """Where a touch began since the last whole scan [model units] that parts told from any contact's change; None
        where none did, or where it is gone.
        """
        return self._shown.at if self._is_one and self._shown is not None else None

    @property
    def _is_one(self) -> bool:
        """Whether what began is one touch, as far as the newest parts tell."""
        return self._began is not None and self._began.fits and self._one

    def _grows(self, frame: RawFrame, values: tuple[Array, Array, Array] | None) -> bool:
        """Whether the oldest of these values felt a touch that began, and still grew, and parts say where it is."""
        if self._began is None or self._began_us is None or values is None or not self._is_one:
            return False
        if self._placed_scan < frame.scan - SAID_LATELY or frame.device_us - self._began_us > LONGEST_PRESS_US:
            return False
        return float(self._models.places.course(*values, self._began).min()) < 1.0

    def _follows(self, frame: RawFrame, values: tuple[Array, Array, Array] | None) -> bool:
        """Whether the whole scan's touch is followed: then all its values are brought to the newest one's instant."""
        if self._held is None or values is None:
            return False
        followed = self._models.filter
        follows = followed.part(*values, frame.device_us)
        if follows and followed.moves:
            self.change = followed.at_once(*values)
        return follows

    def judged(self, out: DeltaFrame, frame: RawFrame, estimator: BaselineEstimator) -> None:
        """Take what preprocessing said of a whole scan."""
        if frame.parts == 1:
            return
        self._follows_last(out)
        known = len(out.difference) == len(frame.z) and bool(np.isfinite(out.sigma).all())
        well = known and out.valid and not out.electrodes.any() and "gain" not in out.reasons
        self._sound = well and "gap" not in out.reasons
        self._moved = self._ended = self._doubted = False
        touched, self._began_us, self._began, self._held = self._held is not None, None, None, None
        self._shown, self._one = None, True
        if not touched or not self._sound or not out.touched:
            self._models.filter.forget()  # what it followed is over
        if not well:
            self._rest, self._rests = None, 0
        if not self._sound:
            return
        if out.touched:
            self._held = out.difference.astype(float)
            self._take(out, frame, estimator)
        else:
            drifted = touched or self._rest is None
            self._rests = 1 if drifted else min(self._rests + 1, REMEMBERED)
            before = 0.0 if self._rest is None else self._rest
            self._rest = before + (out.difference.astype(float) - before) / self._rests

    def _take(self, out: DeltaFrame, frame: RawFrame, estimator: BaselineEstimator) -> None:
        """Begin to follow the touch of a whole scan, or go on."""
        if (values := self._values(frame, estimator)) is None:
            self._models.filter.forget()
            return
        d = values[0] if self.change is None else values[0] + self.change
        self._models.filter.whole(d, values[1], frame.device_us, shown=not out.held)
        out.followed = self._followed()

    def _followed(self) -> list[FollowedTouch]:
        followed = self._models.filter
        metres, number = followed.metres_per_unit, followed.number
        return [
            FollowedTouch(
                number=number,
                position=[metres * each.x, metres * each.y],
                velocity=[metres * each.vx, metres * each.vy],
                sigma=[metres * each.sigma[0], metres * each.sigma[1], each.sigma[2]],
                integral=metres**2 * each.integral,
            )
            for each in followed.states()
        ]

    def part(self, out: DeltaFrame, frame: RawFrame, estimator: BaselineEstimator) -> list[Frame]:
        """What is said of a message that is no whole scan, if anything: a delta frame where a touch ended, a part frame
        of one that began or goes on.
        """
        followed = self._models.filter
        if (values := self._values(frame, estimator)) is None:
            return []
        if not self._changes(values):
            return self._goes_on(out, frame, values)
        d, noise, age = values
        if self._held is not None:
            followed.forget()
            self._ended = True
            self._put_off(frame.scan)
            out.difference, out.sigma = np.zeros(len(d), np.float32), noise.astype(np.float32)
            return self._said(out)
        return self._begins(out, frame, values)

    def _begins(self, out: DeltaFrame, frame: RawFrame, values: tuple[Array, Array, Array]) -> list[Frame]:
        """Where a touch is that began, where that is known."""
        models, (d, noise, age) = self._models, values
        evidence, places = models.evidence, models.places
        if self._began is not None and self._began.fits and self._began.sigma[0] <= KNOWN:
            place = places.again(d, noise, age, self._began)
            sigmas = evidence.goes_on(d, noise, place.course, places.response(place.touch))
        else:
            since = None if self._began_us is None else frame.device_us - self._began_us
            since = None if since is None or since < 0 else since  # another board's clock
            if (onset := evidence.began(d, noise, age, since)) is None:
                self._began = None
                return []
            place, sigmas = places(d, noise, age, onset.starts), onset.sigmas
        if sigmas is None:
            self._began = None
            return []
        self._put_off(frame.scan)
        on = place.course > 0
        self._began_us, self._began = frame.device_us - float(age[on].max()), place.touch
        self._one = self._one and not self._jumped(self._began)
        if not self._is_one or self._began.sigma[0] > ANYWHERE:
            return []
        self._doubted = not evidence.no_contact(d, noise, age, place)
        if self._doubted:
            return []
        self._shown, self._placed_scan = self._began, frame.scan
        if self._began.sigma[0] > self._coarse:
            add_reason(out.reasons, "coarse")
        return self._said(PartFrame(**inherited(out), after=self._delta_scan, began=models.image.begun(self._began)))

    def _jumped(self, touch: PartTouch) -> bool:
        """Whether it is not where it was said to be: then another one began while this one was being placed."""
        if self._shown is None:
            return False
        away = np.hypot(touch.at[0] - self._shown.at[0], touch.at[1] - self._shown.at[1])
        return bool(away > JUMPS * np.hypot(touch.sigma[0], self._shown.sigma[0]))

    def _goes_on(self, out: DeltaFrame, frame: RawFrame, values: tuple[Array, Array, Array]) -> list[Frame]:
        """Where a touch that goes on is by now, where that is known."""
        followed = self._models.filter
        if self._held is None or self._ended or not followed.knows or not followed.part(*values, frame.device_us):
            return []
        if max((state.sigma[0] for state in followed.states()), default=0.0) > self._coarse:
            return []
        return self._said(PartFrame(**inherited(out), after=self._delta_scan, followed=self._followed()))

    def _values(self, frame: RawFrame, estimator: BaselineEstimator) -> tuple[Array, Array, Array] | None:
        """(K,) each: difference to the untouched skin lately, its standard deviation, age [us]; None where the last
        whole scan was not sound, or this message is not.
        """
        baseline = estimator.baseline
        sound = self._sound and as_sent(frame)[0] and not frame.status.any() and set(frame.reasons) <= {"replay"}
        if not (sound and self._models.evidence.knows) or baseline is None or baseline.doubt or self._rest is None:
            return None
        d = (np.abs(frame.z.astype(np.complex128)) - baseline.z0) / estimator.normaliser - self._rest
        noise = WIDER * np.hypot(estimator.sigma * np.sqrt(1 + 1 / self._rests), DRIFT)
        return (d, noise, frame.age_us.astype(float)) if np.isfinite(d).all() and np.isfinite(noise).all() else None

    def _changes(self, values: tuple[Array, Array, Array]) -> bool:
        """Whether a touch began, by all that a quick look tells, or the one that there was has ended."""
        evidence, (d, noise, age) = self._models.evidence, values
        if self._held is None or self._rest is None:
            return self._began_us is not None or evidence.sigmas(d, noise, age) >= SUSPECTED
        followed = self._models.filter
        held = followed.strongest() if followed.moves else self._held - self._rest
        return not self._ended and evidence.ended(d, held, noise, age)

    def _said(self, out: Frame) -> list[Frame]:
        self._handed_on = out.scan
        if isinstance(out, DeltaFrame):
            self._follows_last(out)
        self._sample_ns = out.stamps.get("sample", 0)
        return [out]

    def _follows_last(self, out: DeltaFrame) -> None:
        """Say which delta frame came before: a reader that skipped that one then knows."""
        out.after, self._delta_scan = self._delta_scan, out.scan

    def _put_off(self, scan: int) -> None:
        """The next whole scan is of values newer than this message's: once between two whole scans."""
        if not self._moved:
            self._moved, self._whole.last = True, scan

    def handed_on(self, scan: int) -> dict[str, bool]:
        """Whether the message `scan` was seen, and whether a frame was made of it: a replay asks."""
        return {"seen": self._seen == scan, "handed_on": self._handed_on == scan}

    def _fits(self, frame: RawFrame) -> bool:
        count = len(frame.z)
        return frame.parts == self._parts and len(frame.age_us) == len(frame.new) == count and bool(frame.new.any())

    def state(self) -> dict[str, Any]:
        return {
            "whole": self._whole.last,
            "sample_ns": self._sample_ns,
            "flags": [self._sound, self._moved, self._ended],
            "rest": self._rest,
            "rests": self._rests,
            "held": self._held,
            "began_us": self._began_us,
            "doubted": self._doubted,
            "delta": self._delta_scan,
            "placed": self._placed_scan,
            "began": None if self._began is None else asdict(self._began),
            "shown": None if self._shown is None else asdict(self._shown),
            "one": self._one,
            "filter": None if self._made is None else self._made.filter.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings have none."""
        self.reset()
        if not state:
            return
        self._whole.last, self._sample_ns = int(state["whole"]), int(state["sample_ns"])
        self._sound, self._moved, self._ended = (bool(each) for each in state["flags"])
        self._rest, self._held = (None if state[n] is None else np.array(state[n], float) for n in ("rest", "held"))
        self._doubted = bool(state.get("doubted", False))
        self._began_us, self._rests = state["began_us"], int(state["rests"])
        self._delta_scan, self._placed_scan = int(state.get("delta", 0)), int(state.get("placed", 0))
        self._began, self._shown = _touch(state.get("began")), _touch(state.get("shown"))
        self._one = bool(state.get("one", True))
        if state.get("filter"):
            self._models.filter.load(state["filter"])


def _touch(kept: dict[str, Any] | None) -> PartTouch | None:
    if kept is None:
        return None
    return PartTouch(**{"densest": 1.0, **kept, "at": tuple(kept["at"]), "sigma": tuple(kept["sigma"])})
