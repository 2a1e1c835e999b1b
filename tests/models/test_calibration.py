"""Calibration from one untouched frame: the derivatives, what it finds, what it never does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from models import geometry
from models.bundle import Bundle
from models.calibration import TooFewMeasured, calibrated, fields_as_mounted, fit
from models.calibration_file import CalibrationFileError, pack, unpack
from models.forward import ForwardModel
from models.measurement.course import TouchCourse
from models.measurement.fit import FittedScan, TouchFitter
from models.measurement.numbers import MISFIT, MISFIT_FAR
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.tables import SkinTables, tables_of
from models.measurement.touch import anywhere, plain
from models.mismatch import Mismatch, MismatchedSheet, mounted, named
from models.mounted import FieldModes, Mounting, Predicted, most_shift
from models.prereconstruction import Matrices, PreReconstructor
from models.shapes import Shape

Array = NDArray[np.float64]

MESH = "inverse"  # the fit's steps are taken on it; the sheets are of the mesh "stub"


@pytest.fixture(scope="module")
def skin() -> geometry.SkinGeometry:
    return geometry.load("square16")


@pytest.fixture(scope="module")
def matrices() -> Matrices:
    return Bundle.load("square16").matrices


def measured(mismatch: Mismatch, shapes: tuple[Shape, ...] = ()) -> np.ndarray:
    return np.abs(MismatchedSheet("square16", mismatch).solve(shapes).impedances())


@pytest.mark.release
def test_derivatives_are_those_of_the_forward_model(skin: geometry.SkinGeometry) -> None:
    modes, rng = FieldModes(skin), np.random.default_rng(0)
    nominal = Mounting.nominal(skin, modes.count)
    state = nominal.with_vector(0.3 * rng.standard_normal(len(nominal.vector)) * nominal.prior_sd)
    slopes = {mesh: Predicted(skin, state, modes, mesh).derivative() for mesh in (MESH, "training")}
    e, m = skin.n_electrodes, modes.count
    # gain, contacts, field, anisotropy exactly; a shift makes another mesh, whose noise is in the difference
    for column, step, within, mesh in (
        (0, 1e-3, 1e-6, MESH),
        (4, 1e-3, 1e-4, MESH),
        (1 + 2 * e + 2, 1e-3, 1e-4, MESH),
        (1 + 2 * e + m, 1e-3, 1e-4, MESH),
        (2 + 2 * e + m, 1e-3, 1e-4, MESH),
        (1 + e + 5, 4e-3, 0.05, "training"),
    ):
        way = step * np.eye(len(state.vector))[column]
        high, low = (Predicted(skin, state.with_vector(state.vector + s * way), modes, mesh) for s in (1, -1))
        found = (high.log - low.log) / (2 * step)
        assert np.linalg.norm(found - slopes[mesh][:, column]) < within * np.linalg.norm(found), column


@pytest.mark.release
def test_a_fit_finds_anisotropy_contacts_and_shifts(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    mismatch = Mismatch(anisotropy=0.05, contacts=3, contact_factor=3.0)
    z0 = 7.3 * measured(mismatch)  # a board in any unit
    found = fit(skin, matrices, z0, 1e-5 * z0)
    assert found.mounting.log_gain == pytest.approx(np.log(7.3), abs=0.01)
    np.testing.assert_allclose(found.mounting.anisotropy, [np.log(1.05), 0], atol=4e-3)
    contact = np.log(mounted(skin, mismatch).contact_impedance / skin.contact_impedance)
    np.testing.assert_allclose(found.mounting.contact, contact, atol=0.15)
    assert np.abs(found.mounting.shift).max() < 0.01
    assert found.after < 0.05 * found.before
    moved = replace(named("shift1"), seed=3)
    found = fit(skin, matrices, measured(moved), 1e-5 * z0)
    true = mounted(skin, moved).electrodes - skin.electrodes
    left = found.mounting.shift - true
    assert left.std() < 0.6 * true.std()  # turning all of them alike, which anisotropy resembles, is hardly seen


def test_an_even_well_made_skin_is_left_as_it_is(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    z0 = measured(named("none"))
    mounting = fit(skin, matrices, z0, 1e-5 * z0).mounting
    assert np.abs(mounting.shift).max() < 2e-3
    assert np.abs(mounting.anisotropy).max() < 2e-3
    assert np.abs(mounting.contact).max() < 0.05
    assert np.abs(mounting.field).max() < 0.1


@pytest.mark.release
def test_calibrated_matrices_predict_the_touches_of_a_mismatched_skin(
    skin: geometry.SkinGeometry, matrices: Matrices
) -> None:
    touch = (Shape("circle", 0.45, 0.3, 0.2, 0.05),)
    mismatch = named("mild")
    z0, z = measured(mismatch), measured(mismatch, touch)
    made = calibrated(matrices, skin, fit(skin, matrices, z0, 1e-5 * z0).mounting)
    off = {}
    for name, each in (("file", matrices), ("calibrated", made)):
        d = PreReconstructor(each).difference(z, z0)
        grid = each.inside.shape[0]
        expected = each.jacobian @ (-np.log(1 - touch[0].drop) * touch[0].fraction(grid)).ravel()
        off[name] = np.linalg.norm(d - expected) / np.linalg.norm(d)
    assert off["calibrated"] < 0.5 * off["file"] and off["calibrated"] < 0.05
    assert (made.level == matrices.level).all() and made.scale_index == matrices.scale_index


@pytest.mark.release
def test_linearising_about_the_file_gives_the_files_matrices(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    made = calibrated(matrices, skin, Mounting.nominal(skin, FieldModes(skin).count))
    for name in ("z0", "gram", "back", "jacobian", "contact"):
        np.testing.assert_allclose(getattr(made, name), getattr(matrices, name), rtol=1e-5, atol=1e-7)


@pytest.mark.release
def test_large_shifts_stay_bounded_and_never_make_it_worse(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    mismatch = named("shift3").seeded(1)
    z0 = measured(mismatch)
    found = fit(skin, matrices, z0, 1e-5 * z0)
    assert (np.abs(found.mounting.shift) <= most_shift(skin) + 1e-12).all()
    assert found.after < found.before
    rng = np.random.default_rng(3)
    nonsense = measured(named("none")) * np.exp(0.4 * rng.standard_normal(len(z0)))  # no skin measures this
    found = fit(skin, matrices, nonsense, 1e-5 * z0)
    assert found.after <= found.before and np.isfinite(found.mounting.vector).all()


def test_too_few_measurements_are_refused(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    z0 = measured(named("none"))
    z0[:30] = 0.0
    with pytest.raises(TooFewMeasured, match="90 of 120"):
        fit(skin, matrices, z0, 1e-5 * z0)


def test_a_pixel_knows_its_elements_without_a_plotting_library(skin: geometry.SkinGeometry) -> None:
    """Against a point-by-point search: the triangle whose edges have the pixel's samples on their left."""
    model = ForwardModel(geometry.load("disc16"), mesh=MESH)
    found = model._at_samples(20)
    a, b, c = (model.corners[:, k] for k in range(3))
    for k in range(0, 400, 7):
        iy, ix = divmod(k, 20)
        p = -1 + 2 * (np.array([ix, iy]) + 0.5) / 20

        def left(s: np.ndarray, t: np.ndarray, p: np.ndarray = p) -> np.ndarray:
            return np.asarray((t[:, 0] - s[:, 0]) * (p[1] - s[:, 1]) - (t[:, 1] - s[:, 1]) * (p[0] - s[:, 0]))

        sides = np.stack([left(a, b), left(b, c), left(c, a)])
        inside = np.flatnonzero((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0))
        assert (found[k] == -1) if not len(inside) else (found[k] in inside)


@pytest.mark.release
def test_fields_about_the_file_are_those_of_its_response_tables(skin: geometry.SkinGeometry) -> None:
    made, shipped = fields_as_mounted(skin, Mounting.nominal(skin, FieldModes(skin).count)), Bundle.load("square16")
    np.testing.assert_allclose(made, shipped.response().fields, rtol=2e-3, atol=2e-3)


def left_of_touches(tables: SkinTables, mismatch: Mismatch, z0: Array) -> float:
    """Median share of a touch's change that the best disc leaves."""
    found, own = [], tables.relative_to(z0)
    course = TouchCourse(DiscResponse(own), np.zeros(len(z0)), 0.04)
    for x, y in ((0.5, 0.3), (0.2, -0.7), (-0.6, -0.5)):
        seen = np.log(measured(mismatch, (Shape("circle", x, y, 0.2, 0.3),)) / z0)
        scene = FittedScan(seen, 1e-8 * np.eye(len(z0)), course, own.misfit, len(z0))
        prior = anywhere(x, y, 0.0, 0.04)
        prior.sd[4:] = 1e-6
        best = TouchFitter(scene, [plain(prior)]).fit(30)
        found.append(np.linalg.norm(best.left) / np.linalg.norm(seen))
    return float(np.median(found))


@pytest.mark.release
def test_discs_of_a_calibrated_skin_leave_what_its_tables_say(skin: geometry.SkinGeometry, matrices: Matrices) -> None:
    """Of a skin that its file describes a few per cent wrong."""
    bundle, mismatch = Bundle.load("square16"), named("mild")
    z0 = measured(mismatch)
    mounting = fit(skin, matrices, z0, 1e-5 * z0).mounting
    made, as_mounted = calibrated(matrices, skin, mounting), mounting.skin(skin).to_dict()
    said = {"bundle_hash": bundle.hash}
    tables = tables_of(unpack(pack(made, as_mounted, said, fields_as_mounted(skin, mounting)), bundle))
    assert tables.relative_to(z0).wrong < 1.5 * MISFIT
    left, of_the_file = (left_of_touches(each, mismatch, z0) for each in (tables, tables_of(bundle)))
    assert left < 2 * MISFIT and left < 0.3 * of_the_file
    without_fields = tables_of(unpack(pack(made, as_mounted, said), bundle))
    assert without_fields.wrong == MISFIT_FAR and without_fields.jacobian.shape[0] == bundle.matrices.inside.shape[0]


@pytest.mark.parametrize("shape", [(2, 2304, 15), (2, 2303, 16), (2, 2304)])
def test_fields_of_another_skin_are_refused(matrices: Matrices, shape: tuple[int, ...]) -> None:
    bundle = Bundle.load("square16")
    packed = pack(matrices, bundle.skin, {"bundle_hash": bundle.hash}, np.ones(shape, np.float32))
    with pytest.raises(CalibrationFileError, match="fields"):
        unpack(packed, bundle)
    packed = pack(matrices, bundle.skin, {"bundle_hash": bundle.hash}, np.full((2, 2304, 16), np.nan, np.float32))
    with pytest.raises(CalibrationFileError, match="NaN"):
        unpack(packed, bundle)
