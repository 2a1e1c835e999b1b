"""Presses of every radius and force at random places, in simulated time or through a running service, and what is said
of each at the end of its hold.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bench.speed.service import Outside, Service, running_square
from models.pressure import FOAM, disc
from services.runtime.config import ScanMode
from simulation.host import SimulatedHost

RADII_MM = (5.0, 10.0, 15.0, 20.0)
NEWTONS = (0.5, 1.0, 2.0, 3.5, 5.0)
SIDE_M = 0.1  # of square16
HELD_S, PAUSE_S, START_S = 1.2, 0.8, 5.0
PATIENCE_S = 0.3  # before the press's end: a contact as old counts
LIVE_SNR_DB = 80.0  # of the stub as `skin up` starts it


@dataclass(frozen=True)
class PressRow:
    """One press and the last contact while it was held; None: nothing was shown."""

    scan: str
    radius_mm: float
    newtons: float
    x: float
    y: float
    said: float | None
    sigma: float | None
    pressure: float | None
    pressure_sigma: float | None
    extrapolated: bool

    @property
    def drop(self) -> float:
        return FOAM.flat_drop(self.newtons, disc(self.radius_mm * 1e-3))


@dataclass(frozen=True)
class PlannedPress:
    radius_mm: float
    newtons: float
    x: float  # m
    y: float

    @property
    def values(self) -> dict[str, float]:
        """For the stub. It is held until it is released."""
        return {"x": self.x, "y": self.y, "force": self.newtons, "radius": self.radius_mm * 1e-3, "seconds": 60.0}

    def row(self, scan: ScanMode, frame: Mapping[str, Any] | None) -> PressRow:
        """What a contact frame, as it comes over the socket, says of this press."""
        contacts = [c for c in frame["contacts"] if c["state"] != "end"] if frame and frame["valid"] else []
        said: dict[str, Any] = min(contacts, key=self._distance, default={})
        told = said.get("force_n") is not None
        return PressRow(
            scan,
            self.radius_mm,
            self.newtons,
            self.x,
            self.y,
            said=said.get("force_n"),
            sigma=said.get("force_sigma_n"),
            pressure=said.get("pressure_pa"),
            pressure_sigma=said.get("pressure_sigma_pa"),
            extrapolated=told and frame is not None and "extrapolated" in frame["reasons"],
        )

    def _distance(self, contact: Mapping[str, Any]) -> float:
        return float(np.hypot(contact["position"][0] - self.x, contact["position"][1] - self.y))


def planned(each: int, seed: int) -> Iterator[PlannedPress]:
    """`each` presses of every radius and force, in random order at random places."""
    rng = np.random.default_rng([seed, 36])
    cases = [(r, f) for r in RADII_MM for f in NEWTONS for _ in range(each)]
    for k in rng.permutation(len(cases)):
        radius, newtons = cases[k]
        half = SIDE_M / 2 - radius * 1e-3
        x, y = rng.uniform(-half, half, 2)
        yield PlannedPress(radius, newtons, float(x), float(y))


def simulated(scan: ScanMode, snr_db: float, each: int, seed: int) -> Iterator[PressRow]:
    """Board, link, clock and stages in one process and in simulated time."""
    host = SimulatedHost(scan, snr_db, seed)
    host.until(START_S)
    for press in planned(each, seed):
        host.press(**press.values)
        host.contacts.clear()
        host.until(host.now + HELD_S)
        last = next((f for t, f in reversed(host.contacts) if f.valid and t >= host.now - PATIENCE_S), None)
        yield press.row(scan, None if last is None else asdict(last))
        host.release()
        host.until(host.now + PAUSE_S)
    host.rig.close()


def live(scan: ScanMode, each: int, seed: int) -> Iterator[PressRow]:
    """A service of its own, seen by a controller that has none of the project's code."""
    with running_square(scan) as service:
        contacts = Outside("contact", "palm", service.folder)
        _last(contacts, START_S)
        for press in planned(each, seed):
            yield press.row(scan, _pressed(service, contacts, press))
        contacts.close()


def _pressed(service: Service, contacts: Outside, press: PlannedPress) -> dict[str, Any] | None:
    service.stub("press", **press.values)  # answers once its physics are solved
    shown = _last(contacts, HELD_S)
    service.stub("release")
    _last(contacts, PAUSE_S)
    return shown


def _last(contacts: Outside, seconds: float) -> dict[str, Any] | None:
    """The last valid frame of so many seconds, where it came within PATIENCE_S of their end."""
    end, last = time.monotonic() + seconds, None
    while (left := end - time.monotonic()) > 0:
        got = contacts.recv(left)
        if got is not None and got[0]["valid"]:
            last = got
    if last is None or last[1] * 1e-9 < end - PATIENCE_S:
        return None
    return last[0]
