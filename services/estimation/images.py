"""Which scans of a touch are reconstructed, from the mean of how many, and by which operator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np

from models.bundle import Bundle
from models.measurement.arrays import Array, Mask, Single
from models.measurement.numbers import TINY
from models.prereconstruction import Drift, Operator, PreReconstructor
from services.estimation.values.numbers import LEAST_LIVE
from services.estimation.values.state import loaded

Key = TypeVar("Key")
Made = TypeVar("Made")

CHANGED = 1e-3  # probability that an unchanged touch is reconstructed again: costs work, not truth
LONGEST_MEAN = 16  # frames that are averaged at most, and after which a touch is reconstructed again at the latest
MEANS = tuple(1 << k for k in range(LONGEST_MEAN.bit_length()))  # frames in what is reconstructed of a touch
KEPT = 16  # operators, and matrices of noises of frames; 0.4 and 0.3 MB each
SUREST = 1e-4  # relative: below it the model is what a mean is wrong by, and that does not average out
DRIFTS_S = 0.25  # of the drift that skin.toml allows: what is left of it beside a touch
FEWEST = 2  # finite measurements without which there is nothing to reconstruct


def sigma_of_mean(sigma: Single, n: int) -> Single:
    """Of the mean of n frames, of `sigma` (K,) each: to the last bit what the frames of a touch that is held state."""
    return np.asarray(sigma / np.sqrt(n), np.float32)


def cached(made: dict[Key, Made], key: Key, make: Callable[[], Made]) -> Made:
    """What was made for a key, of which the newest KEPT are held; made where it is not there."""
    if key not in made:
        if len(made) >= KEPT:
            del made[next(iter(made))]
        made[key] = make()
    return made[key]


class Operators:
    """Of one skin. Each is made once, which takes 10 ms."""

    def __init__(self, pre: PreReconstructor, scale_per_s: float, contact_per_s: float) -> None:
        """How fast an untouched skin may change, relative: its conductivity, and each electrode's contact impedance."""
        self._pre, self._drift = pre, Drift(scale_per_s * DRIFTS_S, contact_per_s * DRIFTS_S)
        self._made: dict[tuple[bytes, int, int], Operator | None] = {}

    def __call__(self, sigma: Single, averaged: int, tare_frames: int) -> Operator | None:
        """For the mean of so many scans, whose standard deviation is sigma (K,), infinite where a measurement does not
        count, against the mean of `tare_frames`. None where too few count.
        """
        key = sigma.tobytes(), averaged, tare_frames
        return cached(self._made, key, lambda: self._make(sigma.astype(float), averaged, tare_frames))

    def prepare(self, sigma: Single, averaged: int, tare_frames: int) -> bool:
        """Make that one; False: it is there, or there is none."""
        there = (sigma.tobytes(), averaged, tare_frames) in self._made
        return not there and self(sigma, averaged, tare_frames) is not None

    def _make(self, sigma: Array, averaged: int, tare_frames: int) -> Operator | None:
        live = np.isfinite(sigma)
        if live.sum() < FEWEST:
            return None
        single = sigma * np.sqrt(averaged)
        most = int((float(np.median(single[live])) / SUREST) ** 2)  # as far as noise is what a mean is wrong by
        counted = min(averaged, max(1, most))
        return self._pre.condition(
            np.where(live, single / np.sqrt(counted), np.inf),
            drift=self._drift,
            weights=live.astype(float),
            tare_frames=max(1, tare_frames // counted),
        )


class Reconstructed(NamedTuple):
    """What an image is to be made of."""

    difference: Array  # (K,) mean
    averaged: int  # scans


@dataclass
class HeldTouch:
    """All that changes of how one touch is reconstructed."""

    live: Annotated[Mask | None, "K"] = None  # measurements that count in the mean
    reference: Annotated[Array | None, "K"] = None  # the difference last reconstructed
    averaged: int = 0  # frames in it
    recent: list[Annotated[Array, "K"]] = field(default_factory=list)  # the newest frames since it last changed
    count: int = 0  # frames since it last changed
    scan: int = 0  # number of the one last reconstructed; 0: none yet of this touch


class Reconstruction:
    """Of one skin, against one baseline: which frames of a touch are reconstructed, and from what: those since it last
    changed, by the whitened energy of an image's operator. The limit allows for the noise having been estimated from
    few scans.

    While nothing changes against the frame last reconstructed (not the previous frame: creep must be seen), frames are
    averaged, and their mean is reconstructed after 2, 4, 8, 16, 32, 48 ... of them.
    """

    def __init__(self, operators: Operators) -> None:
        self._operators = operators
        self.begin(np.zeros(0), 0)

    def begin(self, sigma: Array, frames: int) -> None:
        """Another baseline, the mean of so many frames; sigma (K,): noise of the difference to it."""
        self.sigma, self.frames = sigma, frames
        self.reset()

    def reset(self) -> None:
        """Nothing touches."""
        self.now = HeldTouch()

    def __call__(self, d: Array, sigma: Single, scan: int) -> Reconstructed | None:
        """Of a scan's difference and its standard deviation (K,), infinite where a measurement does not count. None:
        nothing changed, the image last made is held, or too few count for one.
        """
        operator = self._operators(sigma, 1, self.frames)
        if operator is None:
            self.reset()
            return None
        live = np.isfinite(sigma)
        if self.now.live is None or (live != self.now.live).any():  # frames of other measurements make another image
            self.now = HeldTouch(live)
        now = self.now
        if now.reference is not None:
            variance = 1 + 1 / now.averaged  # of the change, in units of one frame's
            if operator.score(d - now.reference) > variance * operator.threshold(CHANGED, self.frames):
                now.recent, now.count = [], 0
        now.recent = [*now.recent[1 - LONGEST_MEAN :], d]
        now.count += 1
        if now.reference is not None and now.count not in MEANS and now.count % LONGEST_MEAN:
            return None
        now.reference = np.mean(now.recent, axis=0)
        now.averaged, now.scan = len(now.recent), scan
        return Reconstructed(now.reference, now.averaged)

    def prepare(self) -> bool:
        """Make the operator that the next touch needs first; False: it is there."""
        return self._operators.prepare(self.sigma.astype(np.float32), 1, self.frames)

    def load(self, state: Any) -> None:
        """Raises ValueError where it does not fit."""
        self.now = loaded(HeldTouch, state, {"K": len(self.sigma)})
        if self.now.scan < 0 or (self.now.reference is not None and self.now.averaged < 1):
            raise ValueError(f"a hold of {self.now.averaged} frames since scan {self.now.scan}: expected 1, from 0 on")


MOST_DROP = 0.97  # S/m: a contact never cuts the sheet through
DRIFT = Drift(scale=2e-3, contact=1e-2)  # a change that drift of this size explains is not held against the image
CHANCE = 4.0  # standard deviations of chi-square that the noise may come to
REFUSED = 0.5  # share not explained from which an image is none of a touch
FAINT = 100.0  # energy over the noise's below which it is refused from REFUSED_FAINT on:
REFUSED_FAINT = 0.15  # of a faint touch noise hides what the image gets wrong, of a faint anything-else it does not


class Conditioned(NamedTuple):
    """For one noise of the frames."""

    whiten: Single  # (K, K)
    forward: Single  # (K, h * w), whitened
    noise: float  # the energy that noise may leave


class Residual:
    """For one bundle and image size. Conditioned once for each noise of frames: those of a held touch are of MEANS."""

    def __init__(self, bundle: Bundle, to_scale: bool) -> None:
        """to_scale: images are in S/m; else only their form counts, not their size."""
        self.pre, self.to_scale = bundle.prereconstructor(), to_scale
        self.shape: tuple[int, int] = bundle.matrices.inside.shape
        self.refused = False  # whether the last image that was given a share is of no touch
        self._known: dict[bytes, Conditioned | None] = {}

    def __call__(self, difference: Single, sigma: Single, image: Single) -> float | None:
        """(K,) difference and its standard deviation (infinite: not used), drop (n, n) [S/m] -> the share not
        explained: 0 up to 1, or beyond where the image makes it worse; None where it cannot be told.
        """
        h, w = self.shape
        if image.ndim != 2 or not image.size or image.shape[0] % h or image.shape[1] % w:
            return None
        if len(difference) != self.pre.measurements or (known := self._conditioned(sigma)) is None:
            return None
        y = np.clip(image, np.float32(0.0), np.float32(MOST_DROP))
        if self.to_scale:
            y = -np.log(1 - y)
        down, across = _means(h, w, *image.shape)
        coarse = (down @ y @ across).ravel()
        seen, expected = known.whiten @ difference, known.forward @ coarse
        if not self.to_scale:
            expected *= max(0.0, float(expected @ seen)) / max(float(expected @ expected), TINY)
        left = seen - expected
        beyond = float(left @ left) - known.noise
        energy = max(float(seen @ seen), known.noise)
        share = max(0.0, beyond) / energy
        self.refused = not share <= (REFUSED if energy > FAINT * known.noise else REFUSED_FAINT)
        return share if np.isfinite(share) else None

    def prepare(self, sigma: Single) -> bool:
        """Condition (10 ms) for one noise of a touch whose single frames have this one (K,); False: none is left."""
        if len(sigma) != self.pre.measurements:
            return False
        for n in MEANS:
            of_mean = sigma_of_mean(sigma, n)
            if of_mean.tobytes() not in self._known:
                self._conditioned(of_mean)
                return True
        return False

    def _conditioned(self, sigma: Single) -> Conditioned | None:
        return cached(self._known, sigma.tobytes(), lambda: self._condition(sigma))

    def _condition(self, sigma: Single) -> Conditioned | None:
        """None where too few measurements count."""
        live = np.isfinite(sigma)
        if live.mean() < LEAST_LIVE:
            return None
        operator = self.pre.condition(sigma.astype(float), drift=DRIFT, weights=live.astype(float))
        count = int(live.sum())
        return Conditioned(
            whiten=np.ascontiguousarray(operator.whiten, dtype=np.float32),
            forward=np.ascontiguousarray(operator.whiten @ operator.jacobian, dtype=np.float32),
            noise=count + CHANCE * float(np.sqrt(2 * count)),
        )


@cache
def _means(h: int, w: int, rows: int, columns: int) -> tuple[Single, Single]:
    """(h, rows) and (columns, w): the mean over the pixels of each coarse one (a product is faster than `mean`)."""
    down = np.repeat(np.eye(h, dtype=np.float32), rows // h, axis=1) * np.float32(h / rows)
    across = np.repeat(np.eye(w, dtype=np.float32), columns // w, axis=0) * np.float32(w / columns)
    return np.ascontiguousarray(down), np.ascontiguousarray(across)
