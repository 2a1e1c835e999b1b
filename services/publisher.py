"""Publishing: from the touches that preprocessing found to contacts, forces and shapes, in the skin's frame [m, N].

Where, how hard, since when: the measurements say (`estimates`). What it looks like: the image. Of a skin whose
measurements do not tell its touches the image says all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from models.bundle import Bundle
from models.locator_arrays import QUANTITIES
from models.measurement.tables import tells_touches
from protocol.frames import (
    SHAPES,
    Contact,
    ContactFrame,
    EstimatedTouch,
    ForceFrame,
    Frame,
    ImageFrame,
    PartFrame,
    ShapeFrame,
)
from protocol.held import HeldImage
from services.contacts.contact_writer import ContactWriter
from services.contacts.force.law import ForceLaw
from services.contacts.images.of_image import ImageTouches
from services.contacts.invalid_spell import InvalidSpell
from services.contacts.lasting import LastingStates
from services.contacts.reading import Appearance, Appearances
from services.contacts.surface import placement
from services.describe import geometry
from services.runtime.config import Skin
from services.runtime.stage import HARMLESS, SEPARATE, Health, Stage, add_reason, inherited, invalidate

COARSE = 0.05  # of the sheet's side: a place that is less sure than that is coarse
SAME_BIRTH_NS = 50_000_000  # a touch is the same where it has the same number and was born at the same time
BEYOND = 1.2  # times half the longer side of a skin, beyond which nothing touches it
MOST_M = 10.0  # of a sheet, and of a sigma of a place on it
MOST_STRENGTH = MOST_M**2
UNWATCHED_NS = 1_000_000_000  # without a frame: what began meanwhile may have been there for long
SHOWS_NOTHING = {"out_of_distribution", "non_finite"}  # reasons with which a frame shows no contact, not even an end


class Publishing(Stage):
    """image -> contact, and force and shape where somebody wants them. Of scans in parts, contact and force also of the
    part frames between two images.
    """

    reads = "image"
    writes = ("contact", "force", "shape")
    stamp = "publish"
    sleeps = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle, law: ForceLaw | None = None) -> None:
        """law: another one than the skin's."""
        super().__init__(name)
        self.config = skin
        self.law = law or ForceLaw.of(skin, bundle, name)
        # a registered skin may measure forces by itself: where it was pressed with known ones
        by_registration = bundle.locator is not None and QUANTITIES[int(bundle.locator.quantity)] == "force_n"
        self._tells_force = self.law.exists or by_registration
        self._calibrated = self.law.calibrated or (by_registration and not self.law.exists)
        self._image_touches = None if tells_touches(bundle) else ImageTouches(bundle)
        place, self.frame_id = placement(skin, geometry(bundle)["outline"], name)
        self._writer = ContactWriter(self.law, place, self._tells_force)
        self._appearances = Appearances(bundle)
        self._coarse_m = 2 * COARSE * bundle.half_width * bundle.metres_per_unit
        self._reach_m = BEYOND * bundle.metres_per_unit
        self._next_id = 1
        self.lasting = LastingStates()
        self.each_alone = False  # offline: frames that do not follow each other
        self._ids: dict[int, tuple[int, int]] = {}  # of preprocessing's touch: our number, and when it was born [ns]
        self._unsent: list[Contact] = []  # touches whose end no frame has had
        self._shown: list[Contact] = []
        self.reset()

    def reset(self) -> None:
        self.held = HeldImage()
        self._end_all()
        self._forget()
        self._counters = {"frames": 0, "contacts": 0, "unknown": 0}
        self._invalid = InvalidSpell()

    def new_session(self) -> None:
        self._next_id, self._ids = 1, {}
        self.wake()

    def wake(self) -> None:
        """Nobody is left who saw what touched."""
        self._shown, self._unsent = [], []
        self._forget()

    def _forget(self) -> None:
        self._appearances.forget()
        self.lasting.forget()
        self._image_of = ("", -1)  # session and scan of the image that appearances were seen in
        self._appearance_of: dict[int, Appearance] = {}  # of the contacts that are there, by their numbers
        self._drops: dict[int, float] = {}  # S/m, at least
        self._anchors: dict[int, EstimatedTouch] = {}  # of contacts of an image, as the measurements tell them
        self._watched = False  # whether the frame before could show what touched
        self._watched_ns: tuple[int, int] | None = None  # `sample` of the first and last frame of those that came

    @property
    def _present(self) -> list[Contact]:
        return [c for c in self._shown if c.state != "end"]

    def _end_all(self) -> None:
        """What was shown ends with the next frame."""
        self._unsent += self._present
        self._shown, self._ids = [], {}

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, PartFrame | ImageFrame)
        self._counters["frames"] += 1
        out = ContactFrame(**inherited(frame), frame_id=self.frame_id, force_calibrated=self._calibrated)
        if not self._tells_force:
            add_reason(out.reasons, "uncalibrated_force")
        now_ns = frame.stamps.get("sample", 0)
        if not all(_readable(touch, self._reach_m) for touch in frame.estimates):
            invalidate(out, "non_finite")
        elif isinstance(frame, ImageFrame):
            self._see(frame, out)
        self._watch(now_ns)
        if out.valid or not SHOWS_NOTHING & set(out.reasons):
            out.contacts = self._contacts(frame, out)
            self._judge(out)
        else:
            self._watched = False
            self._counters["unknown"] += 1
        self._invalid(out.valid, [r for r in out.reasons if r not in HARMLESS], now_ns)
        if frame.part and out.valid:
            out.contacts = self.lasting(out.contacts, now_ns)
        self._last = out, isinstance(frame, ImageFrame)
        return [out]

    def beside(self, wanted: frozenset[str]) -> list[Frame]:
        (contacts, whole), frames = self._last, list[Frame]()
        if "force" in wanted:
            frames.append(self._force(contacts))
        if "shape" in wanted and whole:
            frames.append(self._shape(contacts))
        return frames

    def _watch(self, now_ns: int) -> None:
        """Since when frames have come without a pause."""
        first_ns, last_ns = self._watched_ns or (now_ns, now_ns)
        if not 0 <= now_ns - last_ns < UNWATCHED_NS:
            first_ns = now_ns
        self._watched_ns = first_ns, now_ns

    def _see(self, frame: ImageFrame, out: ContactFrame) -> None:
        """Take what the image shows."""
        out.held = frame.held
        self.lacks = not self.held.complete(frame)
        if self.lacks and self._image_touches is not None:
            invalidate(out, "gap")
        if frame.image.size and not np.isfinite(frame.image).all():
            invalidate(out, "non_finite")
            return
        if frame.touched and frame.residual is not None:
            out.quality = max(0.0, 1.0 - frame.residual)
        image = frame.session, frame.reconstructed
        if not frame.touched:
            self._appearances.forget()
            self._image_of = ("", -1)
        elif frame.image.size and image != self._image_of and self._image_touches is None:
            self._appearances.see(frame)
            self._image_of = image

    def _contacts(self, frame: ImageFrame | PartFrame, out: ContactFrame) -> list[Contact]:
        """Those that are there, strongest first, then those that ended."""
        alone = self.each_alone or SEPARATE in frame.reasons
        if alone:
            self._end_all()
        before = {c.id: c for c in self._present}
        pictured = self._image_touches is not None and isinstance(frame, ImageFrame) and frame.touched
        found = self._found(frame, before, alone)
        if pictured and out.valid and not found:
            invalidate(out, "out_of_distribution")
        here = {contact.id for contact in found}
        gone = [c for c in (*self._unsent, *before.values()) if c.id not in here]
        self._watched = out.valid
        if not out.valid:
            return found
        if pictured and isinstance(frame, ImageFrame):
            self._image_of = frame.session, frame.reconstructed
        self._counters["contacts"] += sum(contact.id not in before for contact in found)
        self._unsent, self._shown = [], [*found, *self._writer.gone(gone)]
        self._ids = {touch: known for touch, known in self._ids.items() if known[0] in here}
        return list(self._shown)

    def _found(self, frame: ImageFrame | PartFrame, before: Mapping[int, Contact], alone: bool) -> list[Contact]:
        """As the measurements tell them, or as the image shows them, or as they were where it is the one of before.
        alone: what touches in this frame began with it.
        """
        if self._image_touches is None:
            self._appearance_of, self._drops = {}, {}
            found = [self._contact(touch, frame, before, alone) for touch in frame.estimates]
            return sorted(found, key=lambda contact: -(contact.force_n or 0.0))
        if isinstance(frame, ImageFrame) and not frame.touched:
            return []
        if isinstance(frame, PartFrame) or (frame.session, frame.reconstructed) == self._image_of:
            return self._moved(frame, before)
        return self._of_image(frame, self._image_touches, before, alone)

    def _of_image(
        self, frame: ImageFrame, image_touches: ImageTouches, before: Mapping[int, Contact], alone: bool
    ) -> list[Contact]:
        """What a new image shows."""
        known = {number: self._appearance_of[number] for number in before}  # they stay where this frame is not valid
        touches = image_touches.found(frame, known)
        numbers = image_touches.same(touches, known)
        self._appearance_of, self._anchors = known, {}
        self._drops = {number: self._drops[number] for number in known}
        found = []
        for touch, same in zip(touches, numbers, strict=True):
            number = same or self._next_id
            self._next_id = max(self._next_id, number + 1)
            state = "hold" if same or not (self._watched or alone) else "begin"
            self._appearance_of[number], self._drops[number] = touch.appearance, touch.segment.peak
            if (moves := image_touches.estimated(touch.appearance, frame.estimates)) is not None:
                self._anchors[number] = moves
            found.append(self._writer.of_image(number, state, touch, frame, moves))
        return found

    def _moved(self, frame: ImageFrame | PartFrame, before: Mapping[int, Contact]) -> list[Contact]:
        """Those of the image of before, where the measurements say that they are by now, and what has begun since."""
        now = {touch.id: touch for touch in frame.estimates}
        found, followed = list[Contact](), set[int]()
        for number, contact in before.items():
            anchor, held = self._anchors.get(number), replace(contact, state="hold")
            if anchor is None:
                found.append(held)
            elif anchor.id in now:
                followed.add(anchor.id)
                if any(now[anchor.id].velocity):  # else what differs is noise
                    held, self._anchors[number] = self._writer.moved(held, anchor, now[anchor.id]), now[anchor.id]
                found.append(held)
            elif isinstance(frame, ImageFrame):
                found.append(held)  # something touches, and nothing else is known
        begun = [touch for touch in frame.estimates if touch.id not in followed] if isinstance(frame, PartFrame) else []
        for touch in begun:
            found.append(self._contact(touch, frame, before, alone=False))
            self._anchors[found[-1].id] = touch
        return found

    def _contact(self, touch: EstimatedTouch, frame: Frame, before: Mapping[int, Contact], alone: bool) -> Contact:
        born_ns = frame.stamps.get("sample", 0) - round(1e9 * touch.age_s)
        number, then_ns = self._ids.get(touch.id, (0, 0))
        if not number or abs(born_ns - then_ns) > SAME_BIRTH_NS:  # a preprocessing that began anew counts from 1
            number = self._next_id
            self._next_id += 1
        self._ids[touch.id] = number, born_ns
        watched = self._watched_ns is not None and born_ns > self._watched_ns[0]
        state = "begin" if (touch.began and watched or alone) and number not in before else "hold"
        appearance = self._appearance_of[number] = self._appearances.of(touch)
        self._drops[number] = touch.drop - 3 * touch.drop_sigma
        return self._writer.of_estimate(number, state, touch, appearance)

    def _judge(self, out: ContactFrame) -> None:
        """What to know of these contacts."""
        if any((c.force_n or 0.0) > self.law.most_n or self.law.saturates(c.pressure_pa) for c in out.contacts):
            add_reason(out.reasons, "extrapolated")
        sigmas = [c.position_sigma[0] for c in out.contacts if c.position_sigma is not None]
        if any(sigma > self._coarse_m for sigma in sigmas):
            add_reason(out.reasons, "coarse")
        if any(c.id in self._drops and self.law.impossible(self._drops[c.id], c.force_n) for c in out.contacts):
            invalidate(out, "out_of_distribution")

    def _force(self, frame: ContactFrame) -> ForceFrame:
        """The total force; valid if the contacts are."""
        present = [c for c in frame.contacts if c.state != "end"]
        total = None if not self._tells_force else sum(c.force_n or 0.0 for c in present)
        wrench = np.sum([c.wrench for c in present], axis=0).tolist() if present else [0.0] * 6
        sigmas = [c.force_sigma_n for c in present if c.force_sigma_n is not None]
        sigma = math.hypot(*sigmas) if sigmas and len(sigmas) == len(present) else None
        return ForceFrame(**inherited(frame), wrench=wrench, force_n=total, force_sigma_n=sigma)

    def _shape(self, out: ContactFrame) -> ShapeFrame:
        present = [c for c in out.contacts if c.state != "end"]
        appearances = [self._appearance_of[c.id] for c in present]
        return ShapeFrame(
            **inherited(out),
            ids=[c.id for c in present],
            outlines=[each.outline for each in appearances],
            orientation=[c.orientation for c in present],
            probabilities=[each.classes or [0.0] * len(SHAPES) for each in appearances],
        )

    def state(self) -> dict[str, Any]:
        return {
            "next_id": self._next_id,
            "ids": [[touch, *known] for touch, known in self._ids.items()],
            "shown": [asdict(c) for c in self._shown],
            "untold": [asdict(c) for c in self._unsent],
            "watched_ns": list(self._watched_ns or ()),
            "lasting": self.lasting.state(),
            "looks": [[touch, asdict(each)] for touch, each in self._appearances.known.items()],
            "seen": [[number, self._drops[number], asdict(each)] for number, each in self._appearance_of.items()],
            "image_of": list(self._image_of),
            "anchors": [[number, asdict(touch)] for number, touch in self._anchors.items()],
        }

    def load(self, state: dict[str, Any]) -> None:
        """A state of an earlier version tells nothing that a frame does not tell anew."""
        if "ids" not in state:
            self._end_all()
            return
        if _given(state) == _given(self.state()):  # its own
            more, self._unsent = 0, []
        else:
            more = self._next_id - 1  # numbers of another life: none is given twice
            self._end_all()
        self._next_id = more + int(state["next_id"])
        self._ids = {int(touch): (more + int(number), int(born_ns)) for touch, number, born_ns in state["ids"]}
        self._shown = [_restored(c, more) for c in state["shown"]]
        self._unsent += [_restored(c, more) for c in state["untold"]]
        watched = [int(each) for each in state["watched_ns"]]
        self._watched_ns = (watched[0], watched[1]) if watched else None
        self.lasting.load(state["lasting"])
        self._appearances.known = {int(touch): Appearance(**each) for touch, each in state["looks"]}
        seen = state.get("seen", [])
        self._appearance_of = {more + int(number): Appearance(**each) for number, _, each in seen}
        self._drops = {more + int(number): float(drop) for number, drop, _ in seen}
        self._anchors = {more + int(number): EstimatedTouch(**touch) for number, touch in state.get("anchors", [])}
        session, scan = state.get("image_of", ("", -1))
        self._image_of = str(session), int(scan)

    def health(self) -> Health:
        problem = self._invalid.problem
        return Health("WARN" if problem else "OK", [problem] if problem else [], dict(self._counters))


def _restored(state: Mapping[str, Any], more: int) -> Contact:
    """A contact of a state, its number raised by `more`; what else the state has of it is left out."""
    known = {each.name: state[each.name] for each in fields(Contact) if each.name in state}
    return Contact(**(known | {"id": more + int(state["id"])}))


def _given(state: Mapping[str, Any]) -> list[Any]:
    """The numbers that a state has given, and to what."""
    contacts = [(int(c["id"]), c["state"]) for c in (*state["shown"], *state["untold"])]
    return [int(state["next_id"]), [[int(each) for each in known] for known in state["ids"]], contacts]


def _readable(touch: EstimatedTouch, reach_m: float) -> bool:
    """Whether it is one that a touch may be. reach_m: from the skin's middle along each axis."""
    lengths = [*touch.position, *touch.sigma, touch.radius_m]
    strengths = [touch.strength, touch.strength_sigma]
    rest = [*touch.velocity, touch.age_s, touch.radius_sigma, touch.drop, touch.drop_sigma, touch.z2]
    if not all(map(math.isfinite, [*lengths, *strengths, *rest])):
        return False
    if max(map(abs, touch.position)) > reach_m or touch.drop < 0:
        return False
    return touch.radius_m > 0 and max(map(abs, lengths)) < MOST_M and max(strengths) < MOST_STRENGTH


if __name__ == "__main__":
    import sys

    from services.process import main, stages

    sys.exit(main("publisher", stages(Publishing)))
