"""Records tests/recording/golden/*.mcap anew, from the stub: `python -m tests.recording.make_golden`, about a minute.

Rarely needed: what the stages make of the recordings is accepted anew with `make golden`. A recording begins with the
untouched skin, so that it holds its own baseline and fits whatever bundle is installed. The float network runs, since
the int8 one is rounded otherwise by processors without VNNI. adaptive.mcap is of an earlier version: it stays as it is.
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

import numpy as np

from bench.speed.simulated_host import SimulatedHost
from protocol.control import ControlClient
from protocol.frames import RawFrame, pack
from protocol.sockets import NewestReader
from services.recordings import settings
from services.recordings.recording import RecordingWriter
from services.runtime.config import Skin

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


def record_parts(target: Path) -> None:
    """Scans in parts, in simulated time: a press, a slide, two touches, and in between messages that were lost."""
    host, rng = SimulatedHost("rolling", snr_db=80.0, seed=21), np.random.default_rng(21)
    hand_on, raws = host.source.handed_on, list[tuple[float, RawFrame]]()

    def kept(*args: Any) -> RawFrame | None:
        frame = hand_on(*args)
        raws.extend([(host.now, frame)] if frame is not None else [])
        return frame

    host.source.handed_on = kept  # type: ignore[method-assign]
    host.until(3.7)
    start = host.now
    host.press(x=0.02, y=-0.01, force=2.0, radius=0.01, seconds=0.25, finger="one")
    host.until(start + 0.4)
    host.press(x=-0.02, y=0.015, force=3.0, radius=0.01, seconds=60.0, finger="two")
    host.until(start + 0.6)
    host.press(x=-0.02, y=0.015, force=3.0, radius=0.01, seconds=0.3, to_x=0.02, to_y=0.015, finger="two")
    host.until(start + 1.1)
    host.press(x=0.025, y=0.025, force=3.0, radius=0.01, seconds=60.0, finger="three")
    host.until(start + 1.2)
    host.press(x=-0.025, y=-0.02, force=2.0, radius=0.01, seconds=60.0, finger="four")
    host.until(start + 1.5)
    host.release()
    host.until(start + 1.7)
    host.rig.close()
    lost = {k for k in range(len(raws)) if raws[k][0] > start and rng.random() < 0.1}
    lost |= {k for k in range(len(raws)) if 0.85 < raws[k][0] - start < 0.92}  # more than one scan, under a slide
    skin = Skin(port="stub", bundle="square16", network="full", scan="rolling")
    with RecordingWriter(target, {settings.KEY: settings.text_of({"palm": skin})}, overwrite=True) as writer:
        for k, (at, frame) in enumerate(raws):
            if k not in lost:
                writer.write("raw/palm", pack(frame).partition(b"\0")[2], round(1e9 * at))


if __name__ == "__main__":
    record_parts(HERE / "golden" / "rolling.mcap")
    for session, what in SESSIONS.items():
        record(session, what)
