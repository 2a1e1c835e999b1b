"""Presses at known places, measured on a running service: what `skin register` and `skin calibrate force` read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.frames import ImageFrame, RawFrame
from protocol.whole_file import whole_file, write_whole
from services.calibration.force_fit import CalibrationError
from services.calibration.force_presses import Reader, Steady
from services.calibration.seen import SeenTouch, TouchReader
from services.polygon import distance, inside

Array = NDArray[np.float64]

UNTOUCHED = 32  # scans before a press whose mean is its reference
FEWEST_UNTOUCHED = 8
REPEATED_S = 0.1  # two whole scans: in parts a frame repeats values that are as old as one, of before a release
PRESSED_S = 1.0  # the last of a steady press: its scans are averaged


@dataclass(frozen=True)
class Collected:
    """One press: where and how hard it was, as who pressed says, and what was measured."""

    x: float  # m
    y: float
    force_n: float | None
    touched: Array  # (K,) mean |Z|
    untouched: Array  # (K,) the same just before


class Collector:
    """Follows raw and image frames of one skin. Use: `untouched`, then press, then `pressed`, then release."""

    def __init__(self, reader: Reader, read: TouchReader, clock: Callable[[], float], patience_s: float) -> None:
        self._reader, self._read, self._clock, self._patience_s = reader, read, clock, patience_s
        self._raw: dict[int, Array] = {}  # scan -> |Z|, of the scans that no image has been seen of yet
        self._images: dict[int, ImageFrame] = {}  # the other way round: they come over two sockets
        self._quiet: deque[Array] = deque(maxlen=UNTOUCHED)

    def untouched(self) -> Array:
        """(K,) mean |Z| of scans in which nothing touched, all measured from now on. Raises CalibrationError."""
        self._quiet.clear()
        while self._reader.recv(0.0) is not None:  # what was measured before
            pass
        why = "no frame came: start the service with `skin up`"
        since_ns = None
        for image, z in self._pairs():
            now_ns = image.stamps.get("sample", 0)
            if disturbance := _disturbance(image):
                since_ns, why = now_ns, disturbance
                self._quiet.clear()
                continue
            since_ns = now_ns if since_ns is None else since_ns
            if now_ns - since_ns < 1e9 * REPEATED_S:
                continue
            self._quiet.append(z)
            if len(self._quiet) >= FEWEST_UNTOUCHED:
                return np.asarray(np.mean(self._quiet, axis=0))
            why = "the skin has not been untouched for long enough"
        raise CalibrationError(f"no untouched scans within {self._patience_s:g} s: {why}")

    def pressed(self) -> tuple[Array, SeenTouch]:
        """(K,) mean |Z| of the next steady press, and what is seen of it. Raises CalibrationError."""
        steady, recent = Steady(), deque[tuple[int, Array]]()
        for image, z in self._pairs():
            now = image.stamps.get("sample", 0)
            if not image.touched:
                recent.clear()
            recent.append((now, z))
            while now - recent[0][0] > 1e9 * PRESSED_S:
                recent.popleft()
            if (seen := steady(self._read(image), now)) is not None:
                return np.asarray(np.mean([row for _, row in recent], axis=0)), seen
        raise CalibrationError(f"no steady press within {self._patience_s:g} s: {steady.trouble}")

    def _pairs(self) -> Iterator[tuple[ImageFrame, Array]]:
        """Image frames with their scans, until patience ends."""
        end = self._clock() + self._patience_s
        while self._clock() < end:
            if (pair := self._pair()) is not None:
                yield pair

    def _pair(self) -> tuple[ImageFrame, Array] | None:
        """The next image frame and the scan that it comes from."""
        frame = self._reader.recv(0.5)
        if isinstance(frame, RawFrame) and frame.kind == "full":
            _remember(self._raw, frame.scan, np.abs(frame.z).astype(float))
        elif isinstance(frame, ImageFrame):
            _remember(self._images, frame.scan, frame)
        if frame is None or not (frame.scan in self._raw and frame.scan in self._images):
            return None
        return self._images.pop(frame.scan), self._raw.pop(frame.scan)


def _disturbance(image: ImageFrame) -> str:
    """What keeps a scan from counting as untouched; "" where nothing does."""
    if image.touched:
        return "something touches"
    reasons = f" ({', '.join(image.reasons)})" if image.reasons else ""
    return "" if image.valid else f"the frames are not valid{reasons}"


def _remember(of: dict[int, Any], scan: int, value: Any) -> None:
    of[scan] = value
    while len(of) > 2 * UNTOUCHED:  # the other one never came
        del of[next(iter(of))]


def places(outline: Array, n: int, margin: float) -> Array:
    """(n, 2) places spread over a skin, no nearer to its outline (m, 2) than `margin` [m]: for a stub to be pressed at.

    Of many random places, each next one is the farthest from those chosen before.
    """
    rng = np.random.default_rng(0)
    low, high = outline.min(axis=0), outline.max(axis=0)
    tried = rng.uniform(low, high, (4000, 2))
    tried = tried[inside(outline, *tried.T) & (distance(outline, tried) >= margin)]
    if not len(tried):
        raise CalibrationError(f"no place of the skin is {1e3 * margin:g} mm from its outline: press with less radius")
    chosen = [tried[0]]
    far = np.hypot(*(tried - chosen[0]).T)
    for _ in range(n - 1):
        chosen.append(tried[int(far.argmax())])
        far = np.minimum(far, np.hypot(*(tried - chosen[-1]).T))
    return np.array(chosen)


def write(path: Path, collected: Sequence[Collected], pattern: NDArray[Any]) -> Path | None:
    """The npz that `skin register` reads, and beside it, where every press has a force, the CSV that
    `skin calibrate force --csv FILE.csv --measurements FILE.npz` reads; returns that one. Raises OSError.
    """
    with whole_file(path) as part:
        np.savez(
            part,
            touched=np.array([c.touched for c in collected]),
            untouched=np.array([c.untouched for c in collected]),
            xy=np.array([(c.x, c.y) for c in collected]),
            pattern=np.asarray(pattern),
        )
    if any(c.force_n is None for c in collected):
        return None
    beside = path.with_suffix(".csv")
    rows = [f"{c.force_n:g},{k}" for k, c in enumerate(collected)]
    write_whole(beside, "force_n,row\n" + "\n".join(rows) + "\n")
    return beside
