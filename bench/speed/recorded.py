"""Raw frames of the stub's board in simulated time, of an untouched skin, a touch held still and one that moves."""

from __future__ import annotations

import json
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from protocol.frames import RawFrame
from services.runtime.config import ScanMode
from simulation.host import SimulatedHost

QUIET_S = 5.0  # of each scene, before it begins: the tare
ENDS_S = 0.5  # before the scene's end the touch is gone
TOUCH = {"shape": "circle", "x": 0.008, "y": -0.012, "force": 2.0, "radius": 0.01}
SCENES = ("untouched", "still", "moving")


class _Kept:
    """Takes what a host would give to the stages."""

    def __init__(self) -> None:
        self.frames: list[RawFrame] = []

    def step(self, raw: RawFrame) -> None:
        self.frames.append(raw)


@lru_cache(maxsize=8)
def recorded(scan: ScanMode, name: str, seconds: float, quiet_s: float = QUIET_S) -> list[RawFrame]:
    """One of SCENES; nothing touches for quiet_s."""
    host, kept = SimulatedHost(scan, 80.0, 3), _Kept()
    host.pipeline = kept  # type: ignore[assignment]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{name}.toml")
        path.write_text(script(name, seconds, quiet_s))
        host.rig.play(str(path), 0.0)
    host.until(quiet_s + seconds)
    host.rig.close()
    return kept.frames


def script(name: str, seconds: float, quiet_s: float) -> str:
    """The TOML of a scene."""
    end, keys = quiet_s + seconds, []
    if name == "still":
        keys = [{"t": t, **TOUCH} for t in (quiet_s, end - ENDS_S)]
    elif name == "moving":
        times = np.arange(0, seconds - ENDS_S + 1e-9, 0.25)
        keys = [
            {**TOUCH, "t": quiet_s + s, "x": 0.03 * float(np.cos(1.3 * s)), "y": 0.03 * float(np.sin(1.3 * s))}
            for s in times
        ]
    lines = [f"duration = {end}"]
    if keys:
        points = [
            "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in each.items()) + " }" for each in keys
        ]
        lines.append("[[touch]]\nkeys = [" + ", ".join(points) + "]")
    return "\n".join(lines) + "\n"
