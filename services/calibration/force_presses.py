"""Presses of known force for a calibration, from a running service or from a file of measurements."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from models.bundle import Bundle
from protocol.frames import Frame, ImageFrame
from services.calibration.force_fit import CalibrationError
from services.calibration.seen import SeenTouch, SeenTouches, TouchReader, mean
from services.pipeline import Pipeline
from services.recordings.npz_file import load_npz, read_input
from services.recordings.reconstruction import baseline_of, mounted_bundle, raw_frame
from services.rows.columns import read_columns
from services.rows.order import InputError
from services.runtime.config import Skin

STEADY_S = 1.5  # how long a press must have been steady
STEADY = 0.05  # relative standard deviation, within that time, of how strongly it acts
FEWEST_FRAMES = 8
PATIENCE_S = 60.0


class Steady:
    """Collects frames of a press until it has been steady long enough."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, SeenTouch]] = deque()
        self.trouble = "nothing touches"

    def __call__(self, seen: SeenTouches, now: int) -> SeenTouch | None:
        """The mean of the steady time, or None while it is not over; `trouble` then says why. now: `sample` [ns]."""
        found = seen.touches
        if len(found) != 1:
            self._recent.clear()
            self.trouble = f"{len(found)} touches at once" if found else "nothing touches"
            if seen.reasons:
                self.trouble = f"the frames are not valid: {', '.join(seen.reasons)}"
            return None
        self._recent.append((now, found[0]))
        while now - self._recent[0][0] > 2e9 * STEADY_S:
            self._recent.popleft()
        lately = [k for t, k in self._recent if now - t <= 1e9 * STEADY_S]
        acts = np.array([k.acts for k in lately])
        scatter = float(acts.std() / acts.mean())
        if scatter > STEADY:
            self.trouble = f"the touch still changes by {100 * scatter:.0f} %"
            return None
        self.trouble = "the touch has not lasted long enough"
        enough = now - self._recent[0][0] >= 1e9 * STEADY_S and len(lately) >= FEWEST_FRAMES
        return mean(lately) if enough else None


class Reader(Protocol):
    """The part of protocol.sockets.AllReader that is needed here."""

    def recv(self, timeout_s: float = 0.0) -> Frame | None: ...


def wait_for_press(reader: Reader, read: TouchReader) -> SeenTouch:
    """The next steady press. Raises CalibrationError where none comes."""
    steady, end = Steady(), time.monotonic() + PATIENCE_S
    received = False
    while time.monotonic() < end:
        frame = reader.recv(0.5)
        if isinstance(frame, ImageFrame):
            received = True
            if (pressed := steady(read(frame), frame.stamps.get("sample", 0))) is not None:
                return pressed
    if not received:
        raise CalibrationError(f"no image came within {PATIENCE_S:g} s: start the service with `skin up`")
    raise CalibrationError(f"no steady press within {PATIENCE_S:g} s: {steady.trouble}")


def wait_for_release(reader: Reader) -> None:
    """Wait until nothing touches. Raises CalibrationError where that does not happen."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        frame = reader.recv(0.5)
        if isinstance(frame, ImageFrame) and not frame.touched:
            return
    raise CalibrationError(f"something still touches after {PATIENCE_S:g} s: free the skin, or tare (`skin tare`)")


def of_file(path: Path, skin: Skin, bundle: Bundle, warn: Callable[[str], None]) -> Callable[[int], SeenTouch]:
    """What is seen of each row of a file of measurements; that function raises ValueError. It is what the service sees
    after a tare: with the skin as it is mounted, found from the untouched rows.

    Raises CalibrationError.
    """
    try:
        arrays, understood = read_columns(load_npz(path), bundle)
        known = {
            "measurements": arrays.get("measurements", arrays.get("touched")),
            "untouched": arrays.get("untouched"),
        }
        data = read_input({k: each for k, each in known.items() if each is not None}, len(bundle.pattern))
    except InputError as why:
        raise CalibrationError(str(why) if str(path) in str(why) else f"{path}: {why}") from None
    assert data.untouched is not None  # read_input sees to it
    if understood:
        warn(f"{path} read as: {understood}")
    skin = skin.model_copy(update={"calibration": None})
    if skin.tare.calibrate:
        bundle = mounted_bundle(data.untouched, bundle, warn)
    name = skin.frame_id or "skin"
    pipeline = Pipeline(skin, name, bundle, always_reconstruct=True, each_alone=True)
    baseline = baseline_of(data.untouched, pipeline.pre.pre, warn, data.measurements)
    read = TouchReader(skin, bundle, each_alone=True)

    def seen(row: int) -> SeenTouch:
        if not 0 <= row < len(data.measurements):
            raise ValueError(f"{path} has rows 0 to {len(data.measurements) - 1}")
        pipeline.reset()
        pipeline.pre.set_baseline(replace(baseline, z0=baseline.z0.copy()))
        image = pipeline.run(raw_frame(data.measurements[row], 0)).image
        found, reasons = read(replace(image, touched=True))
        if reasons:
            raise ValueError(f"it is not valid: {', '.join(reasons)}")
        if len(found) != 1:
            raise ValueError(f"found {len(found)} touches in it, expected one")
        return found[0]

    return seen
