"""Pre-reconstruction: from a normalised difference to the stack of images the network reads (numpy only).

Everything is in dual form. With J the sensitivity of the K measurements to the conductivity *drop* and R the NOSER
prior of the untouched skin, a bundle ships B = R^-1 J^T at the network's resolution and the Gram matrix A = J R^-1
J^T; then for any noise covariance C and any lambda

    x = B (A + lambda^2 C)^-1 d

is one K x K problem. That is equation 1 of the paper, (J^T W J + lambda^2 R)^-1 J^T W d with W = C^-1, by the push-
through identity. A measurement of weight zero (dead electrode) is a row and column less. `PreReconstructor.condition`
does the one eigen-decomposition that a new noise level, drift allowance or dead electrode needs; `Operator.stack` is
then a single matrix-vector product a frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]

ONE_STEP_LAMBDA = 0.15  # the paper's, section II; relative to the mean eigenvalue of the whitened Gram matrix
THRESHOLD_T = 0.35  # t of equation 5; the paper chose it by trial and does not state it, and so did we
TARE_FRAMES = 64
SHARED = 32  # frames that the noise of all measurements counts as beside each one's own
OUTLIER = 16.0  # times the median: variances beyond it do not raise the level of the others (a converter's stay below)
MODEL_ERROR = 2e-6
"""What the forward model gets wrong of d under a light touch, a drop of 0.1 S/m. Measured, training mesh against
reference mesh, root mean square: 1.4e-6 on square16, 3e-6 to 9e-6 on three others. Noise of 80 dB is 1e-4.
"""
NOTHING = 1e4  # times the median: a measurement of such noise says nothing, and its numbers would overflow


@dataclass(frozen=True)
class Drift:
    """Standard deviations of what changes on a skin that nobody touches: relative, since the tare."""

    scale: float = 0.0  # global conductivity and gain
    contact: float = 0.0  # each electrode's contact impedance, of its nominal value


@dataclass(frozen=True)
class Matrices:
    """What a bundle ships of the linearised physics. K measurements, E electrodes, P = h * w pixels, C lambdas."""

    pattern: npt.NDArray[np.integer]  # (K, 4) drive+, drive-, sense+, sense-
    z0: Array  # (K,) ohm, |Z| of the untouched skin as the forward model has it
    gram: Array  # (K, K) float64, J R^-1 J^T
    back: Array  # (P, K) B = R^-1 J^T averaged over each pixel; rows in [iy, ix] order
    jacobian: Array  # (K, P) d per S/m of drop in a pixel
    contact: Array  # (K, E) d per relative change of an electrode's contact impedance
    inside: npt.NDArray[np.bool_]  # (h, w) pixels on the skin
    ladder: Array  # (C,) lambda^2 relative to the mean eigenvalue of the whitened Gram matrix, decreasing
    level: Array  # (C,) typical magnitude of each image of the ladder, of the frame's `scale`
    scale_index: int  # the image of the ladder whose peak is the frame's `scale`
    normalisation: str  # "model": (|Z| - |Z0|) / (g z0) with g the fitted gain; "measured": |Z| / |Z0| - 1
    model_error: float = MODEL_ERROR


@dataclass
class Operator:
    """The reconstruction of one noise level, drift allowance and set of live measurements. Made by `condition`."""

    shape: tuple[int, int]
    inside: npt.NDArray[np.bool_]
    back: Array  # (h * w, K') float32: images of whitened coefficients
    gains: Array  # (C, K') what the ladder's images take of each coefficient
    one_step_gain: Array  # (K',) the same for the one-step image
    variance: Array  # (C, h * w) float32: variance of the ladder's images from noise alone
    level: Array  # (C,)
    scale_index: int
    noise: float  # rms standard deviation of d from noise and model error, live measurements
    drift: float  # rms standard deviation of d from drift
    live: float  # fraction of the measurements that count
    whiten: Array  # (K', K) noise of unit covariance, in the eigenvectors of the whitened Gram matrix
    detection: Array  # (K',) weight of each squared coefficient in the detection statistic
    jacobian: Array  # (K, P)
    _axis: dict[int, Array] = field(default_factory=dict)

    def stack(self, d: Array) -> tuple[Array, Array, float]:
        """(K,) difference -> stack (C, h, w), context (4,), scale [S/m]. Multiply the network's drop by scale."""
        stack, context, scale = self.stacks(np.asarray(d)[None])
        return stack[0], context[0], float(scale[0])

    def stacks(self, d: Array) -> tuple[Array, Array, Array]:
        """The same for a batch (N, K) -> (N, C, h, w), (N, 4), (N,); every image is divided by the frame's scale."""
        n, c, (h, w) = len(d), len(self.level), self.shape
        images, spread = self.images(d), self.variance
        # The scale is a peak, so it cannot be below what noise alone makes of the strongest pixel.
        floor = 2.0 * float(np.sqrt(spread[self.scale_index].max()))
        scale = np.maximum(images[:, self.scale_index].max(axis=1), max(floor, 1e-9))
        # Bounded whatever the noise: an image that is all noise comes out with unit variance, not with its huge values.
        images /= np.sqrt((scale[:, None] * self.level)[:, :, None] ** 2 + spread)
        log_scale = np.log10(scale)
        context = np.stack(
            [
                log_scale + 1.0,
                (np.log10(self.noise) - log_scale + 2.5) / 1.5,
                np.full(n, (np.log10(max(self.drift, 1e-7)) + 5.0) / 2.0),
                np.full(n, 10.0 * (1.0 - self.live)),
            ],
            axis=1,
        )
        return images.reshape(n, c, h, w), context.astype(np.float32), scale.astype(np.float32)

    def images(self, d: Array) -> Array:
        """(N, K) differences -> (N, C, h * w) the ladder's images [S/m], float32.

        Through the coefficients rather than by one matrix of all images: a ninth of the memory to read.
        """
        coefficients = (np.asarray(d, dtype=float) @ self.whiten.T)[:, None] * self.gains
        flat = coefficients.reshape(-1, coefficients.shape[2]).astype(np.float32)
        return (flat @ self.back.T).reshape(len(d), len(self.gains), len(self.back))

    def score(self, d: Array) -> float:
        """Detection statistic of (K,) d: its whitened energy, each direction weighted by how much a touch could
        put there.
        """
        return float(self.detection @ (self.whiten @ d) ** 2)

    def threshold(self, false_alarm: float = 1e-6, tare_frames: int = TARE_FRAMES) -> float:
        """The score that an untouched frame exceeds with probability `false_alarm`.

        The weighted sum of squares is matched by a scaled chi-square (Satterthwaite); sigma estimated from
        `tare_frames` frames makes each square an F(1, nu) variable, whose larger mean and variance are used.
        """
        nu = max(tare_frames - 1, 5)
        mean1, var1 = nu / (nu - 2), 2 * nu**2 * (nu - 1) / ((nu - 2) ** 2 * (nu - 4))
        mean, var = self.detection.sum() * mean1, (self.detection**2).sum() * var1
        factor, dof = var / (2 * mean), 2 * mean**2 / var
        quantile = NormalDist().inv_cdf(1 - false_alarm)
        return float(factor * dof * (1 - 2 / (9 * dof) + quantile * np.sqrt(2 / (9 * dof))) ** 3)  # Wilson-Hilferty

    def one_step(self, d: Array, n: int, threshold: float | None = THRESHOLD_T) -> Array:
        """(K,) -> (n, n) drop [S/m] of the paper's equations 1 to 5: one-step image, mask H(x > 0), MReLU at |t x_m|.

        threshold is t; None leaves the image as equation 1 gives it, both signs.
        """
        coefficients = self.one_step_gain * (self.whiten @ d)
        coarse = (self.back @ coefficients.astype(np.float32)).reshape(self.shape)
        image = self._upsample(n, self.shape[0]) @ coarse @ self._upsample(n, self.shape[1]).T
        if threshold is not None:
            image = np.where(image > max(threshold * image.max(initial=0.0), 0.0), image, 0.0)
        return image.astype(np.float32)

    def residual(self, d: Array, image: Array) -> float:
        """rms whitened difference between d and what the linearised model makes of a drop image (n, n) [S/m]; 1 =
        noise.

        Linear: a drop of 0.5 S/m leaves a tenth to a third of the signal unexplained, so read it against strong
        touches with care.
        """
        h, w = self.shape
        coarse = image.reshape(h, image.shape[0] // h, w, image.shape[1] // w).mean(axis=(1, 3))
        return float(np.sqrt(np.mean((self.whiten @ (d - self.jacobian @ coarse.ravel())) ** 2)))

    def _upsample(self, n: int, m: int) -> Array:
        """(n, m) linear interpolation between pixel centres."""
        if n not in self._axis:
            at = np.clip((np.arange(n) + 0.5) * m / n - 0.5, 0, m - 1)
            low = np.minimum(at.astype(int), m - 2)
            weight = np.zeros((n, m), dtype=np.float32)
            weight[np.arange(n), low], weight[np.arange(n), low + 1] = 1 - (at - low), at - low
            self._axis[n] = weight
        return self._axis[n]


class PreReconstructor:
    """The bundle's linear physics, ready to be conditioned on the noise that the tare found."""

    def __init__(self, matrices: Matrices) -> None:
        self.m = matrices
        self.measurements = len(matrices.z0)

    def normaliser(self, z0: Array) -> Array:
        """(K,) ohm by which |Z| - |Z0| is divided to give d; z0 is the measured baseline |Z0|.

        "model": the bundle's own z0 times the gain fitted to the baseline. Contact impedance adds to |Z| and |Z0|
        alike and so cancels from their difference; dividing by the measured |Z0| would let it back in.
        """
        if self.m.normalisation == "measured":
            return np.abs(z0)
        live = np.isfinite(z0) & (np.abs(z0) > 0)
        gain = float(np.median(np.abs(z0[live]) / self.m.z0[live])) if live.any() else 1.0
        return gain * self.m.z0

    def difference(self, z: Array, z0: Array) -> Array:
        """d (..., K) of |Z| (..., K) against the baseline |Z0| (K,)."""
        return (np.abs(z) - np.abs(z0)) / self.normaliser(np.abs(z0))

    def condition(
        self, sigma: Array, *, drift: Drift | None = None, weights: Array | None = None, tare_frames: int = TARE_FRAMES
    ) -> Operator:
        """Operator for noise of standard deviation sigma (K,) in d on each frame.

        drift: allowance since the last untouched frame. weights: (K,), 1 = as measured, 0 = leave out (dead
        electrode), between = trust less. tare_frames: how many frames the baseline is the mean of (its own error adds
        to every difference).
        """
        m, k = self.m, self.measurements
        weights = np.ones(k) if weights is None else np.asarray(weights, dtype=float)
        sigma = np.asarray(sigma, dtype=float)
        live = (weights > 0) & np.isfinite(sigma)
        if live.any():
            live &= sigma <= NOTHING * max(float(np.median(sigma[live])), m.model_error)
        if live.sum() < 2:
            raise ValueError(f"only {int(live.sum())} of {k} measurements are live: nothing can be reconstructed")
        noise = (sigma[live] ** 2 * (1 + 1 / tare_frames) + m.model_error**2) / weights[live]
        typical = float(np.minimum(noise, OUTLIER * np.median(noise)).mean())  # one noisy channel is no noisy frame
        cov = np.diag(noise)
        drift = drift or Drift()
        if drift.scale or drift.contact:
            contact = m.contact[live]
            cov += drift.scale**2 + drift.contact**2 * contact @ contact.T
        inverse = np.linalg.inv(np.linalg.cholesky(cov))
        gram = inverse @ m.gram[np.ix_(live, live)] @ inverse.T
        values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
        values = np.maximum(values, 0.0)
        whiten = np.zeros((int(live.sum()), k))
        whiten[:, live] = vectors.T @ inverse
        # The images are well conditioned: single precision does, and half the time.
        back = (m.back[:, live] @ whiten[:, live].T).astype(np.float32)  # (P, K')
        # The ladder is relative to measurement noise of the same size in every channel, so that its images stay the
        # same combinations of d whatever the level; drift and unequal noise change the metric, not the rungs.
        mean = float(np.trace(m.gram[np.ix_(live, live)]) / live.sum() / typical)
        gains = 1.0 / (values + m.ladder[:, None] * mean)
        return Operator(
            shape=(m.inside.shape[0], m.inside.shape[1]),
            inside=m.inside,
            back=back,
            gains=gains,
            one_step_gain=1.0 / (values + ONE_STEP_LAMBDA**2 * mean),
            variance=(gains**2).astype(np.float32) @ (back**2).T,
            level=m.level.astype(np.float32),
            scale_index=m.scale_index,
            noise=float(np.sqrt(typical)),
            drift=float(np.sqrt(np.trace(cov) / len(cov) - noise.mean())) if (drift.scale or drift.contact) else 0.0,
            live=float(live.mean()),
            whiten=whiten,
            detection=values / (values + mean * 1e-3),
            jacobian=m.jacobian,
        )


def noise_of_frames(frames: Array, z0: Array) -> Array:
    """(K,) sigma of |Z| [unit of frames] from (N, K) untouched |Z|: per channel, shrunk towards noise proportional to
    |Z0|.

    With N frames a channel's own estimate is uncertain by 1 / sqrt(2 N); the shrinkage keeps one channel's lucky tare
    from being trusted too much.
    """
    own = frames.var(axis=0, ddof=1)
    return np.asarray(np.sqrt(shrunk(own, np.median(own / z0**2) * z0**2, len(frames))))


def shrunk(own: Array, pooled: Array | float, frames: int) -> Array:
    """(K,) variances that so many frames tell of each measurement, shrunk towards that of all, which counts as much as
    SHARED frames do.
    """
    return np.asarray((frames * own + SHARED * pooled) / (frames + SHARED))
