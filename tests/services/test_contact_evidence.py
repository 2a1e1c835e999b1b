"""A contact that changed, told from touches in one frame: on the stub's sheet, which the inverse does not use."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.shapes import Shape
from services.estimation.contact_evidence import ContactEvidence, ContactOpinion
from tests.services.stub_skin import sheet, transfer

Array = NDArray[np.float64]
NOISE = 1e-4
ELSEWHERE = (Shape("circle", 0.2, -0.1, 0.2, 0.4),)


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load("square16")


@pytest.fixture(scope="module")
def evidence(bundle: Bundle) -> ContactEvidence:
    return ContactEvidence(bundle)


def opinion(
    bundle: Bundle,
    evidence: ContactEvidence,
    electrode: int,
    touches: tuple[Shape, ...],
    contacts: tuple[tuple[int, float], ...] = (),
) -> ContactOpinion:
    rng = np.random.default_rng(electrode)
    dp, dm, sp, sm = bundle.pattern.T

    def read(t: Array) -> Array:
        return np.asarray(np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm]))

    z0, z = read(transfer()), read(transfer(touches, contacts))
    z = z * (1 + NOISE * rng.standard_normal(len(z)))
    sigma, live = np.full(len(z), NOISE), np.ones(len(z), dtype=bool)
    return evidence(electrode, z / z0 - 1, sigma, live)


@pytest.mark.parametrize("touches", [(), ELSEWHERE], ids=["untouched", "touched"])
@pytest.mark.parametrize("times", [1.5, 1.75, 8.0])
def test_a_contact_that_rose_is_changed(
    bundle: Bundle, evidence: ContactEvidence, touches: tuple[Shape, ...], times: float
) -> None:
    for electrode in (3, 12):
        found = opinion(bundle, evidence, electrode, touches, ((electrode, times),))
        assert found.changed() and not found.well


def test_a_contact_is_well_under_a_touch_elsewhere(bundle: Bundle, evidence: ContactEvidence) -> None:
    for electrode in range(0, 16, 5):
        found = opinion(bundle, evidence, electrode, ELSEWHERE)
        assert found.well and not found.changed()


# Electrode, radius, drop: touches that ContactDrift suspects to be a contact of the electrode that they press on.
SUSPECTED = (
    (14, 0.144, 0.04),
    (7, 0.096, 0.04),
    (12, 0.058, 0.16),
    (7, 0.05, 0.21),
    (14, 0.084, 0.05),
    (5, 0.108, 0.07),
)


@pytest.mark.parametrize(("electrode", "radius", "drop"), SUSPECTED)
def test_a_light_touch_right_on_an_electrode_is_no_changed_contact(
    bundle: Bundle, evidence: ContactEvidence, electrode: int, radius: float, drop: float
) -> None:
    x, y = 0.98 * sheet().skin.point(sheet().skin.electrodes)[electrode]
    found = opinion(bundle, evidence, electrode, (Shape("circle", float(x), float(y), radius, drop),))
    assert not found.changed()


def test_what_others_feel_of_a_contact(bundle: Bundle, evidence: ContactEvidence) -> None:
    """The pairs of other electrodes, of which the change takes the current's short way."""
    dp, dm, sp, sm = bundle.pattern.T
    electrode, changed = 9, ((9, 3.0),)
    t, t0 = transfer((), changed), transfer()
    z, z0 = (np.abs(each[sp, dp] - each[sp, dm] - each[sm, dp] + each[sm, dm]) for each in (t, t0))
    others = ~(bundle.pattern == electrode).any(axis=1)
    felt = opinion(bundle, evidence, electrode, ELSEWHERE, changed).felt
    assert not felt[~others].any()
    assert np.linalg.norm((z / z0 - 1 - felt)[others]) < 0.25 * np.linalg.norm((z / z0 - 1)[others])
