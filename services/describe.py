"""What info/<skin> says of a skin."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from models.bundle import Bundle
from services.contacts.force import ForceLaw
from services.estimation.tare import Baseline
from services.runtime.config import Skin

CORNERS = 64  # of the polygon that stands for a disc


UNITS = {"z": "ohm", "image": "S/m", "position": "m", "velocity": "m/s", "area_m2": "m^2", "force_n": "N"}


def describe(skin: Skin, bundle: Bundle, baseline: Baseline | None) -> dict[str, Any]:
    """The map of an InfoFrame: bundle, geometry, pose, units and, once there is one, the baseline."""
    found: dict[str, Any] = {
        "bundle": bundle.name,
        "bundle_hash": bundle.hash,
        "geometry": geometry(bundle),
        "pattern": bundle.skin.get("pattern", ""),
        "frame_id": skin.frame_id,
        "parent_frame_id": skin.pose.parent,
        "pose": [*skin.pose.position_m, *skin.pose.quaternion_xyzw],
        "units": UNITS,
        "force_law": ForceLaw.of(skin, bundle).describe(),
        "calibration_hash": None
        if skin.calibration is None
        else hashlib.sha256(skin.calibration.read_bytes()).hexdigest(),
    }
    if baseline is not None:
        found |= {"baseline": baseline.z0.copy(), "baseline_sigma": baseline.sigma, "baseline_hash": baseline.hash}
        found |= {"tare_sample_ns": baseline.taken_ns, "tare": provenance(baseline, bundle)}
    return found


def provenance(baseline: Baseline, bundle: Bundle) -> dict[str, Any]:
    """Where the baseline comes from."""
    return {
        "taken_by": baseline.taken_by,
        "restored": baseline.restored,
        "frames": baseline.frames,
        "board": baseline.board,
        "bundle_hash": bundle.hash,
        "doubt": baseline.doubt,
    }


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
