"""Publishing: from the image to contacts, their forces and shapes, in the skin's frame [m, N]."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import SHAPES, Contact, ContactFrame, ForceFrame, Frame, ImageFrame, ShapeFrame
from services.config import Skin
from services.force import ForceLaw
from services.outline import outline
from services.segmentation import Segment, segment
from services.stage import Health, Stage, add_reason, inherited
from services.tracking import Track, Tracker

UNKNOWN_BELOW = 0.4  # probability of the best class below which a shape is "unknown"


class Publishing(Stage):
    """image -> contact, and force and shape where somebody wants them."""

    reads = "image"
    writes = ("contact", "force", "shape")
    stamp = "publish"
    sleeps = True

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config = skin
        self.law = ForceLaw.of(skin, bundle)
        self.tracker = Tracker()
        self.reset()

    def reset(self) -> None:
        self.tracker.reset()
        self._contacts: list[Contact] = []
        self._segments: list[Segment] = []
        self._classes: list[list[float]] = []
        self._geometry = (0.0, [0.0, 0.0])  # metres per pixel, origin of the segments' image
        self._counters = {"frames": 0, "contacts": 0}

    def new_session(self) -> None:
        self.tracker = Tracker()

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, ImageFrame)
        self._counters["frames"] += 1
        out = ContactFrame(**inherited(frame), frame_id=self.config.frame_id, force_calibrated=self.law.calibrated)
        if self.law.newtons_per_siemens is None:
            add_reason(out.reasons, "uncalibrated_force")
        if frame.held:
            self._keep(frame)
            out.held = True
        else:
            self._see(frame)
        out.contacts = self._contacts
        if any((c.force_n or 0.0) > self.law.most_n for c in out.contacts):
            add_reason(out.reasons, "extrapolated")
        if any(self.law.impossible(s.peak) for s in self._segments):
            out.valid = False
            add_reason(out.reasons, "out_of_distribution")
        frames: list[Frame] = [out]
        if "force" in wanted:
            frames.append(self._force(frame))
        if "shape" in wanted:
            frames.append(self._shape(frame))
        return frames

    def _see(self, frame: ImageFrame) -> None:
        """Contacts of a new image."""
        segments = segment(frame.image, frame.sigma) if frame.image.size and frame.touched else []
        m = frame.metres_per_pixel
        places = [(frame.origin[0] + (s.x + 0.5) * m, frame.origin[1] + (s.y + 0.5) * m) for s in segments]
        tracks, ended = self.tracker.update(places, frame.stamps.get("sample", 0))
        self._segments, self._geometry = segments, (m, frame.origin)
        self._classes = [_class_probabilities(s, frame.classes) for s in segments]
        now = [self._contact(t, s, p, m) for t, s, p in zip(tracks, segments, self._classes, strict=True)]
        self._contacts = now + [_ended(track) for track in ended]
        self._counters["contacts"] += sum(track.age == 1 for track in tracks)

    def _keep(self, frame: ImageFrame) -> None:
        """The same contacts a frame later."""
        kept = [c for c in self._contacts if c.state != "end"]
        self.tracker.update([(c.position[0], c.position[1]) for c in kept], frame.stamps.get("sample", 0))
        for contact in kept:
            contact.state = "hold"
            contact.velocity = [0.0, 0.0, 0.0]
        self._contacts = kept

    def _contact(self, track: Track, s: Segment, classes: list[float], metres_per_pixel: float) -> Contact:
        force, sigma = self.law.force(s.peak, s.peak_sigma)
        best = int(np.argmax(classes)) if classes else -1
        known = bool(classes) and classes[best] >= UNKNOWN_BELOW
        return Contact(
            id=track.id,
            state="begin" if track.age == 1 else "hold",
            position=[track.x, track.y, 0.0],
            velocity=[track.vx, track.vy, 0.0],
            area_m2=s.area * metres_per_pixel**2,
            force_n=force,
            force_sigma_n=sigma,
            wrench=_wrench(track.x, track.y, force or 0.0),
            shape=SHAPES[best] if known else "unknown",
            shape_probability=classes[best] if classes else None,
            confidence=_confidence(s),
        )

    def _force(self, frame: Frame) -> ForceFrame:
        present = [c for c in self._contacts if c.state != "end"]
        total = None if self.law.newtons_per_siemens is None else sum(c.force_n or 0.0 for c in present)
        wrench = np.sum([c.wrench for c in present], axis=0).tolist() if present else [0.0] * 6
        return ForceFrame(**inherited(frame), wrench=wrench, force_n=total)

    def _shape(self, frame: Frame) -> ShapeFrame:
        metres, origin = self._geometry
        present = [c for c in self._contacts if c.state != "end"]
        return ShapeFrame(
            **inherited(frame),
            ids=[c.id for c in present],
            outlines=[outline(s.mask, metres, origin) for s in self._segments],
            orientation=[s.orientation for s in self._segments],
            probabilities=[p or [0.0] * len(SHAPES) for p in self._classes],
        )

    def state(self) -> dict[str, Any]:
        return {"tracker": self.tracker.state()}

    def load(self, state: dict[str, Any]) -> None:
        self.reset()
        self.tracker.load(state["tracker"])

    def health(self) -> Health:
        return Health("OK", [], dict(self._counters))


def _class_probabilities(s: Segment, classes: NDArray[np.float32]) -> list[float]:
    """Mean over the touch of the per-pixel class probabilities (5, h, w), which are on a coarser grid; [] where there
    are none.
    """
    if not classes.size:
        return []
    y, x = np.nonzero(s.mask)
    h, w = classes.shape[1:]
    coarse = classes[:, y * h // s.mask.shape[0], x * w // s.mask.shape[1]]
    mean = coarse.mean(axis=1)
    return [float(p) for p in mean / max(float(mean.sum()), 1e-9)]


def _wrench(x: float, y: float, force: float) -> list[float]:
    """On the skin, at its frame's origin: the touch presses along -z at (x, y)."""
    return [0.0, 0.0, -force, -y * force, x * force, 0.0]


def _confidence(s: Segment) -> float:
    """Probability that the peak is no noise, from its own standard deviation."""
    return 1.0 if s.peak_sigma <= 0 else 0.5 * (1 + math.erf(s.peak / s.peak_sigma / math.sqrt(2)))


def _ended(track: Track) -> Contact:
    return Contact(id=track.id, state="end", position=[track.x, track.y, 0.0], force_n=None, confidence=0.0)
