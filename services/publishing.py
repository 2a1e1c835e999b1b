"""Publishing: from the image to contacts, their forces and shapes, in the skin's frame [m, N]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from models.bundle import Bundle
from protocol.frames import (
    SHAPES,
    BegunTouch,
    Contact,
    ContactFrame,
    ForceFrame,
    Frame,
    ImageFrame,
    LocatedTouch,
    PartFrame,
    RefinedTouch,
    ShapeFrame,
)
from protocol.held import ANY, HeldImage
from services.contacts.after_gap import AfterGap
from services.contacts.begun import begun, possible, without_image
from services.contacts.contact_writer import ContactWriter, confidence
from services.contacts.following import Following
from services.contacts.force import ForceLaw
from services.contacts.invalid_spell import InvalidSpell
from services.contacts.last_image import LastImage
from services.contacts.lasting import LastingStates
from services.contacts.motion import Patch, Track
from services.contacts.outline import outline
from services.contacts.placing import placement
from services.contacts.refined import area_of_image, both, refined_outline
from services.contacts.registered import measures_force, patches
from services.contacts.segmentation import Segment, class_probabilities, readable, segment
from services.contacts.tracking import Tracker
from services.describe import geometry
from services.estimation.quality import NEARLY, SURE
from services.estimation.rolling import parts_of
from services.estimation.within_scan import CHANGING_FRAMES
from services.runtime.config import Skin
from services.runtime.stage import HARMLESS, SEPARATE, Health, Stage, add_reason, inherited

EXPLAINED = 0.6  # quality from which an image counts although its peak is beyond the sheet or the law
LARGEST_M = 100.0  # beyond it a number is no place on a skin


class Publishing(Stage):
    """image -> contact, and force and shape where somebody wants them. Of scans in parts, contact and force also of the
    part frames between two images.
    """

    reads = "image"
    writes = ("contact", "force", "shape")
    stamp = "publish"
    sleeps = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config = skin
        self.law = ForceLaw.of(skin, bundle, name)
        place, self.frame_id = placement(skin, geometry(bundle)["outline"], name)
        by_registration = measures_force(bundle)
        self._tells_force = self.law.exists or by_registration
        self._writer = ContactWriter(self.law, place, self._tells_force)
        self._image_size = bundle.image_size
        self._grid = (bundle.metres_per_pixel, list(bundle.image_origin))
        self._calibrated = self.law.calibrated or (by_registration and not self.law.exists)
        self.tracker, self.after_gap = Tracker(), AfterGap(parts_of(bundle))
        self.following, self.lasting, self.last_image = Following(), LastingStates(), LastImage(name)
        self.each_alone = False  # offline: frames that do not follow each other
        self.reset()

    def reset(self) -> None:
        self.tracker.reset()
        self.held = HeldImage()
        self.last_image.forget()
        self.after_gap.forget()
        self._forget()
        self._counters = {"frames": 0, "contacts": 0, "unknown": 0, "refined": 0, "disagreed": 0}
        self._invalid = InvalidSpell()

    def new_session(self) -> None:
        self.tracker = Tracker()
        self._forget()

    def wake(self) -> None:
        self.tracker.forget()
        self.last_image.forget()
        self.after_gap.forget()
        self._forget()

    def _forget(self) -> None:
        """Nothing is known of what touches."""
        self._known = self._touched = self._from_parts = False  # _from_parts: no image showed the contacts yet
        self.following.forget()
        self.lasting.forget()
        self._changing = 0  # frames in a row that said so
        self._replaced = False  # nothing is shown since a touch was whose place another one may have taken
        self._seen_in = (ANY, -1)  # session and scan of the image that the contacts were seen in
        self._contacts: list[Contact] = []  # of the frame made last, strongest first; those that ended come last
        self._segments: list[Segment] = []  # of the contacts that did not end, in their order
        self._classes: list[list[float]] = []
        self._geometry = (0.0, [0.0, 0.0])  # metres per pixel, origin of the segments' image

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, PartFrame | ImageFrame)
        if not self.last_image.precedes(frame):
            self.after_gap.missed()
        if isinstance(frame, PartFrame) and frame.began is None:
            return self._say(self.last_image.held_by(frame), wanted, whole=False)
        if isinstance(frame, PartFrame):
            alone = without_image(frame, *self._grid)
            self.last_image.doubts(alone, frame.after)
            return self._say(alone, wanted, whole=False, began=frame.began)
        said, *rest = self._say(frame, wanted)
        assert isinstance(said, ContactFrame)
        self.last_image.take(frame, said)
        return [said, *rest]

    def _say(
        self, frame: ImageFrame, wanted: frozenset[str], whole: bool = True, began: BegunTouch | None = None
    ) -> list[Frame]:
        """The frames that follow from an image. whole: it is of a whole scan; else of a part, which holds the image
        before it, or has none yet of a touch that began.
        """
        self._counters["frames"] += 1
        out = ContactFrame(**inherited(frame), frame_id=self.frame_id, force_calibrated=self._calibrated)
        if not self._tells_force:
            add_reason(out.reasons, "uncalibrated_force")
        self.lacks = whole and not self.held.complete(frame)
        self.after_gap.look(frame)
        had = bool(self._segments)
        if not frame.valid and "out_of_distribution" in frame.reasons:
            self._miss(out, "out_of_distribution")
        elif self.lacks:
            add_reason(out.reasons, "gap")
            self._miss(out, "gap")
        elif frame.held and (self._knows(frame, whole) or self._changes(frame)):
            self._keep(frame)
            out.held = True
        elif self._from_parts and self._tells_nothing(frame):
            self._keep(frame)  # parts had told where the touch is
        elif began is not None and not possible(began, *self._grid, self._image_size):
            self._miss(out, "non_finite")
        elif began is None and not frame.image.size and (frame.touched or not frame.valid):
            self._miss(out, "gap")
        elif not _sound(frame):
            self._miss(out, "non_finite")
        else:
            self._see(frame, began)
            self.following.anchor(self._contacts, frame.followed)
        fitted = self._fitted(frame.refined if out.valid else None)
        out.contacts = list(self._contacts) if fitted is None else [fitted[0], *self._contacts[1:]]
        if out.valid and not whole and began is None and self._leaves_something(frame):
            add_reason(out.reasons, "changing")
        if frame.followed and out.valid:
            self._follow(frame, out)
        if any((c.force_n or 0.0) > self.law.most_n or self.law.saturates(c.pressure_pa) for c in out.contacts):
            add_reason(out.reasons, "extrapolated")
        if frame.touched and frame.residual is not None:
            out.quality = max(0.0, 1.0 - frame.residual)
        # It began or went during the scan, or nothing of it is to be believed yet.
        doubtful = (had or self.tracker.waits) and self._changing < CHANGING_FRAMES
        changed = not self._touched or not (self._segments or (_explained(frame) and not doubtful))
        told = frame.held or (began is not None and bool(self._segments)) or self._alone(frame)
        if out.valid and frame.touched and changed and not told:
            add_reason(out.reasons, "changing")
        # Where a frame in between said that nothing touches, nothing is replaced.
        told_of = self._replaced or (self._touched and (bool(self._contacts) or self.tracker.remembers))
        self._replaced = told_of and self.tracker.replaces and not self._segments
        if out.valid and began is None and self._hides(frame, whole):
            out.valid = False
            add_reason(out.reasons, "changing")
        if whole:
            self._changing = self._changing + 1 if "changing" in out.reasons else 0
        self._touched = frame.touched
        explained = out.quality is not None and out.quality >= EXPLAINED
        if any(self.law.impossible(*each) for each in self._drops()) and not explained:
            out.valid = False
            add_reason(out.reasons, "out_of_distribution")
        if out.valid and not self._alone(frame) and not self.after_gap.judged(frame, whole, self._sure(frame)):
            out.valid = False
            add_reason(out.reasons, "gap")
        self._invalid(out.valid, [r for r in out.reasons if r not in HARMLESS], frame.stamps.get("sample", 0))
        if frame.part and out.valid:
            out.contacts = self.lasting(out.contacts, frame.stamps.get("sample", 0))
        frames: list[Frame] = [out]
        if "force" in wanted:
            frames.append(self._force(out))
        if "shape" in wanted and whole:
            frames.append(self._shape(out, None if fitted is None else fitted[1]))
        return frames

    def _see(self, frame: ImageFrame, began: BegunTouch | None) -> None:
        """Find the contacts of a new image, or of the touch that began."""
        m, (x0, y0), now = frame.metres_per_pixel, frame.origin, frame.stamps.get("sample", 0)
        segments: list[Segment] = []
        located = frame.touches if frame.touched and frame.image.size else []
        if began is not None:
            segments, seen, located = begun(began, m, (x0, y0), self._image_size)
        elif located:
            segments, seen = patches(frame)
        elif frame.touched and frame.image.size:
            places = [] if self._alone(frame) or self.after_gap.waits else self.tracker.expected(now)
            segments = segment(frame.image, frame.sigma, [((x - x0) / m - 0.5, (y - y0) / m - 0.5) for x, y in places])
        if not located:
            seen = [
                Patch(x0 + (s.x + 0.5) * m, y0 + (s.y + 0.5) * m, s.volume * m * m, s.reach * m, confidence(s))
                for s in segments
            ]
        tracks: Sequence[Track | None]
        ended: list[Track] = []
        if self._alone(frame):
            tracks, ended = self.tracker.alone(seen, now)
        else:
            well = not any(reason.startswith("electrode") for reason in frame.reasons)
            near = (frame.residual or 0.0) <= NEARLY
            watched = not self.after_gap.waits
            self.after_gap.saw()
            tracks, ended = self.tracker.update(seen, now, _explained(frame), well, near, watched)
        present = []
        said: Sequence[LocatedTouch | None] = located or [None] * len(segments)
        for track, place, s, touch in zip(tracks, seen, segments, said, strict=True):
            if track is not None:
                classes = class_probabilities(s, frame.classes)
                present.append((self._writer.present(track, place, s, classes, frame, touch), s, classes))
        if not located:  # those come strongest first
            present.sort(key=lambda each: (-(each[0].force_n or 0.0), -each[1].peak))
        self._segments, self._classes = [s for _, s, _ in present], [classes for _, _, classes in present]
        self._geometry, self._known, self._from_parts = (m, [x0, y0]), True, began is not None
        self._seen_in = frame.session, frame.reconstructed
        self._contacts = [contact for contact, _, _ in present] + self._writer.ended(ended)
        self._counters["contacts"] += sum(track is not None and track.age == 1 for track in tracks)

    def _fitted(self, touch: RefinedTouch | None) -> tuple[Contact, RefinedTouch] | None:
        """The contact as a fit has it, where there is one contact, and image and fit agree on it."""
        if touch is None or len(self._segments) != 1:
            return None
        touch = replace(touch, probabilities=both(touch.probabilities, self._classes[0]))
        contact = self._writer.fitted(self._contacts[0], touch)
        self._counters["disagreed" if contact is None else "refined"] += 1
        return None if contact is None else (contact, touch)

    def _follow(self, frame: ImageFrame, out: ContactFrame) -> None:
        """Bring the contacts to where they are by now."""
        motion = self.following.motion(frame.followed)
        out.contacts = self.following.moved(out.contacts, frame.followed, self._writer.place)
        moves = any(any(touch.velocity) for touch in frame.followed)
        out.held = out.held and not moves
        if moves and any(c.id not in motion for c in out.contacts if c.state != "end"):
            add_reason(out.reasons, "changing")
        if "changing" not in out.reasons:  # else what is followed may be on its way to another touch
            self.tracker.carry(motion, frame.stamps.get("sample", 0))

    def _sure(self, frame: ImageFrame) -> bool:
        """Whether contacts are shown of an image that is sure by itself, or like the scan after it or the image before
        it, and nothing waits to be confirmed.
        """
        sure = _explained(frame) or frame.held or self.tracker.steady
        return sure and bool(self._segments) and not self.tracker.waits

    def _leaves_something(self, part: ImageFrame) -> bool:
        """Whether the image that a part holds is not all that there was: one of a touch that changed, of which a good
        deal is unexplained, or beside whose touches another one waits for a second image.
        """
        return self._changing > 0 or self.tracker.waits or (part.residual or 0.0) > NEARLY

    def _hides(self, frame: ImageFrame, whole: bool) -> bool:
        """Whether nothing is shown although something has touched for longer than a frame: what took the place of a
        touch that was shown and waits for a second image, or what an image did not show whose touches a part follows.
        """
        goes_on = frame.touched and not self._segments and not self._alone(frame)
        return goes_on and (self._replaced or not whole)

    def _alone(self, frame: ImageFrame) -> bool:
        """Whether this frame follows no other."""
        return self.each_alone or SEPARATE in frame.reasons

    def _knows(self, frame: ImageFrame, whole: bool) -> bool:
        """Whether our contacts are those of this held image. They are not if frames in between were missed, or if a
        touch waits for its second frame, which a part is not: it shows no touch that the image before did not.
        """
        recent = not self.tracker.forgotten(frame.stamps.get("sample", 0))
        session, scan = self._seen_in
        theirs = session in (ANY, frame.session) and scan == frame.reconstructed > 0  # 0: nobody says
        return self._known and recent and theirs and not (whole and self.tracker.waits)

    def _changes(self, frame: ImageFrame) -> bool:
        """Whether this frame shows nothing new because its touch changed meanwhile: our contacts are all there is."""
        forgotten = self.tracker.forgotten(frame.stamps.get("sample", 0))
        return self._known and not forgotten and "changing" in frame.reasons

    def _tells_nothing(self, frame: ImageFrame) -> bool:
        """Whether this frame's image is empty because its touch changed meanwhile. Not for long: then it is gone."""
        blank = frame.valid and frame.image.size > 0 and not frame.image.any()
        return blank and self._changes(frame) and self._changing < CHANGING_FRAMES

    def _keep(self, frame: ImageFrame) -> None:
        """The same contacts a frame later."""
        ended = self.tracker.still(frame.stamps.get("sample", 0), "changing" in frame.reasons)
        present = [c for c in self._contacts if c.state != "end"]
        held = [replace(c, state="hold", velocity=[0.0, 0.0, 0.0]) for c in present]
        self._contacts = held + self._writer.ended(ended)

    def _miss(self, out: ContactFrame, reason: str) -> None:
        """Make a frame that says nothing about touches, not even that a contact ended."""
        out.valid = False
        if set(out.reasons) <= HARMLESS:
            add_reason(out.reasons, reason)
        self._forget()
        self._counters["unknown"] += 1

    def _drops(self) -> list[tuple[float, float | None]]:
        """(peak drop, force) of each touch."""
        return [(s.peak, c.force_n) for s, c in zip(self._segments, self._contacts, strict=False)]

    def _force(self, frame: ContactFrame) -> ForceFrame:
        """The total force; valid if the contacts are."""
        present = [c for c in frame.contacts if c.state != "end"]
        total = None if not self._tells_force else sum(c.force_n or 0.0 for c in present)
        wrench = np.sum([c.wrench for c in present], axis=0).tolist() if present else [0.0] * 6
        sigmas = [c.force_sigma_n for c in present]
        known = [sigma for sigma in sigmas if sigma is not None]
        return ForceFrame(
            **inherited(frame),
            wrench=wrench,
            force_n=total,
            force_sigma_n=math.hypot(*known) if known and len(known) == len(sigmas) else None,
            refined=any(c.refined for c in present),
        )

    def _shape(self, frame: ContactFrame, fitted: RefinedTouch | None) -> ShapeFrame:
        metres, origin = self._geometry
        present = [c for c in frame.contacts if c.state != "end"]
        outlines = [outline(s.mask, metres, origin) for s in self._segments]
        probabilities = [p or [0.0] * len(SHAPES) for p in self._classes]
        return ShapeFrame(
            **inherited(frame),
            ids=[c.id for c in present],
            outlines=outlines if fitted is None or area_of_image(fitted) else [refined_outline(fitted)],
            orientation=[c.orientation for c in present],
            probabilities=probabilities if fitted is None else [fitted.probabilities],
            refined=fitted is not None,
        )

    def state(self) -> dict[str, Any]:
        return {
            "tracker": self.tracker.state(),
            "following": self.following.state(),
            "lasting": self.lasting.state(),
            "last_image": self.last_image.state(),
            "after_gap": self.after_gap.state(),
            "known": self._known,
            "touched": self._touched,
            "changing": self._changing,
            "reconstructed": self._seen_in[1],
            "from_parts": self._from_parts,
            "replaced": self._replaced,
            "held": None if self.held.last is None else _kept(self.held.last),
            "contacts": [asdict(c) for c in self._contacts],
            "segments": [{**asdict(s), "mask": s.mask.astype(np.uint8)} for s in self._segments],
            "classes": self._classes,
            "geometry": [self._geometry[0], *self._geometry[1]],
        }

    def load(self, state: dict[str, Any]) -> None:
        self.tracker.load(state["tracker"])
        self.following.load(state.get("following", []))  # older recordings have none
        self.lasting.load(state.get("lasting", {}))
        self.last_image.load(state.get("last_image"))
        self.after_gap.load(state.get("after_gap"))
        self._known, self._touched = bool(state["known"]), bool(state.get("touched", False))
        self._changing, self._from_parts = int(state.get("changing", 0)), bool(state.get("from_parts", False))
        self._replaced = bool(state.get("replaced", False))
        self._seen_in = (ANY, int(state.get("reconstructed", -1)))  # older recordings have none
        kept = state.get("held")
        self.held.last = None if kept is None else _image_of(self.skin, kept)
        self._contacts = [Contact(**c) for c in state["contacts"]]
        self._segments = [Segment(**{**s, "mask": np.array(s["mask"], dtype=bool)}) for s in state["segments"]]
        self._classes = [list(p) for p in state["classes"]]
        metres_per_pixel, *origin = state["geometry"]
        self._geometry = (metres_per_pixel, origin)

    def health(self) -> Health:
        problem = self._invalid.problem
        return Health("WARN" if problem else "OK", [problem] if problem else [], dict(self._counters))


def _sound(frame: ImageFrame) -> bool:
    """Whether image and geometry are numbers that can be those of a skin."""
    places = np.abs([frame.metres_per_pixel, *frame.origin])
    return readable(frame.image) and frame.metres_per_pixel > 0 and bool((places < LARGEST_M).all())


def _kept(frame: ImageFrame) -> dict[str, Any]:
    return {
        "scan": frame.reconstructed,
        **{name: np.array(getattr(frame, name), np.float32) for name in ("image", "sigma", "classes")},
        "touches": [asdict(each) for each in frame.touches],
    }


def _image_of(skin: str, kept: dict[str, Any]) -> ImageFrame:
    image, sigma, classes = (np.asarray(kept[name], np.float32) for name in ("image", "sigma", "classes"))
    touches = [LocatedTouch(**each) for each in kept.get("touches", [])]
    scan = int(kept["scan"])
    return ImageFrame(
        skin=skin, session=ANY, reconstructed=scan, image=image, sigma=sigma, classes=classes, touches=touches
    )


def _explained(frame: ImageFrame) -> bool:
    """Whether the image explains what was measured as one that held still does."""
    return (frame.residual or 0.0) <= SURE
