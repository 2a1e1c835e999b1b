"""Where touches are, by the likelihood of a measured response map (numpy only).

`skin register` measures what a press at each place does to the K measurements, the map R(x), and how far a press is
from it, a covariance C. A difference d is then a R(x) + e with e ~ N(0, C) and an amplitude a that nobody knows:

    log p(d | x) = b(x)^2 / (2 (q(x) + 1/s^2)) - log(q(x) + 1/s^2) / 2,    q = R^T C^-1 R,  b = R^T C^-1 d + 1/s^2

with a ~ N(1, s^2), 1 being the mean press of the registration. The touch is at the posterior's mean over the map's
places. Two and three touches add up: pairs are tried on every second row and column, a third beside the best pair.
Where presses enough were there, a kernel machine corrects what the likelihood gets wrong, and another says how deep,
or how hard, a press is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.locator_arrays import FEWEST_LIVE, QUANTITIES, LocatorArrays

Array = npt.NDArray[np.floating]

MOST_TOUCHES = 3
AMPLITUDE_SIGMA = 1.0
LEAST_AMPLITUDE = 0.15  # of the strongest touch: less is what the map is wrong by
LEAST_LOUD = 1e-3  # amplitude below which its logarithm says no more
NINETY = 4.605  # squared radius, in standard deviations, of the ellipse that holds 90 % of a normal distribution


@dataclass(frozen=True)
class Located:
    """One touch. `value`: how deep [m] or how hard [N], as the skin was registered; None where it was not."""

    x: float  # m, in the skin's frame
    y: float
    covariance: Array  # (2, 2) m^2
    amplitude: float  # of the registration's mean press
    value: float | None = None
    value_sigma: float | None = None

    @property
    def sigma(self) -> list[float]:
        """Standard uncertainty along the longest and the shortest axis [m], angle of the longest to x [rad]."""
        values, vectors = np.linalg.eigh(self.covariance)
        short, long = np.sqrt(np.maximum(values, 0.0)).tolist()
        angle = float(np.arctan2(vectors[1, 1], vectors[0, 1]))
        return [long, short, float((angle + np.pi / 2) % np.pi - np.pi / 2)]  # an axis has no direction


@dataclass(frozen=True)
class Likely:
    """What the likelihood says of a single touch."""

    place: Array  # (2,) m
    covariance: Array  # (2, 2) m^2
    best: int  # the most probable place
    amplitude: float  # there
    misfit: float  # mean square of the whitened residual there


class WhitenedMap:
    """The map for one noise and one set of live measurements, whitened."""

    def __init__(self, arrays: LocatorArrays, live: npt.NDArray[np.bool_], extra: Array) -> None:
        a = arrays
        covariance = a.error[np.ix_(live, live)].astype(float) + np.diag(extra[live])
        self.live = live
        self.colour = np.linalg.cholesky(covariance)
        self.whiten = np.linalg.inv(self.colour)
        self.r = np.asarray(a.map[:, live].astype(float) @ self.whiten.T)  # (P, K')
        self.q = (self.r**2).sum(axis=1) + 1e-30
        rows, columns = (int(n) for n in a.shape)
        grid = np.full(rows * columns, -1)
        grid[a.allowed] = np.arange(int(a.allowed.sum()))
        few = grid.reshape(rows, columns)[::2, ::2].ravel()
        self.few = few[few >= 0]
        gram = self.r[self.few] @ self.r[self.few].T
        self.first, self.second = np.triu_indices(len(self.few), 1)
        q = self.q[self.few]
        determinant = q[self.first] * q[self.second] - gram[self.first, self.second] ** 2
        apart = determinant > 0.02 * q[self.first] * q[self.second]
        self.first, self.second, self.determinant = self.first[apart], self.second[apart], determinant[apart]
        self.between = gram[self.first, self.second]


class Locator:
    """Touches of a difference (K,)."""

    def __init__(self, arrays: LocatorArrays) -> None:
        self.a = arrays
        iy, ix = np.divmod(np.flatnonzero(arrays.allowed), int(arrays.shape[1]))
        self.places = arrays.corner + float(arrays.spacing) * np.stack([ix, iy], axis=1)
        self._conditioned: dict[bytes, WhitenedMap] = {}  # the one of the newest noise
        self._trained = WhitenedMap(arrays, np.asarray(arrays.measured), np.zeros(len(arrays.noise)))
        self._place, self._press = arrays.machine("place"), arrays.machine("press")
        self.quantity = QUANTITIES[int(arrays.quantity)]

    def condition(self, sigma: Array) -> WhitenedMap | None:
        """For a frame that states this noise (K,), infinite where not measured; None where too little is left."""
        live = self.a.measured & np.isfinite(sigma)
        if live.sum() < FEWEST_LIVE:
            return None
        extra = np.where(live, np.maximum(np.where(live, sigma, 0.0) ** 2 - self.a.noise**2, 0.0), 0.0)
        if (live == self.a.measured).all() and not extra.any():
            return self._trained
        key = live.tobytes() + extra.tobytes()
        if key not in self._conditioned:
            self._conditioned = {key: WhitenedMap(self.a, live, extra)}
        return self._conditioned[key]

    def locate(self, difference: Array, sigma: Array) -> list[Located]:
        """The touches that explain a difference (K,), strongest first; [] where none does."""
        d = np.asarray(difference, float)
        now = self.condition(np.asarray(sigma, float))
        if now is None or not np.isfinite(d[now.live]).all():
            return []
        z = now.whiten @ d[now.live]
        chosen = self.places_of(now, z)
        if not len(chosen):
            return []
        amplitudes = _amplitudes(now, z, chosen)
        found = []
        for n in range(len(chosen)):
            others = np.delete(np.arange(len(chosen)), n)
            own = z - amplitudes[others] @ now.r[chosen[others]]
            found.append(self._single(now, own, len(chosen)))
        return sorted((touch for touch in found if touch is not None), key=lambda touch: -touch.amplitude)

    def _single(self, now: WhitenedMap, z: Array, touches: int) -> Located | None:
        """The one touch that explains a whitened difference; touches: how many there are in all."""
        seen = self.seen(now, z)
        if seen is None:
            return None
        place, features = seen.place, self.features(now, z, seen)
        if self._place is not None:
            place = place + self._place(features[:-1])[0]
        value, value_sigma = None, None
        if self._press is not None:
            mean, sigma = self._press(features)
            value, value_sigma = max(float(mean[0]), 0.0), float(sigma[0]) * touches
        whole = uncertain(seen.covariance, self.a.spread, doubt(seen, float(self.a.misfit)))
        return Located(float(place[0]), float(place[1]), whole, seen.amplitude, value, value_sigma)

    def seen(self, now: WhitenedMap, z: Array) -> Likely | None:
        """What the likelihood alone says of a single touch."""
        weight = posterior(now, z)
        if weight is None:
            return None
        place = weight @ self.places
        apart = self.places - place
        best = int(weight.argmax())
        amplitude = max(float(now.r[best] @ z) / float(now.q[best]), 0.0)
        misfit = float(((z - amplitude * now.r[best]) ** 2).mean())
        return Likely(place, (weight[:, None] * apart).T @ apart, best, amplitude, misfit)

    def features(self, now: WhitenedMap, z: Array, seen: Likely) -> Array:
        """What the kernel machines read: the form of the whole whitened difference, the place, log of the amplitude.

        What is not measured now is what the measured part leads to expect (the conditional mean).
        """
        trained = self._trained
        if now is trained:
            whole = z
        else:
            left = now.whiten.T @ (z - seen.amplitude * now.r[seen.best])  # C'^-1 of the residual
            d = seen.amplitude * self.a.map[seen.best] + self.a.error[:, now.live] @ left
            d[now.live] = now.colour @ z
            whole = trained.whiten @ d[trained.live]
        form = (unit(whole) - self.a.middle) @ self.a.rotation
        at = (seen.place - self.a.reach[1:]) * self.a.reach[0]
        return np.concatenate([form, at, [float(self.a.loudness) * np.log(max(seen.amplitude, LEAST_LOUD))]])

    def places_of(self, now: WhitenedMap, z: Array) -> npt.NDArray[np.intp]:
        """Indices of the places of one, two or three touches; [] where nothing is explained."""
        b = now.r @ z
        gain = np.where(b > 0, b * b, 0.0) / now.q
        best = int(gain.argmax())
        if gain[best] <= 0:
            return np.zeros(0, np.intp)
        total, chosen = float(z @ z), np.array([best])
        explained = float(gain[best])
        amplitude = float(b[best] / now.q[best])
        usual = float(self.a.misfit) * len(z) * max(1.0, amplitude**2)
        for needed in self.a.more[: MOST_TOUCHES - 1]:
            if total - explained < 0.5 * usual:
                break
            more, whole = second_of(now, b) if len(chosen) == 1 else one_more(now, z, chosen)
            if not len(more) or share(total, explained, whole, len(z)) < needed:
                break
            chosen, explained = more, whole
        return chosen


def doubt(seen: Likely, usual: float) -> float:
    """How many times more a press leaves unexplained than others do, 1 at least; stronger ones may leave more."""
    return max(1.0, seen.misfit / (usual * max(1.0, seen.amplitude**2)))


def uncertain(covariance: Array, spread: Array, doubts: npt.ArrayLike) -> Array:
    """(..., 2, 2) m^2 of posteriors' covariances and doubts (...). A press that the map does not explain is likely to
    be where it knows little, between presses or beyond them.
    """
    factor, floor, gap = (float(v) for v in spread)
    times = np.asarray(doubts, float)[..., None, None]
    return np.asarray(times * (factor * covariance + floor * np.eye(2)) + (times - 1.0) * gap * np.eye(2))


def posterior(now: WhitenedMap, z: Array) -> Array | None:
    """(P,) probability of each place, for one touch of unknown amplitude; None where nothing is explained."""
    b, q = now.r @ z + AMPLITUDE_SIGMA**-2, now.q + AMPLITUDE_SIGMA**-2
    log = np.where(b > 0, 0.5 * b * b / q - 0.5 * np.log(q), -np.inf)
    top = log.max()
    if not np.isfinite(top):
        return None
    weight = np.exp(log - top)
    return np.asarray(weight / weight.sum())


def share(total: float, before: float, after: float, k: int) -> float:
    """What one more touch explains beside what stays unexplained then (an F statistic, but for its degrees)."""
    return (after - before) / max(total - after, 0.1 * k)


def second_of(now: WhitenedMap, b: Array) -> tuple[npt.NDArray[np.intp], float]:
    """The pair that explains most, and how much; b: R^T C^-1 d at all places."""
    i, j = now.first, now.second
    few, q = b[now.few], now.q[now.few]
    bi, bj, qi, qj = few[i], few[j], q[i], q[j]
    ai, aj = bi * qj - bj * now.between, bj * qi - bi * now.between
    least = LEAST_AMPLITUDE * np.maximum(ai, aj)
    gain = np.where((ai > least) & (aj > least), (bi * ai + bj * aj) / now.determinant, 0.0)
    if not gain.size or gain.max() <= 0:
        return np.zeros(0, np.intp), 0.0
    best = int(gain.argmax())
    return now.few[[i[best], j[best]]], float(gain[best])


def one_more(now: WhitenedMap, z: Array, chosen: npt.NDArray[np.intp]) -> tuple[npt.NDArray[np.intp], float]:
    """The place that explains most beside those chosen, each of which may then move once; and what all explain."""
    places = np.append(chosen, -1)
    for turn in (len(chosen), *range(len(chosen))):
        others = np.delete(places, turn)
        basis, _ = np.linalg.qr(now.r[others].T)
        left = z - basis @ (basis.T @ z)
        across = now.r @ basis
        b, q = now.r @ left, now.q - (across**2).sum(axis=1)
        gain = np.where((b > 0) & (q > 0.02 * now.q), b * b / np.maximum(q, 1e-30), 0.0)
        places[turn] = int(gain.argmax())
    amplitudes = _amplitudes(now, z, places)
    if (amplitudes < LEAST_AMPLITUDE * amplitudes.max()).any():
        return np.zeros(0, np.intp), 0.0
    return places, float(amplitudes @ (now.r[places] @ z))


def _amplitudes(now: WhitenedMap, z: Array, chosen: npt.NDArray[np.intp]) -> Array:
    r = now.r[chosen]
    return np.linalg.lstsq(r.T, z, rcond=None)[0]


def unit(whitened: Array) -> Array:
    """Whitened differences (..., K) of unit length: their form, whatever the amplitude."""
    return np.asarray(whitened / np.maximum(np.linalg.norm(whitened, axis=-1, keepdims=True), 1e-30))
