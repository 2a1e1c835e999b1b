"""Publishing: from the touches that preprocessing found to contacts, forces and shapes, in the skin's frame [m, N].

Where, how hard, since when: the measurements say (`estimates`). What it looks like: the image.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from models.bundle import Bundle
from protocol.frames import (
    SHAPES,
    Contact,
    ContactFrame,
    EstimatedTouch,
    ForceFrame,
    Frame,
    ImageFrame,
    PartFrame,
    RefinedTouch,
    ShapeFrame,
)
from protocol.held import HeldImage
from services.contacts.contact_writer import ContactWriter
from services.contacts.force import ForceLaw
from services.contacts.invalid_spell import InvalidSpell
from services.contacts.lasting import LastingStates
from services.contacts.placing import placement
from services.contacts.reading import Appearance, Appearances
from services.contacts.refined import area_of_image, both, refined_outline
from services.describe import geometry
from services.runtime.config import Skin
from services.runtime.stage import HARMLESS, SEPARATE, Health, Stage, add_reason, inherited

COARSE = 0.05  # of the sheet's side: a place that is less sure than that is coarse
SAME_BIRTH_NS = 50_000_000  # a touch is the same where it has the same number and was born at the same time
SAYS_NOTHING = {"out_of_distribution", "non_finite"}  # reasons with which a frame shows no contact, not even an end


class TouchPublishing(Stage):
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
        self._writer = ContactWriter(self.law, place, self.law.exists)
        self._appearances = Appearances(bundle)
        self._coarse_m = 2 * COARSE * bundle.half_width * bundle.metres_per_unit
        self._next_id = 1
        self.lasting = LastingStates()
        self.each_alone = False  # offline: frames that do not follow each other
        self._ids: dict[int, tuple[int, int]] = {}  # of preprocessing's touch: our number, and when it was born [ns]
        self._untold: list[Contact] = []
        self._shown: list[Contact] = []
        self.reset()

    def reset(self) -> None:
        self.held = HeldImage()
        self._end_all()
        self._forget()
        self._counters = {"frames": 0, "contacts": 0, "unknown": 0, "refined": 0, "disagreed": 0}
        self._invalid = InvalidSpell()

    def new_session(self) -> None:
        self._next_id, self._ids = 1, {}
        self._shown, self._untold = [], []
        self._forget()

    def wake(self) -> None:
        """Nobody is left who was told of what touched."""
        self._shown, self._untold = [], []
        self._forget()

    def _forget(self) -> None:
        self._appearances.forget()
        self.lasting.forget()
        self._image_of = ("", -1)  # session and scan of the image that appearances were seen in
        self._fit: tuple[RefinedTouch, float, float] | None = None  # and where its touch was then

    def _end_all(self) -> None:
        """What was shown ends with the next frame."""
        self._untold += [c for c in self._shown if c.state != "end"]
        self._shown, self._ids = [], {}

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, PartFrame | ImageFrame)
        self._counters["frames"] += 1
        out = ContactFrame(**inherited(frame), frame_id=self.frame_id, force_calibrated=self.law.calibrated)
        if not self.law.exists:
            add_reason(out.reasons, "uncalibrated_force")
        whole = isinstance(frame, ImageFrame)
        if isinstance(frame, ImageFrame):
            self._look(frame, out)
        if out.valid or not SAYS_NOTHING & set(out.reasons):
            out.contacts = self._contacts(frame, out.valid)
            self._note(frame, out)
        else:
            self._counters["unknown"] += 1
        self._invalid(out.valid, [r for r in out.reasons if r not in HARMLESS], frame.stamps.get("sample", 0))
        if frame.part and out.valid:
            out.contacts = self.lasting(out.contacts, frame.stamps.get("sample", 0))
        frames: list[Frame] = [out]
        if "force" in wanted:
            frames.append(self._force(out))
        if "shape" in wanted and whole:
            frames.append(self._shape(out, frame))
        return frames

    def _look(self, frame: ImageFrame, out: ContactFrame) -> None:
        """Take what the image shows."""
        out.held = frame.held
        self.lacks = not self.held.complete(frame)
        if frame.image.size and not np.isfinite(frame.image).all():
            out.valid = False
            add_reason(out.reasons, "non_finite")
            return
        if frame.touched and frame.residual is not None:
            out.quality = max(0.0, 1.0 - frame.residual)
        image = frame.session, frame.reconstructed
        if not frame.touched:
            self._appearances.forget()
            self._image_of = ("", -1)
        elif frame.image.size and image != self._image_of:
            self._appearances.see(frame)
            self._image_of = image
        if frame.refined is None or len(frame.estimates) != 1:
            self._fit = None
        elif self._fit is None or self._fit[0] != frame.refined:  # it is less sure in an image that it was followed to
            x, y = frame.estimates[0].position
            self._fit = frame.refined, x, y

    def _contacts(self, frame: ImageFrame | PartFrame, valid: bool) -> list[Contact]:
        """Those that are there, strongest first, then those that ended."""
        if self.each_alone or SEPARATE in frame.reasons:
            self._end_all()
        before = {c.id: c for c in self._shown if c.state != "end"}
        now_ns = frame.stamps.get("sample", 0)
        found = [self._contact(touch, now_ns, before) for touch in frame.estimates]
        found = self._fitted(found, frame)
        found.sort(key=lambda contact: -(contact.force_n or 0.0))
        here = {contact.id for contact in found}
        gone = [c for c in (*self._untold, *before.values()) if c.id not in here]
        if not valid:
            return found
        self._counters["contacts"] += sum(contact.id not in before for contact in found)
        ended = self._writer.gone(gone)
        self._untold, self._shown = [], [*found, *ended]
        self._ids = {touch: known for touch, known in self._ids.items() if known[0] in here}
        return list(self._shown)

    def _contact(self, touch: EstimatedTouch, now_ns: int, before: dict[int, Contact]) -> Contact:
        born_ns = now_ns - round(1e9 * touch.age_s)
        number, then_ns = self._ids.get(touch.id, (0, 0))
        if not number or abs(born_ns - then_ns) > SAME_BIRTH_NS:  # a preprocessing that began anew counts from 1
            number = self._next_id
            self._next_id += 1
        self._ids[touch.id] = number, born_ns
        state = "begin" if touch.began and number not in before else "hold"
        return self._writer.of_estimate(number, state, touch, self._appearances.of(touch))

    def _fitted(self, contacts: list[Contact], frame: ImageFrame | PartFrame) -> list[Contact]:
        """The only contact as a fit of its shape has it, where both mean the same touch."""
        if self._fit is None or len(contacts) != 1:
            return contacts
        fit, x, y = self._fit
        touch = frame.estimates[0]
        dx, dy = touch.position[0] - x, touch.position[1] - y
        moved = replace(
            fit,
            position=[fit.position[0] + dx, fit.position[1] + dy],
            centre=[fit.centre[0] + dx, fit.centre[1] + dy],
            probabilities=both(fit.probabilities, self._appearances.of(touch).classes),
        )
        contact = self._writer.fitted(contacts[0], moved)
        self._counters["disagreed" if contact is None else "refined"] += 1
        return contacts if contact is None else [contact]

    def _note(self, frame: ImageFrame | PartFrame, out: ContactFrame) -> None:
        """What to know of these contacts."""
        if any((c.force_n or 0.0) > self.law.most_n or self.law.saturates(c.pressure_pa) for c in out.contacts):
            add_reason(out.reasons, "extrapolated")
        if any(touch.sigma[0] > self._coarse_m for touch in frame.estimates):
            add_reason(out.reasons, "coarse")
        present = [c for c in out.contacts if c.state != "end"]
        forces = {c.id: c.force_n for c in present}
        for touch, force in zip(frame.estimates, forces.values(), strict=False):
            if self.law.impossible(touch.drop - 3 * touch.drop_sigma, force):
                out.valid = False
                add_reason(out.reasons, "out_of_distribution")

    def _force(self, frame: ContactFrame) -> ForceFrame:
        """The total force; valid if the contacts are."""
        present = [c for c in frame.contacts if c.state != "end"]
        total = None if not self.law.exists else sum(c.force_n or 0.0 for c in present)
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

    def _shape(self, out: ContactFrame, frame: ImageFrame | PartFrame) -> ShapeFrame:
        present = [c for c in out.contacts if c.state != "end"]
        looks = self._looks(frame, present)
        fit = self._fit[0] if self._fit is not None and any(c.refined for c in present) else None
        outlines = [look.outline for look in looks]
        probabilities = [look.classes or [0.0] * len(SHAPES) for look in looks]
        if fit is not None and looks:
            outlines = outlines if area_of_image(fit) else [refined_outline(fit)]
            probabilities = [both(fit.probabilities, looks[0].classes)]
        return ShapeFrame(
            **inherited(out),
            ids=[c.id for c in present],
            outlines=outlines,
            orientation=[c.orientation for c in present],
            probabilities=probabilities,
            refined=fit is not None,
        )

    def _looks(self, frame: ImageFrame | PartFrame, present: list[Contact]) -> list[Appearance]:
        """In the order of the contacts."""
        touches = {self._ids[touch.id][0]: touch for touch in frame.estimates}
        return [self._appearances.of(touches[contact.id]) for contact in present]

    def state(self) -> dict[str, Any]:
        return {
            "next_id": self._next_id,
            "ids": [[touch, *known] for touch, known in self._ids.items()],
            "shown": [asdict(c) for c in self._shown],
            "untold": [asdict(c) for c in self._untold],
            "lasting": self.lasting.state(),
            "looks": [[number, asdict(look)] for number, look in self._appearances.known.items()],
        }

    def load(self, state: dict[str, Any]) -> None:
        """A state of an earlier version tells nothing that a frame does not tell anew."""
        self._end_all()
        if "ids" not in state:
            return
        self._next_id = max(self._next_id, int(state["next_id"]))
        self._ids = {int(touch): (int(number), int(born_ns)) for touch, number, born_ns in state["ids"]}
        self._shown = [Contact(**c) for c in state["shown"]]
        self._untold = [Contact(**c) for c in state["untold"]]
        self.lasting.load(state["lasting"])
        self._appearances.known = {int(number): Appearance(**look) for number, look in state["looks"]}

    def health(self) -> Health:
        problem = self._invalid.problem
        return Health("WARN" if problem else "OK", [problem] if problem else [], dict(self._counters))
