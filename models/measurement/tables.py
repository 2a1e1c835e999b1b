"""What a bundle tells of the untouched skin: what drops and contact impedances do to each measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import Legendre
from numpy.typing import NDArray

from models.bundle import Bundle
from models.calibration_file import found_by
from models.measurement import numbers as n
from models.measurement.arrays import Array, Mask, Single
from models.measurement.response import DiscGrid, DiscResponse, MeasuredMap, TouchModel
from models.measurement.touch import area_of
from models.patterns import incidence

OF_DROPS = ("jacobian", "along", "turned")  # tables of SkinTables
MOST_DEGREE = 3
FIELD_MODES = [(d - j, j) for d in range(MOST_DEGREE + 1) for j in range(d + 1)]
FIELD_DEGREES = tuple(i + j for i, j in FIELD_MODES)  # of each mode


@dataclass(frozen=True)
class SkinTables:
    """Of log |Z|. Jacobians are laid out pixel by pixel, [iy, ix, k], as discs take them."""

    jacobian: Single  # (F, F, K) per S of drop in a pixel
    along: Single  # (F, F, K) the same of a drop along x less one along y
    turned: Single  # (F, F, K) of a drop that turns a field along x into a current along y
    contact: Array  # (K, E) per relative change of a contact impedance
    series: Array  # (K, E) the part of `contact` that is in series with the sheet, at the electrode's own measurements
    field: Array  # (K, M) per log conductivity of the sheet, in the modes of FIELD_DEGREES
    misfit: Array  # (K, K) covariance of trace 1: the colour of what linear discs get wrong
    inside: Mask  # (F, F) pixels on the skin
    z0: Array  # (K,) |Z| that the rows are relative to
    pattern: NDArray[np.int64]  # (K, 4) drive+, drive-, sense+, sense-
    places: Array  # (E, 2) middles of the electrodes
    wrong: float = float(n.MISFIT)  # share of a touch's change that the tables get wrong
    predicted: bool = True  # whether z0 is what a model says of the untouched skin: measured bundles have none
    map: MeasuredMap | None = None  # of a registered skin
    known_grid: DiscGrid | None = None  # `grid`, where it follows from that of other tables

    @property
    def measurements(self) -> int:
        return len(self.z0)

    @property
    def electrodes(self) -> int:
        return int(self.contact.shape[1])

    @property
    def tells(self) -> bool:
        """Whether a response is known by which touches may explain scans: not where a bundle is of another skin, that
        was only measured.
        """
        return self.predicted or self.map is not None

    @cached_property
    def response(self) -> TouchModel:
        """What touches do. Where none is known, discs on the bundle's own skin: they see that something touches."""
        return self.map or DiscResponse(self.jacobian, self.along, self.turned, self.inside)

    @cached_property
    def grid(self) -> DiscGrid:
        """Where something may touch."""
        return self.known_grid or DiscGrid(self.response)

    def misfit_of(self, size2: float) -> Array:
        """(K, K) covariance of what the response gets wrong of touches of this squared change."""
        made = self.wrong**2 * size2 * self.misfit
        return made if self.map is None else made + self.map.error

    def relative_to(self, z0: Array) -> SkinTables:
        """The same of a skin whose untouched |Z| was measured: the impedances that a touch adds are the bundle's, up to
        one common gain. A skin whose impedances differ from the bundle's answers to touches by as much otherwise: on
        skins mounted a few per cent wrong both are 4 to 5 %. What measured bundles know is relative to the untouched
        skin, whatever its impedances are.
        """
        if not self.predicted:
            return self
        gain = float(np.median(z0 / self.z0))
        row = gain * self.z0 / z0
        unlike = float(np.sqrt(np.mean(np.log(row) ** 2)))
        drops = {name: (getattr(self, name) * row).astype(np.float32) for name in OF_DROPS}
        contact = self.contact * row[:, None]
        return replace(
            self,
            **drops,
            contact=contact,
            series=self.series * row[:, None],
            field=_field(drops["jacobian"], contact),
            misfit=_of_trace_one(self.misfit * np.outer(row, row)),
            z0=z0,
            wrong=float(np.hypot(self.wrong, unlike)),
            known_grid=self.grid.through(np.diag(row)),
        )

    def through(self, slopes: Array) -> SkinTables:
        """The same seen through a fault of the wires; slopes (K, K): of log |Z| with it to log |Z| without."""
        single = slopes.T.astype(np.float32)
        drops = {name: getattr(self, name) @ single for name in OF_DROPS}
        rest = {name: slopes @ getattr(self, name) for name in ("contact", "series", "field")}
        return replace(
            self,
            **drops,
            **rest,
            misfit=_of_trace_one(slopes @ self.misfit @ slopes.T),
            map=None if self.map is None else self.map.through(slopes),
            known_grid=self.grid.through(slopes),
        )


def tells_touches(bundle: Bundle) -> bool:
    """Whether measurements tell the touches of such a skin: not where its bundle is of another one, that was only
    measured.
    """
    return bundle.matrices.normalisation == "model"


def tables_of(bundle: Bundle) -> SkinTables:
    """Of a bundle as it ships, or as it was calibrated to a skin: its response tables where it has them, else its
    coarser Jacobian without directions. The response tables of the file are those of a skin that is mounted as the file
    says: a calibrated bundle without fields of its own has none.

    Raises BundleError where a file of the bundle cannot be read.
    """
    matrices, pattern = bundle.matrices, np.asarray(bundle.pattern, np.int64)
    z0, contact = np.asarray(matrices.z0, float), np.asarray(matrices.contact, float)
    side = round(matrices.jacobian.shape[1] ** 0.5)
    coarse = np.ascontiguousarray(np.asarray(matrices.jacobian, np.float32).T.reshape(side, side, -1))
    jacobian, along, turned = coarse, np.zeros_like(coarse), np.zeros_like(coarse)
    fine = bundle.has_response and (found_by(bundle) is None or bundle.mounted_fields is not None)
    if fine:
        jacobian, along, turned = _from_fields(bundle, pattern, z0, coarse)
    self_sensing = bool((pattern[:, :2] == pattern[:, 2:]).all())
    times = len(jacobian) // len(matrices.inside)
    typical = float(n.TYPICAL_DROP) * area_of(float(np.log(n.TYPICAL_RADIUS)))
    values, vectors = np.linalg.eigh(matrices.gram)
    misfit = vectors * np.maximum(values, 0.0) ** n.MISFIT_POWER @ vectors.T
    return SkinTables(
        jacobian=jacobian,
        along=along,
        turned=turned,
        contact=contact,
        series=_series(bundle, z0) if self_sensing and "contact_impedance" in bundle.skin else contact,
        field=_field(jacobian, contact),
        misfit=_of_trace_one(np.asarray(misfit)),
        inside=np.kron(np.asarray(matrices.inside, bool), np.ones((times, times), bool)),
        z0=z0,
        pattern=pattern,
        places=np.asarray(bundle.skin["electrodes"]["centre"], float),
        predicted=tells_touches(bundle),
        wrong=float(n.MISFIT if fine and self_sensing else n.MISFIT_FAR),
        map=None if bundle.locator is None else MeasuredMap(bundle.locator, bundle.metres_per_unit, typical),
    )


def _series(bundle: Bundle, z0: Array) -> Array:
    """(K, E): a layer's impedance over its electrode's width adds to every measurement that drives there."""
    skin, pattern = bundle.skin, np.asarray(bundle.pattern)
    series = np.asarray(skin["contact_impedance"], float) / np.asarray(skin["electrodes"]["width"], float)
    members = (pattern[:, :2, None] == np.arange(len(series))).any(axis=1)
    return np.asarray(np.where(members, series / z0[:, None], 0.0))


def _from_fields(
    bundle: Bundle, pattern: NDArray[np.int64], z0: Array, coarse: Single
) -> tuple[Single, Single, Single]:
    """A drop delta in a pixel changes an impedance by delta * E_drive . E_sense * area (Geselowitz 1971). coarse: the
    bundle's own Jacobian, which knows the sign of each impedance.
    """
    tables = bundle.response()
    fields = (tables.fields if bundle.mounted_fields is None else bundle.mounted_fields).astype(float)
    side, electrodes = round(fields.shape[1] ** 0.5), fields.shape[2]
    inside = np.kron(tables.inside, np.ones((2, 2), bool)) if side == 2 * len(tables.inside) else None
    driven, sensed = (fields @ incidence(pattern[:, k : k + 2], electrodes).T for k in (0, 2))

    def table(values: Array, scale: Array) -> Array:
        shaped = (values * scale).reshape(side, side, -1)
        return shaped if inside is None else shaped * inside[:, :, None]

    xx, yy = driven[0] * sensed[0], driven[1] * sensed[1]
    plain = table(xx + yy, (2 / side) ** 2 / z0)
    signed = (2 / side) ** 2 / z0 * _signs(plain, coarse)
    products = xx + yy, xx - yy, driven[0] * sensed[1] + driven[1] * sensed[0]
    made = [np.ascontiguousarray(table(values, signed), dtype=np.float32) for values in products]
    return made[0], made[1], made[2]


def _signs(fine: Array, coarse: Single) -> Array:
    """(K,) 1 or -1 for each measurement, as the coarse table has it."""
    side, block = len(coarse), len(fine) // len(coarse)
    blocks = fine.reshape(side, block, side, block, -1)
    return np.where(np.einsum("yaxbk,yxk->k", blocks, coarse, optimize=True) < 0, -1.0, 1.0)


def _field(jacobian: Single, contact: Array) -> Array:
    """(K, M): what a rise of the log conductivity does that goes over the sheet as Legendre's polynomials. The even one
    is exact by scaling: of an impedance all but the contacts' shares falls by as much.
    """
    side = len(jacobian)
    axis = (np.arange(side) + 0.5) * 2 / side - 1
    along = [Legendre.basis(degree)(axis) for degree in range(MOST_DEGREE + 1)]
    modes = [-np.einsum("yxk,x,y->k", jacobian, along[i], along[j], optimize=True) for i, j in FIELD_MODES]
    modes[0] = -(1 - contact.sum(axis=1))
    return np.column_stack(modes)


def _of_trace_one(covariance: Array) -> Array:
    return np.asarray(covariance / np.trace(covariance))


skin_tables = lru_cache(maxsize=4)(tables_of)
"""Of a bundle, by its hash: 14 MB each, and each tare that calibrates makes a bundle of its own."""
