"""The estimator built anew as a candidate for the shadow: contact frames of its estimates alone, without an image.

A tare by command calibrates the mounting, as the service's does.
"""

from __future__ import annotations

import math
import os
import time

import numpy as np
from numpy.typing import NDArray

from bench.trust.candidate import FIT_S
from bench.trust.disc_force import force_of
from models.bundle import Bundle
from models.measurement.tables import tables_of
from protocol.frames import Contact, ContactFrame, RawFrame
from services.contacts.lasting import LastingStates
from services.estimation.estimator import Estimator
from services.estimation.first.tare import AgreedScans, TareRefused
from services.estimation.tare import Baseline
from services.estimation.values.estimate import Estimate, TouchEstimate
from services.estimation.values.scan import Scan
from services.linearisation import Linearisation
from services.runtime.config import Skin

Array = NDArray[np.float64]

VALID_SCANS = 3.0  # for which a frame may be acted on
PLACE_SIGMA_M = 1e-4  # where no touch is known better: the tables' own


class Anew:
    """Of one skin; see bench.trust.candidate.Candidate."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        self._skin, self._bundle, self._metres = skin, bundle, bundle.metres_per_unit
        self._tables = tables_of(bundle)
        self.reset()

    def reset(self) -> None:
        self.estimator = Estimator(self._tables)
        self.linearisation = Linearisation(f"anew-{os.getpid()}", self._bundle)  # others keep what theirs found
        self._lasting = LastingStates()
        self._before: Scan | None = None
        self._shown: dict[int, Contact] = {}

    def tare(self) -> None:
        try:
            scans = self.estimator.tare()
        except TareRefused:
            return
        if not self._skin.tare.calibrate or not self.linearisation.tared(baseline_of(scans)):
            return
        waited = time.monotonic() + FIT_S
        while self.linearisation.busy and time.monotonic() < waited:
            if self.linearisation.follows(self.estimator.touched):
                self.estimator.use(tables_of(self.linearisation.bundle))
            time.sleep(0.02)

    @property
    def refused(self) -> bool:
        return False

    def step(self, raw: RawFrame) -> ContactFrame | None:
        if not len(raw.z):
            return None
        if self.linearisation.follows(self.estimator.touched):
            self.estimator.use(tables_of(self.linearisation.bundle))
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


def baseline_of(scans: AgreedScans) -> Baseline:
    """As a fit of the mounting takes it."""
    z0 = np.exp(scans.log_z0)
    noise = z0 * scans.residuals.std(axis=0, ddof=1)
    sigma = np.where(scans.live, np.maximum(noise, z0 * scans.least_white**0.5), np.inf)
    return Baseline(z0, sigma, len(scans.residuals), board="", taken_ns=0, taken_by="command")
