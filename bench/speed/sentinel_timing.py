"""From touch to contact in the stub's timing: adaptive scanning beside full scans alone, on the same presses."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.speed.sentinel_host import AdaptiveHost
from protocol.frames import ContactFrame
from services.runtime.config import ScanMode

SETTLE_S = 3.6  # for the board to idle again
HELD_S = 0.4
LOOK_S = 0.3  # how long a contact, or its end, is waited for
KINDS = ("coarse", "full", "any", "release")


def presses(count: int, seed: int, light: bool) -> list[dict[str, float]]:
    """Wholly on the skin. light: 1 N of the paper's 10 mm indenter, near what a full scan at 70 dB just sees."""
    rng = np.random.default_rng([seed, 3])
    found = []
    for _ in range(count):
        radius = 0.005 if light else 0.01
        x, y = rng.uniform(-0.05 + radius, 0.05 - radius, 2)
        force = 1.0 if light else float(rng.uniform(1, 5))
        found.append({"x": float(x), "y": float(y), "radius": radius, "force": force})
    return found


def latencies(scan: ScanMode, count: int, seed: int, light: bool = False) -> dict[str, Any]:
    """Seconds (n,) from each press to its contacts of each of KINDS, NaN where none came; position errors [m]."""
    host, rng = AdaptiveHost(scan, seed=seed), np.random.default_rng([seed, 5])
    host.until(3.0 + SETTLE_S)
    times: dict[str, list[float]] = {kind: [] for kind in KINDS}
    errors: dict[str, list[float]] = {"coarse": [], "full": []}
    off: list[float] = []  # of a coarse contact's force, in its own standard deviations
    false = 0
    for press in presses(count, seed, light):
        before = len(host.contacts)
        host.until(host.now + rng.uniform(0.2, 1.2))
        false += sum(bool(frame.contacts) for _, frame in host.contacts[before:])
        start, first = host.now, len(host.contacts)
        host.press(**press, seconds=60.0)
        host.until(start + HELD_S + rng.uniform(0, 0.1))  # released at a random phase too
        seen = [(t - start, f) for t, f in host.contacts[first:] if f.valid and _touching(f)]
        coarse, full = ([(t, f) for t, f in seen if ("coarse" in f.reasons) is kind] for kind in (True, False))
        for kind, found in (("coarse", coarse), ("full", full), ("any", seen)):
            times[kind].append(found[0][0] if found else np.nan)
        for kind, found in (("coarse", coarse[-1:]), ("full", full[:1])):
            errors[kind] += [_error(f, press) for _, f in found]
        off += [_off(f, press) for _, f in coarse[-1:]]
        start, first = host.now, len(host.contacts)
        host.release()
        host.until(start + LOOK_S)
        gone = [t - start for t, f in host.contacts[first:] if f.valid and not _touching(f)]
        times["release"].append(gone[0] if gone else np.nan)
        host.until(host.now + SETTLE_S)
    counts = dict(host.adaptive.counts) if host.adaptive else {}
    host.rig.close()
    arrays = {kind: np.array(values) for kind, values in times.items()}
    return {**arrays, "errors": errors, "off": off, "false": false, "counts": counts, "simulated_s": host.now}


def _touching(frame: ContactFrame) -> bool:
    return any(contact.state != "end" for contact in frame.contacts)


def _error(frame: ContactFrame, press: dict[str, float]) -> float:
    return float(min(np.hypot(c.position[0] - press["x"], c.position[1] - press["y"]) for c in frame.contacts))


def _off(frame: ContactFrame, press: dict[str, float]) -> float:
    contact = frame.contacts[0]
    return ((contact.force_n or 0.0) - press["force"]) / (contact.force_sigma_n or np.inf)
