"""The sentinel list at run time: judging its scans, and what they alone say of a touch. models/sentinel.py chose it.

Three judges look at it, each with the largest matched filter of all touches of a grid as its statistic:

- `Watch` (acquisition) holds each scan, and the mean of the last few, against the mean of the skin's own last second. A
  *hit* (at most once a minute on an untouched skin) ends the idling; a *suspicion* (every two seconds) merely has the
  next full scan made at once, so that what is too light for a hit is not seen later than by full scans.
- `Coarse` (preprocessing) holds what was forwarded against the baseline, as strictly as full frames are judged: only
  that makes a contact, which is marked `coarse`.
- `CoarseImage` (inference) gives the mean and the standard deviation of the drop over all touches that the few
  measurements allow.
"""

from __future__ import annotations

from collections import deque
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from models import sentinel as designs
from models.bundle import Bundle
from models.prereconstruction import noise_of_frames
from models.sentinel import Sentinel
from protocol.frames import DeltaFrame, RawFrame
from services.estimation.plausibility import impossible

Array = NDArray[np.floating]

WINDOWS = (1, 4)  # scans whose mean is judged
SUSPICIONS_HZ = 0.5
BLOCK_S = 0.2  # the reference is a mean of so long
BLOCKS = 5
WIDER = 1.03  # noise is estimated from a few dozen scans: one more part in thirty of it
DRIFT = 1e-4  # relative, of the baseline since the last full scan
EXPLAINED = 0.5  # share of the whitened difference that one touch must explain to be called one
BETWEEN = 0.35  # of a drop: sizes between RADII are told from none of them, and strong touches are not linear
DROPS = 0.05, 0.6  # S/m, of touches that are likely
FALL_OFF = 0.15  # of the logarithm
LINEAR = 0.1  # of d: by so much the linear picture of a touch on a grid may be wrong


_designs: dict[str, Sentinel] = {}  # by the bundle's hash


def sentinel_of(bundle: Bundle) -> Sentinel:
    """The list of a bundle: computed once in a process, the same in every process."""
    if bundle.hash not in _designs:
        _designs[bundle.hash] = designs.design(bundle.matrices, half_width=bundle.half_width)
    return _designs[bundle.hash]


class SentinelVerdict(Enum):
    QUIET = 0
    SUSPECT = 1
    HIT = 2


class SentinelDetector:
    """Judges the amplitudes |z| (n,) of sentinel scans."""

    def __init__(self, sentinel: Sentinel) -> None:
        self.sentinel = sentinel
        directions = sentinel.filters(np.ones(len(sentinel.rows)))
        per_scan = sentinel.seconds / len(WINDOWS)
        self.hit = designs.threshold(directions, designs.FALSE_ALARMS_HZ / 2 * per_scan)  # half: there is drift too
        self.suspect = designs.threshold(directions, SUSPICIONS_HZ * per_scan)
        self._recent = np.zeros((max(WINDOWS), len(sentinel.rows)), np.float32)  # a ring
        self._judged = 0  # scans since the ring was empty
        self.score, self.window = 0.0, 1  # of the scan judged last: the statistic, and the scans it is the mean of

    def begin(self, frames: Array) -> None:
        """From untouched scans (R, n) of the same measurements: what the coming ones are held against."""
        self._reference = frames.mean(axis=0)
        self.sigma = WIDER * noise_of_frames(frames, self._reference) / self._reference
        self._filters = {
            window: self.sentinel.filters(self.sigma * np.sqrt(1 / window + 1 / len(frames))).astype(np.float32)
            for window in WINDOWS
        }
        self._blocks: deque[Array] = deque([self._reference] * BLOCKS, maxlen=BLOCKS)
        self._sum, self._count = np.zeros_like(self._reference), 0
        self._judged = 0

    def begin_again(self) -> None:
        """The scan to come follows none: only the reference stays."""
        self._judged = 0

    def __call__(self, amplitude: Array) -> SentinelVerdict:
        size = len(self._recent)
        self._recent[self._judged % size] = amplitude / self._reference - 1
        self._judged += 1
        self.score = 0.0
        for window, filters in self._filters.items():
            if self._judged >= window:
                last = np.arange(self._judged - window, self._judged) % size
                score = float((filters @ self._recent[last].mean(axis=0)).max())
                if score > self.score:
                    self.score, self.window = score, window
        if self.score > self.hit:
            return SentinelVerdict.HIT
        self._follow(amplitude)
        return SentinelVerdict.SUSPECT if self.score > self.suspect else SentinelVerdict.QUIET

    def _follow(self, amplitude: Array) -> None:
        self._sum += amplitude
        self._count += 1
        if self._count * self.sentinel.seconds >= BLOCK_S:
            self._blocks.append(self._sum / self._count)
            self._sum, self._count = np.zeros_like(amplitude), 0
            self._reference = np.mean(self._blocks, axis=0)


class Coarse:
    """Judges forwarded sentinel scans against the baseline, as strictly as full ones.

    config: id of the short list on the board; false_alarms: allowed probability per scan.
    """

    def __init__(self, bundle: Bundle, config: int, false_alarms: float) -> None:
        self.sentinel, self._config = sentinel_of(bundle), config
        rows = self.sentinel.rows
        listed = bundle.pattern[rows]
        self._pairs = (listed[:, :2] == listed[:, 2:]).all(axis=1) & self.sentinel.signed
        self.threshold = designs.threshold(self.sentinel.filters(np.ones(len(rows))), false_alarms)

    def fits(self, frame: RawFrame) -> bool:
        """Whether these are measurements of this list, all of them sound."""
        listed = frame.config == self._config and len(frame.z) == len(self.sentinel.rows)
        return listed and not frame.status.any() and bool(np.isfinite(frame.z).all())

    def __call__(
        self, out: DeltaFrame, frame: RawFrame, z0: Array, normaliser: Array, sigma: Array, before: int
    ) -> int:
        """Fill in `out`: touched or not, and the difference where it was measured.

        z0, normaliser [ohm], sigma of the difference to this baseline: (K,). before: scan of the coarse touch that no
        full scan has answered yet, or 0. Returns the same for the frames to come.
        """
        rows = self.sentinel.rows
        d = (np.abs(frame.z) - z0[rows]) / normaliser[rows]
        noise = WIDER * np.hypot(sigma[rows], DRIFT)
        out.score, out.threshold = float((self.sentinel.filters(noise) @ d).max()), self.threshold
        if not out.score > self.threshold:
            out.touched = out.held = before > 0
            out.reconstructed = before
            return before
        if impossible(d, noise, self._pairs, touched=True) or not self._explained(d, noise):
            out.valid = False
            out.reasons.append("out_of_distribution")
            return 0
        out.difference[rows], out.sigma[rows] = d, noise
        out.touched, out.reconstructed = True, out.scan
        return out.scan

    def _explained(self, d: Array, noise: Array) -> bool:
        """Whether one touch explains most of the difference: a fault of an electrode does not look like one."""
        noise = _with_misfit(d, noise)
        score = float((self.sentinel.filters(noise) @ d).max())
        return score**2 > EXPLAINED * float(((d / noise) ** 2).sum())


class CoarseImage:
    """Image and its standard deviation [S/m] from the few measurements that a delta frame says it has."""

    def __init__(self, bundle: Bundle) -> None:
        self.sentinel, self.n = sentinel_of(bundle), bundle.image_size
        touches = self.sentinel.touches
        _, which, count = np.unique(touches.radius, return_inverse=True, return_counts=True)
        self._prior = 1.0 / count[which]  # each radius alike, each position alike
        self._shape = bundle.matrices.inside.shape

    def run(self, frame: DeltaFrame) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        rows = self.sentinel.rows
        mean, variance = self.moments(frame.difference[rows].astype(float), frame.sigma[rows].astype(float))
        fine = self.n // self._shape[0]
        image, sigma = (np.kron(v.reshape(self._shape), np.ones((fine, fine))) for v in (mean, np.sqrt(variance)))
        return image.astype(np.float32), sigma.astype(np.float32), np.zeros((0, 0, 0), np.float32)

    def moments(self, d: Array, sigma: Array) -> tuple[Array, Array]:
        """(n,) difference and noise -> mean and variance of the drop in each pixel (P,)."""
        touches = self.sentinel.touches
        noise = _with_misfit(d, sigma)
        whitened = touches.response[:, self.sentinel.rows] / noise
        size = np.maximum(np.linalg.norm(whitened, axis=1), 1e-12)
        z = whitened @ (d / noise) / size
        if not self.sentinel.signed:
            z = np.abs(z)
        drop = np.maximum(z / size, 1e-6)
        # The drop is marginalised under a prior that is even in its logarithm and falls off outside DROPS.
        beyond = np.maximum(np.log(DROPS[0] / drop), np.log(drop / DROPS[1])).clip(0.0) / FALL_OFF
        log = np.where(z > 0, 0.5 * z**2, 0.0) + np.log(self._prior / (size * drop)) - 0.5 * beyond**2
        drop = np.minimum(drop, 0.99)
        p = np.exp(log - log.max())
        p /= p.sum()
        mean = (p * drop) @ touches.coverage
        square = (p * (drop**2 + size**-2)) @ touches.coverage**2
        return mean, np.maximum(square - mean**2, 0.0) + (BETWEEN * mean) ** 2


def _with_misfit(d: Array, sigma: Array) -> Array:
    """Standard deviation of d (n,) against the linear picture of a touch on a grid position."""
    return np.asarray(np.sqrt(sigma**2 + (LINEAR * d) ** 2 + (LINEAR / 2) ** 2 * (d**2).mean()))
