"""The estimator built anew as a candidate for the shadow: contact frames of its estimates alone, without an image."""

from __future__ import annotations

import contextlib
import math

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.measurement.tables import tables_of
from models.pressure import FOAM
from protocol.frames import Contact, ContactFrame, RawFrame
from services.contacts import patch_force
from services.contacts.lasting import LastingStates
from services.estimation.estimator import Estimator
from services.estimation.first.tare import TareRefused
from services.estimation.values.estimate import Estimate, TouchEstimate
from services.estimation.values.scan import Scan
from services.runtime.config import Skin

Array = NDArray[np.float64]

VALID_SCANS = 3.0  # for which a frame may be acted on
ACTION_SIGMA = 0.03  # relative: of the response, 0.91 to 1.09 over all shapes
MOST_ACTS = 2.2  # action over area: 2 where nothing conducts, and that response's error
SPREAD = np.linspace(-2.4, 2.4, 9)  # sigmas of radius and action that are summed over
WEIGHT = np.exp(-(SPREAD**2) / 2) / np.exp(-(SPREAD**2) / 2).sum()
CREEPS, CREEPS_S = 0.05, 20.0  # relative: foam that yields while it is pressed, of a minute, and when
PLACE_SIGMA_M = 1e-4  # where no touch is known better: the tables' own


class Anew:
    """Of one skin; see bench.trust.candidate.Candidate."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        self._skin, self._metres = skin, bundle.metres_per_unit
        self._tables = tables_of(bundle)
        self.reset()

    def reset(self) -> None:
        self.estimator = Estimator(self._tables)
        self._lasting = LastingStates()
        self._before: Scan | None = None
        self._shown: dict[int, Contact] = {}

    def tare(self) -> None:
        with contextlib.suppress(TareRefused):
            self.estimator.tare()

    @property
    def refused(self) -> bool:
        return False

    def step(self, raw: RawFrame) -> ContactFrame | None:
        if not len(raw.z):
            return None
        scan = Scan.of(raw, self._before)
        self._before = scan
        estimate = self.estimator.step(scan)
        frame = ContactFrame(
            skin=raw.skin,
            scan=raw.scan,
            part=raw.part,
            stamps=dict(raw.stamps),
            sample_sigma_ns=raw.sample_sigma_ns,
            source=raw.source,
            valid=estimate.valid,
            reasons=list(estimate.reasons),
            valid_for_s=VALID_SCANS * scan.duration_s,
            frame_id=self._skin.frame_id,
            contacts=[],
        )
        if estimate.valid:
            frame.contacts = self._contacts(estimate, raw.stamps.get("sample", 0))
        return frame

    def _contacts(self, estimate: Estimate, sample_ns: int) -> list[Contact]:
        found = {touch.id: self._contact(touch) for touch in estimate.touches}
        ended = [self._shown[number] for number in self._shown if number not in found]
        for contact in ended:
            contact.state = "end"
        self._shown = found
        strongest = sorted(found.values(), key=lambda contact: -(contact.force_n or 0.0))
        return self._lasting([*strongest, *ended], sample_ns)

    def _contact(self, touch: TouchEstimate) -> Contact:
        force, sigma = force_of(touch, self._metres)
        place = touch.covariance[:2, :2] * self._metres**2
        values, vectors = np.linalg.eigh(place)
        short, long = np.sqrt(np.maximum(values, 0.0) + PLACE_SIGMA_M**2)
        return Contact(
            id=touch.id,
            state="begin" if touch.id not in self._shown and touch.began else "hold",
            position=[touch.x * self._metres, touch.y * self._metres, 0.0],
            velocity=[touch.vx * self._metres, touch.vy * self._metres, 0.0],
            area_m2=math.pi * (touch.radius * self._metres) ** 2,
            force_n=force,
            force_sigma_n=sigma,
            position_sigma=[float(long), float(short), math.atan2(vectors[1, 1], vectors[0, 1])],
        )


def force_of(touch: TouchEstimate, metres_per_unit: float) -> tuple[float, float]:
    """Newtons and their sigma: the foam's pressure at the disc's drop over its area, a mean over the radii and actions
    that it may have. What the measurements tell, drop / (1 - drop / 2) times the area, is the same for all radii. A
    patch that may have saturated has a force from below only: its sigma reaches to where the foam tells nothing more.
    """
    radius_sd = math.sqrt(max(touch.covariance[2, 2], 0.0))
    action_sd = math.hypot(touch.strength_sd / max(touch.strength, 1e-12), ACTION_SIGMA)
    log_radius = touch.log_radius + radius_sd * SPREAD[:, None]
    area = math.pi * np.exp(2 * log_radius)
    acts = touch.strength * np.maximum(1 + action_sd * SPREAD, 0.0) / area
    weight = WEIGHT[:, None] * WEIGHT * (acts < MOST_ACTS)
    weight = weight / weight.sum() if weight.any() else WEIGHT[:, None] * WEIGHT
    drop = np.minimum(acts / (1 + acts / 2), patch_force.FULL)
    square_metres = area * metres_per_unit**2
    pressure = FOAM.pressure(drop)
    forces = square_metres * pressure
    beyond = square_metres * (FOAM.pressure(patch_force.FULL) - pressure) * (drop > patch_force.BLIND)
    mean = float((weight * forces).sum())
    spread = float((weight * ((forces - mean) ** 2 + beyond**2 / 3)).sum())
    creeps = CREEPS * (1 - math.exp(-touch.age_s / CREEPS_S))
    return mean, math.sqrt(spread + (creeps * mean) ** 2)
