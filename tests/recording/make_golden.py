"""Records tests/recording/golden/*.mcap anew, from the stub: `python -m tests.recording.make_golden`, about a minute.

Rarely needed: what the stages make of the recordings is accepted anew with `make golden`. A recording begins with the
untouched skin, so that it holds its own baseline and fits whatever bundle is installed. The float network runs, since
the int8 one is rounded otherwise by processors without VNNI.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from protocol.control import ControlClient
from protocol.sockets import NewestReader

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
UNTOUCHED_S = 4.0
Step = tuple[float, str, dict[str, Any]]


def press(x: float, y: float, force: float, seconds: float, radius: float = 0.01, **more: Any) -> dict[str, Any]:
    return {"x": x, "y": y, "force": force, "seconds": seconds, "radius": radius, "shape": "circle", **more}


def fault(name: str, seconds: float, **args: Any) -> dict[str, Any]:
    return {"name": name, "args": args, "clear": False, "seconds": seconds}


SESSIONS: dict[str, list[Step]] = {  # what happens, and then so many seconds
    "contacts": [
        (3.0, "press", press(0.02, -0.01, 3.0, 2.0)),
        (1.0, "press", press(-0.025, 0.02, 2.0, 3.5)),
        (4.0, "press", press(0.025, 0.02, 4.0, 2.0)),
        (3.5, "press", press(-0.02, -0.02, 3.0, 2.5, to_x=0.02, to_y=-0.02)),
        (2.5, "press", press(0.038, 0.0, 1.0, 1.5, radius=0.006)),
    ],
    "faults": [
        (1.5, "press", press(0.0, 0.0, 3.0, 6.0)),
        (3.0, "faults", fault("electrode_open", 1.5, electrode=3)),
        (3.5, "faults", fault("sequence_gaps", 1.0)),
        (2.0, "faults", fault("clipped", 1.0)),
        (4.0, "faults", fault("unplug", 1.0)),
    ],
}


def record(name: str, steps: list[Step], wait: Callable[[float], None] = time.sleep) -> None:
    """One session with a service of its own."""
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as folder:
        config = Path(folder) / "skin.toml"
        config.write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\nnetwork = "full"\n')
        environment = {**os.environ, "EITSKIN_RUNTIME": folder, "EITSKIN_CONFIG": str(config)}
        os.environ["EITSKIN_RUNTIME"] = folder
        target = HERE / "golden" / f"{name}.mcap"
        skin = [sys.executable, str(ROOT / "skin")]
        recorder = subprocess.Popen(
            [*skin, "record", str(target), "--topics", "raw", "--overwrite"], cwd=ROOT, env=environment
        )
        wait(3.0)
        service = subprocess.Popen([*skin, "up"], cwd=ROOT, env=environment)
        try:
            reader = NewestReader("contact", "palm")
            while (frame := reader.recv(1.0)) is None or not frame.valid:
                assert service.poll() is None
            wait(UNTOUCHED_S)
            for seconds, command, args in steps:
                ControlClient("stub", 5.0).call(command, skin="palm", **args)
                wait(seconds)
            reader.close()
        finally:
            recorder.send_signal(signal.SIGINT)
            recorder.wait(20)
            service.send_signal(signal.SIGTERM)
            service.wait(20)


if __name__ == "__main__":
    for session, what in SESSIONS.items():
        record(session, what)
