"""A covariance as what is needed of it: one factor, by which everything of a frame is whitened once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from models.measurement.arrays import Array, Mask
from models.measurement.numbers import LEFT_OUT


@dataclass(frozen=True)
class Whitening:
    """W (K, K), lower triangular, with W S W^T = 1; log_density: of a frame at the mean, up to a constant."""

    w: Array
    log_density: float

    @classmethod
    def of(cls, covariance: Array) -> Whitening:
        """Raises ValueError where it is not positive."""
        root, info = lapack.dpotrf(covariance.T, lower=1, clean=1)  # transposed: laid out as LAPACK takes it
        if info:
            raise ValueError(f"a covariance that is none: its minor {info} is not positive")
        w, _ = lapack.dtrtri(root, lower=1, overwrite_c=1)
        return cls(w, float(np.log(np.diag(w)).sum()))

    def __call__(self, values: Array) -> Array:
        """(K, ...) whitened."""
        return np.asarray(self.w @ values)

    def solve(self, values: Array) -> Array:
        """S^-1 times (K, ...)."""
        return np.asarray(self.w.T @ (self.w @ values))

    def log_likelihood(self, values: Array) -> float:
        """Of (K,) values over the mean, up to a constant."""
        whitened = self(values)
        return self.log_density - 0.5 * float(whitened @ whitened)

    def conditional_precisions(self) -> Array:
        """(K,) of each measurement given all others: the diagonal of S^-1."""
        return np.asarray((self.w**2).sum(axis=0))


def leave_out(covariance: Array, live: Mask) -> None:
    """Give measurements that do not count no weight; covariance (K, K) is changed."""
    dead = np.flatnonzero(~live)
    covariance[dead, dead] += LEFT_OUT
