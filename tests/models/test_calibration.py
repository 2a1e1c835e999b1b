"""Calibration from one untouched frame: the derivatives, what it finds, what it never does."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import geometry
from models.bundle import Bundle
from models.calibration import CalibrationFit, TooFewMeasured, calibrated, fields_as_mounted, fit
from models.calibration_file import CalibrationFileError, pack, unpack
from models.measurement.course import TouchCourse
from models.measurement.fit import FittedScan, TouchFitter
from models.measurement.numbers import MISFIT, MISFIT_FAR
from models.measurement.tables import SkinTables, tables_of
from models.measurement.touch import anywhere, plain
from models.mismatch import Mismatch, MismatchedSheet, mounted, named
from models.mounted import FieldModes, Mounting, Predicted, most_shift
from models.prereconstruction import PreReconstructor
from models.shapes import Shape

MESH = "inverse"  # the fit's steps are taken on it; the sheets are of the mesh "stub"


@cache
def measured(mismatch: Mismatch, shapes: tuple[Shape, ...] = ()) -> np.ndarray:
    return np.abs(MismatchedSheet("square16", mismatch).solve(shapes).impedances())


def fitted(skin, bundle: Bundle, z0: np.ndarray) -> CalibrationFit:
    return fit(skin, bundle.matrices, z0, 1e-5 * z0)


@pytest.fixture
def skin() -> geometry.SkinGeometry:
    return geometry.load("square16")


@pytest.fixture(scope="module")
def mild(bundle: Bundle) -> CalibrationFit:
    """Of a skin that its file describes a few per cent wrong."""
    return fitted(geometry.load("square16"), bundle, measured(named("mild")))


# a shift makes another mesh, whose noise is in the difference
GAIN, CONTACT, SHIFT, FIELD, ANISOTROPY = 0, 1, 1 + 16, 1 + 32, -2


@pytest.mark.release
def test_derivatives_are_those_of_the_forward_model(skin: geometry.SkinGeometry) -> None:
    modes, rng = FieldModes(skin), np.random.default_rng(0)
    nominal = Mounting.nominal(skin, modes.count)
    assert len(nominal.vector) == FIELD + modes.count + 2
    state = nominal.with_vector(0.3 * rng.standard_normal(len(nominal.vector)) * nominal.prior_sd)
    slopes = Predicted(skin, state, modes, MESH).derivative()
    columns = {GAIN: 1e-4, CONTACT + 3: 1e-4, SHIFT + 5: 0.2, FIELD + 2: 1e-4, ANISOTROPY: 1e-4, ANISOTROPY + 1: 1e-4}
    for column, within in columns.items():
        step = 4e-3 if column == SHIFT + 5 else 1e-3
        way = step * np.eye(len(state.vector))[column]
        high, low = (Predicted(skin, state.with_vector(state.vector + s * way), modes, MESH).log for s in (1, -1))
        found = (high - low) / (2 * step)
        assert np.linalg.norm(found - slopes[:, column]) < within * np.linalg.norm(found), column


def test_a_fit_finds_gain_anisotropy_and_contacts(skin, bundle: Bundle) -> None:
    mismatch = Mismatch(anisotropy=0.05, contacts=3, contact_factor=3.0)
    found = fitted(skin, bundle, 7.3 * measured(mismatch))  # a board in any unit
    assert found.mounting.log_gain == pytest.approx(np.log(7.3), abs=0.01)
    assert_allclose(found.mounting.anisotropy, [np.log(1.05), 0], atol=4e-3)
    contact = np.log(mounted(skin, mismatch).contact_impedance / skin.contact_impedance)
    assert_allclose(found.mounting.contact, contact, atol=0.15)
    assert np.abs(found.mounting.shift).max() < 0.01 and found.after < 0.05 * found.before


def test_an_even_well_made_skin_is_left_as_it_is(skin, bundle: Bundle) -> None:
    z0 = measured(named("none"))
    mounting = fitted(skin, bundle, z0).mounting
    assert np.abs(mounting.shift).max() < 2e-3 and np.abs(mounting.anisotropy).max() < 2e-3
    assert np.abs(mounting.contact).max() < 0.05 and np.abs(mounting.field).max() < 0.1
    with pytest.raises(TooFewMeasured, match="90 of 120"):
        fitted(skin, bundle, np.where(np.arange(120) < 30, 0.0, z0))


def test_a_frame_of_no_skin_never_makes_it_worse(skin, bundle: Bundle) -> None:
    nonsense = measured(named("none")) * np.exp(0.4 * np.random.default_rng(3).standard_normal(120))
    found = fitted(skin, bundle, nonsense)
    assert found.after <= found.before and (np.abs(found.mounting.shift) <= most_shift(skin) + 1e-12).all()


def test_calibrated_matrices_predict_the_touches_of_a_mismatched_skin(skin, bundle, mild) -> None:
    touch, matrices, off = (Shape("circle", 0.45, 0.3, 0.2, 0.05),), bundle.matrices, []
    z0, z = measured(named("mild")), measured(named("mild"), touch)
    made = calibrated(matrices, skin, mild.mounting)
    for each in (matrices, made):
        d = PreReconstructor(each).difference(z, z0)
        expected = each.jacobian @ (-np.log(1 - touch[0].drop) * touch[0].fraction(each.inside.shape[0])).ravel()
        off.append(np.linalg.norm(d - expected) / np.linalg.norm(d))
    assert off[1] < 0.5 * off[0] and off[1] < 0.05
    assert (made.level == matrices.level).all() and made.scale_index == matrices.scale_index


def left_of_touches(tables: SkinTables, z0: np.ndarray) -> float:
    """Median share of a touch's change that the best disc leaves."""
    found, own = [], tables.relative_to(z0)
    course = TouchCourse(own.response, np.zeros(len(z0)), 0.04)
    for x, y in ((0.5, 0.3), (0.2, -0.7), (-0.6, -0.5)):
        seen = np.log(measured(named("mild"), (Shape("circle", x, y, 0.2, 0.3),)) / z0)
        scene, prior = FittedScan(seen, 1e-8 * np.eye(len(z0)), course, own.misfit, len(z0)), anywhere(x, y, 0.0, 0.04)
        prior.sd[4:] = 1e-6
        found.append(np.linalg.norm(TouchFitter(scene, [plain(prior)]).fit(30).left) / np.linalg.norm(seen))
    return float(np.median(found))


@pytest.mark.release
def test_discs_of_a_calibrated_skin_leave_what_its_tables_say(skin, bundle: Bundle, mild: CalibrationFit) -> None:
    z0, said = measured(named("mild")), {"bundle_hash": bundle.hash}
    made, as_mounted = calibrated(bundle.matrices, skin, mild.mounting), mild.mounting.skin(skin).to_dict()
    tables = tables_of(unpack(pack(made, as_mounted, said, fields_as_mounted(skin, mild.mounting)), bundle))
    assert tables.relative_to(z0).wrong < 1.5 * MISFIT
    left, of_the_file = (left_of_touches(each, z0) for each in (tables, tables_of(bundle)))
    assert left < 2 * MISFIT and left < 0.3 * of_the_file
    without_fields = tables_of(unpack(pack(made, as_mounted, said), bundle))
    assert without_fields.wrong == MISFIT_FAR and without_fields.jacobian.shape[0] == bundle.matrices.inside.shape[0]


def test_fields_of_another_skin_are_refused(bundle: Bundle) -> None:
    for fields, says in ((np.ones((2, 2304, 15)), "fields"), (np.full((2, 2304, 16), np.nan), "NaN")):
        packed = pack(bundle.matrices, bundle.skin, {"bundle_hash": bundle.hash}, fields.astype(np.float32))
        with pytest.raises(CalibrationFileError, match=says):
            unpack(packed, bundle)
