"""A skin's linear physics as the estimation needs it: what drift, touches and mismatch do to a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Matrices
from models.touch_grid import touches
from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SkinPhysics:
    """K measurements between E electrodes, M touches on a grid. d is relative to z0 (times a gain)."""

    pattern: NDArray[np.int64]  # (K, 4) drive+, drive-, sense+, sense-
    z0: Array  # (K,) ohm, |Z| of the untouched skin as the bundle predicts it
    contact: Array  # (K, E) d per relative change of a contact impedance
    response: Array  # (K, M) d per S/m of drop
    position: Array  # (M, 2)
    radius: Array  # (M,)
    log_prior: Array  # (M,) of each touch: each radius alike, each position alike
    misfit: Array  # (K, K) covariance, of trace 1: what linear discs get wrong of a touch
    layer: Array  # (K, E) the part of `contact` that is a series resistance, where known; else all of it
    shift: Array  # (K, E) d per model unit that an electrode is off its place; (K, 0): not known
    signed: bool  # whether touches can only raise |Z|: measured bundles have no sign model

    @classmethod
    def of(
        cls,
        m: Matrices,
        half_width: float = 1.0,
        series_ohm: Array | None = None,
        shift: Array | None = None,
        tuning: Tuning = TUNING,
    ) -> SkinPhysics:
        """series_ohm (E,): each contact's series resistance, its impedance over its width."""
        discs = touches(m, half_width, tuning.radii)
        _, which, count = np.unique(discs.radius, return_inverse=True, return_counts=True)
        values, vectors = np.linalg.eigh(m.gram)
        misfit = vectors * np.maximum(values, 0.0) ** tuning.misfit_power @ vectors.T
        contact = np.asarray(m.contact, dtype=float)
        layer = contact
        if series_ohm is not None:
            layer = np.where(_members(m.pattern, contact.shape[1]), series_ohm / np.asarray(m.z0)[:, None], 0.0)
        return cls(
            pattern=np.asarray(m.pattern, dtype=np.int64),
            z0=np.asarray(m.z0, dtype=float),
            contact=contact,
            response=np.ascontiguousarray(discs.response.T, dtype=float),
            position=np.asarray(discs.position, dtype=float),
            radius=np.asarray(discs.radius, dtype=float),
            log_prior=-np.log(count[which] * float(len(count))),
            misfit=misfit / np.trace(misfit),
            layer=layer,
            shift=np.zeros((len(m.z0), 0)) if shift is None else np.asarray(shift, dtype=float),
            signed=m.normalisation == "model",
        )

    @property
    def electrodes(self) -> int:
        return int(self.contact.shape[1])

    def columns(self, d: Array) -> Array:
        """B (K, 1 + E): d per relative change of the scale and of each contact. A scale multiplies the frame that is
        measured, touch and all: d - x (1 + d) is exactly the frame's difference without it.
        """
        return np.column_stack([1.0 + d, self.contact])

    def members(self) -> NDArray[np.bool_]:
        """(K, E) measurement uses electrode."""
        return _members(self.pattern, self.electrodes)


def _members(pattern: NDArray[np.integer], electrodes: int) -> NDArray[np.bool_]:
    return np.asarray((np.asarray(pattern)[:, :, None] == np.arange(electrodes)).any(axis=1))
