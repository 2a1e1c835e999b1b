"""What info/<skin> says of a skin."""

from __future__ import annotations

import hashlib
from collections import deque
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from models.bundle import Bundle
from models.prereconstruction import ONE_STEP_LAMBDA
from models.symmetries import symmetries
from protocol.frames import RawFrame
from services.contacts.force.law import ForceLaw
from services.estimation.initialisation.baseline import Baseline
from services.runtime.config import Skin
from services.runtime.stage import SEPARATE

ON = "on"
CORNERS = 64  # of the polygon that stands for a disc
MOVED = 2e-4  # relative: as two frames of 80 dB differ; a baseline that drifted by more is sent again
EVERY_S = 5.0  # but that at most so often
RATE_FRAMES = 16  # of which the median time between two scans is taken
RATE_CHANGED = 0.1  # relative: a rate that changed by more is sent again

UNITS = {"z": "ohm", "image": "S/m", "position": "m", "velocity": "m/s", "area_m2": "m^2", "force_n": "N"}


def force(skin: Skin, bundle: Bundle) -> dict[str, Any]:
    """The part of the map that says how forces are found. bundle: as it was loaded, which a calibration of forces names
    whatever a tare finds about the mounting. Read once, at the start, as the publisher does. Raises ConfigError.
    """
    law, file = ForceLaw.of(skin, bundle).describe(), skin.calibration
    return {
        "force_law": law,
        "calibration_hash": None if file is None else hashlib.sha256(file.read_bytes()).hexdigest(),
    }


def describe(
    skin: Skin,
    bundle: Bundle,
    force: dict[str, Any],
    baseline: Baseline | None,
    revision: int = 0,
    rate_hz: dict[str, float] | None = None,
) -> dict[str, Any]:
    """The map of an InfoFrame: bundle (the one in use), geometry, pose, units, the rate of frames, what `force` said
    and, once there is one, the baseline.
    """
    ladder = np.asarray(bundle.matrices.ladder, dtype=float)
    nearest = np.argmin(np.abs(np.log(ladder) - 2 * np.log(ONE_STEP_LAMBDA)))
    found: dict[str, Any] = {
        "bundle": bundle.name,
        "bundle_hash": bundle.hash,
        "geometry": geometry(bundle),
        "pattern": bundle.skin.get("pattern", ""),
        "stack": {"lambda_squared": ladder.tolist(), "one_step": int(nearest)},
        "frame_id": skin.frame_id,
        "parent_frame_id": skin.pose.parent,
        "pose": [*skin.pose.position_m, *skin.pose.quaternion_xyzw],
        "surface": None if skin.surface is None else skin.surface.model_dump(),
        "units": UNITS,
        "rate_hz": rate_hz,
        **force,
    }
    if baseline is not None:
        found |= {"baseline": baseline.z0, "baseline_sigma": baseline.sigma, "baseline_hash": baseline.hash}
        found |= {"baseline_revision": revision, "tare_sample_ns": baseline.taken_ns}
        found["tare"] = {
            "taken_by": baseline.taken_by,
            "restored": baseline.restored,
            "frames": baseline.frames,
            "board": baseline.board,
            "bundle_hash": bundle.hash,
            "doubt": baseline.doubt,
        }
    return found


def symmetry(skin: Skin, bundle: Bundle) -> str:
    """Whether a held touch's image becomes the mean over the skin's symmetries: "on", or why not."""
    if not skin.touch.symmetry:
        return "off: skin.toml does not say `touch = { symmetry = true }`"
    if not skin.touch.hold:
        return "off: `hold = false`, and only of an image that is held the mean is made"
    if bundle.locator is not None:
        return f"off: bundle {bundle.name} is registered to one very skin, which is like itself alone"
    if skin.network == "none" or bundle.network_path("full") is None:
        return "off: the mean is of a network's images, and there is no network"
    if len(symmetries(bundle.skin, bundle.pattern)) < 2:
        return f"off: bundle {bundle.name} has no symmetry: turned or mirrored, its outline or electrodes are others"
    return ON


class FrameRate:
    """How often contact frames come: `found` maps `least` to the rate of whole scans, which holds whatever happens, and
    `touched` to that of the parts, which they reach while a touch is followed from part to part. None: not yet known.
    """

    def __init__(self) -> None:
        self.found: dict[str, float] | None = None
        self._before = (0, 0, 0)  # parts, scan, `sample` of the frame before; no parts: there is none
        self._steps_ns: deque[float] = deque(maxlen=RATE_FRAMES)

    def __call__(self, frame: RawFrame) -> None:
        """Take the next raw frame. Scans lost in between count; those that follow no other do not."""
        if frame.kind != "full" or SEPARATE in frame.reasons:
            return
        (parts, scan, sample_ns), now_ns = self._before, frame.stamps.get("sample", 0)
        self._before = frame.parts, frame.scan, now_ns
        if parts != frame.parts or frame.scan <= scan:
            self._steps_ns.clear()
            return
        self._steps_ns.append((now_ns - sample_ns) / (frame.scan - scan))
        if len(self._steps_ns) < RATE_FRAMES:
            return
        step_ns = float(np.median(self._steps_ns))
        self._steps_ns.clear()
        if step_ns > 0:
            touched = 1e9 / step_ns
            announced = 0.0 if self.found is None else self.found["touched"]
            if abs(touched - announced) > RATE_CHANGED * touched:
                self.found = {"least": round(touched / frame.parts, 2), "touched": round(touched, 2)}


class _Announced(NamedTuple):
    baseline: Baseline | None
    origin: tuple[Any, ...]  # its rate, and what drift leaves of a baseline as the tare found it
    at_ns: int


_ORIGIN = attrgetter("taken_ns", "taken_by", "restored", "frames", "board", "doubt")


class BaselineNews:
    """Whether info/<skin> is to be sent again: at once for another baseline, and when the same one has drifted far
    enough.
    """

    def __init__(self) -> None:
        self._sent: _Announced | None = None

    def __call__(self, baseline: Baseline | None, now_ns: int, rate_hz: dict[str, float] | None = None) -> bool:
        """True: the caller sends it now. now_ns: stamp `sample` of the newest frame. rate_hz: sent anew as it is
        another.
        """
        sent, rate = self._sent, tuple((rate_hz or {}).values())
        origin = rate, None if baseline is None else _ORIGIN(baseline)
        if sent is not None and sent.origin == origin:
            if sent.baseline is None or baseline is None or abs(now_ns - sent.at_ns) < EVERY_S * 1e9:
                return False
            if not (np.abs(baseline.z0 - sent.baseline.z0) > MOVED * np.abs(sent.baseline.z0)).any():
                return False
        self._sent = _Announced(baseline, origin, now_ns)
        return True


def geometry(bundle: Bundle) -> dict[str, Any]:
    """name, outline (n, 2) [m] counter-clockwise, electrodes (E, 2) [m] their centres, metres_per_unit."""
    skin, metres = bundle.skin, bundle.metres_per_unit
    outline = skin.get("outline")
    if outline is None:
        angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
        outline = float(skin.get("radius", 1.0)) * np.stack([np.cos(angle), np.sin(angle)], 1)
    centres = skin.get("electrodes", {}).get("centre", [])
    return {
        "name": str(skin.get("name", bundle.name)),
        "outline": metres * np.asarray(outline, dtype=float),
        "electrodes": metres * np.asarray(centres, dtype=float).reshape(-1, 2),
        "metres_per_unit": metres,
    }
