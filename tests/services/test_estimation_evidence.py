"""Touch against drift in one frame, and the start: on frames of a mesh that is not the bundle's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from services.estimation.evidence import TouchEvidence
from services.estimation.physics import SkinPhysics
from services.estimation.start import StartVerdict, judge_start
from services.estimation.tuning import TUNING

from models.bundle import Bundle
from models.forward import shared
from models.mismatch import MismatchedSheet, named
from models.prereconstruction import Drift
from models.shapes import Shape

Array = NDArray[np.float64]
NOISE = 1e-4  # 80 dB
FRAMES = 64


@pytest.fixture(scope="module")
def evidence() -> TouchEvidence:
    bundle = Bundle.load("square16")
    skin = bundle.skin
    series = np.array(skin["contact_impedance"], float) / np.array(skin["electrodes"]["width"], float)
    return TouchEvidence(SkinPhysics.of(bundle.matrices, series_ohm=series))


@pytest.fixture(scope="module")
def solved() -> Callable[..., Array]:
    model = shared("square16", "stub")

    def impedances(*shapes: Shape, background: float = 1.0, contact: Array | float = 1.0) -> Array:
        conductivity = model.touched(list(shapes), background) if shapes else background
        return np.asarray(np.abs(model.solve(conductivity, model.contact_impedance * contact).impedances()))

    return impedances


def noisy(z: Array, rng: np.random.Generator, frames: int = 1) -> Array:
    return z * (1 + NOISE / np.sqrt(frames) * rng.standard_normal(len(z)))


def drift_prior(electrodes: int = 16) -> Array:
    return np.diag([TUNING.scale_sd**2, *[TUNING.contact_sd**2] * electrodes])


DRIFTS = {
    "-3 %": (0.97, ()),
    "-1 %": (0.99, ()),
    "+1 %": (1.01, ()),
    "+3 %": (1.03, ()),
    "all contacts": (1.0, tuple(range(16))),
    "three contacts": (1.0, (1, 6, 11)),
}


@pytest.mark.parametrize("name", DRIFTS)
def test_drift_is_taken_out_of_a_touched_frame(
    evidence: TouchEvidence, solved: Callable[..., Array], name: str
) -> None:
    """What is left is the touch's own difference, to 5 % and noise, and no further off than is stated."""
    background, changed = DRIFTS[name]
    contact = np.ones(16)
    contact[list(changed)] = 1.1
    rng = np.random.default_rng(5)
    z0, physics = solved(), evidence.physics
    pre = Bundle.load("square16").prereconstructor()
    normaliser = pre.normaliser(z0)
    error = np.diag(np.full(len(z0), NOISE**2 * (1 + 1 / FRAMES) + TUNING.absolute**2))
    base = noisy(z0, rng, FRAMES)
    one_step = pre.condition(np.full(len(z0), NOISE), drift=Drift(5e-4, 2e-3))
    for touch in (
        Shape("circle", 0.35, -0.2, 0.2, 0.1),
        Shape("circle", -0.5, 0.4, 0.3, 0.5),
        Shape("circle", 0.1, 0.6, 0.1, 0.3),
    ):
        d = (noisy(solved(touch, background=background, contact=contact), rng) - base) / normaliser
        truth = (solved(touch) - z0) / normaliser
        got, covariance, found = evidence.corrected(d, error, physics.columns(d), drift_prior())
        assert found.odds > 20
        assert np.linalg.norm(got - truth) < 0.05 * np.linalg.norm(truth) + 3 * NOISE * np.sqrt(len(d))
        assert found.touches[0].position == pytest.approx([touch.x, touch.y], abs=0.1)
        stated = np.sqrt(np.trace(covariance))
        assert np.linalg.norm(got - truth) < 6 * stated + 3 * NOISE * np.sqrt(len(d))
        image = one_step.one_step(got, 24)
        iy, ix = np.unravel_index(image.argmax(), image.shape)
        peak = (np.array([ix, iy]) + 0.5) / 12 - 1
        assert np.linalg.norm(peak - [touch.x, touch.y]) < 0.2


@pytest.mark.parametrize("name", DRIFTS)
def test_drift_alone_is_no_touch(evidence: TouchEvidence, solved: Callable[..., Array], name: str) -> None:
    background, changed = DRIFTS[name]
    contact = np.ones(16)
    contact[list(changed)] = 1.1
    rng, z0 = np.random.default_rng(6), solved()
    drifted = solved(background=background, contact=contact)
    error = np.diag(np.full(len(z0), NOISE**2 * (1 + 1 / FRAMES) + TUNING.absolute**2))
    for _ in range(20):
        d = noisy(drifted, rng) / noisy(z0, rng, FRAMES) - 1
        assert evidence(d, error, evidence.physics.columns(d), drift_prior()).odds < 0


def test_two_touches_are_two(evidence: TouchEvidence, solved: Callable[..., Array]) -> None:
    rng, z0 = np.random.default_rng(7), solved()
    touches = Shape("circle", -0.5, -0.4, 0.15, 0.3), Shape("circle", 0.5, 0.3, 0.2, 0.2)
    d = noisy(solved(*touches, background=0.98), rng) / noisy(z0, rng, FRAMES) - 1
    error = np.diag(np.full(len(z0), NOISE**2 + TUNING.absolute**2))
    found = evidence(d, error, evidence.physics.columns(d), drift_prior()).touches
    assert len(found) == 2
    for touch in touches:
        assert min(np.linalg.norm(f.position - [touch.x, touch.y]) for f in found) < 0.1


def test_a_dead_electrode_leaves_the_rest(evidence: TouchEvidence, solved: Callable[..., Array]) -> None:
    rng, z0 = np.random.default_rng(8), solved()
    touch = Shape("circle", 0.3, 0.1, 0.2, 0.2)
    d = noisy(solved(touch, background=1.02), rng) / noisy(z0, rng, FRAMES) - 1
    live = ~evidence.physics.members()[:, 4]
    d[~live] = np.nan
    error = np.diag(np.full(len(z0), NOISE**2 + TUNING.absolute**2))
    columns = evidence.physics.columns(np.where(live, d, 0.0))
    found = evidence(d, error, columns, drift_prior(), live)
    assert found.odds > 20 and found.touches[0].position == pytest.approx([0.3, 0.1], abs=0.1)
    assert np.isfinite(found.drift).all()


# the start


def start(evidence: TouchEvidence, z: Array, rng: np.random.Generator, trusted: Array | None = None) -> StartVerdict:
    return judge_start(noisy(z, rng, FRAMES), z * NOISE / np.sqrt(FRAMES), evidence, trusted).verdict


PRESSES = [(0.1, 0.1), (0.3, 0.1), (0.5, 0.1), (0.1, 0.2), (0.3, 0.2), (0.5, 0.2), (0.05, 0.2)]


@pytest.mark.parametrize(("drop", "radius"), PRESSES)
def test_a_press_at_the_start_is_told(
    evidence: TouchEvidence, solved: Callable[..., Array], drop: float, radius: float
) -> None:
    """1, 3, 5 N of radius 0.1 and 0.2 and 0.5 N of 0.2, contacts +-30 %, background +-5 %, gain unknown."""
    rng = np.random.default_rng([round(100 * drop), round(100 * radius)])
    for x, y in ((0.0, 0.0), (-0.6, 0.6), (0.4, -0.2)):
        contact, background = 1 + 0.3 * rng.uniform(-1, 1, 16), 1 + 0.05 * rng.uniform(-1, 1)
        z = solved(Shape("circle", x, y, radius, drop), background=background, contact=contact)
        assert start(evidence, 1.7 * z, rng) is StartVerdict.TOUCHED


def test_an_untouched_skin_of_any_contacts_is_untouched(evidence: TouchEvidence, solved: Callable[..., Array]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(12):
        contact, background = 1 + 0.3 * rng.uniform(-1, 1, 16), 1 + 0.05 * rng.uniform(-1, 1)
        assert start(evidence, solved(background=background, contact=contact), rng) is StartVerdict.UNTOUCHED


def test_a_skin_far_from_its_bundle_is_not_said_to_be_untouched(
    evidence: TouchEvidence, solved: Callable[..., Array]
) -> None:
    """Every |Z| off by 1 % in its own way: a touch could hide there."""
    rng = np.random.default_rng(4)
    odd = 1 + 0.01 * rng.standard_normal(120)
    assert start(evidence, solved() * odd, rng) is not StartVerdict.UNTOUCHED
    assert start(evidence, solved(Shape("circle", 0, 0, 0.1, 0.1)) * odd, rng) is not StartVerdict.UNTOUCHED


def test_a_trusted_baseline_tells_where_the_bundle_cannot(
    evidence: TouchEvidence, solved: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(5)
    odd = 1 + 0.01 * rng.standard_normal(120)
    trusted = noisy(solved() * odd, rng, FRAMES)
    free = solved(background=1.02, contact=1.05) * odd
    assert start(evidence, free, rng, trusted=trusted) is StartVerdict.UNTOUCHED
    pressed = solved(Shape("circle", 0.2, 0.1, 0.1, 0.1), background=1.02, contact=1.05) * odd
    assert start(evidence, pressed, rng, trusted=trusted) is StartVerdict.TOUCHED


def test_a_measured_bundle_has_no_prediction_to_start_from() -> None:
    bundle = Bundle.load("disc16")
    evidence = TouchEvidence(SkinPhysics.of(bundle.matrices))
    z = np.asarray(bundle.z0, dtype=float)
    assert judge_start(z, 1e-4 * z, evidence).verdict is StartVerdict.UNKNOWN


@pytest.mark.parametrize(
    "touches",
    [
        (Shape("circle", 0.4, -0.2, 0.1, 0.2),),
        (Shape("circle", 0.85, 0.1, 0.1, 0.3),),
        (Shape("L", 0.1, 0.5, 0.4, 0.5, 0.7),),
        (Shape("circle", -0.4, -0.4, 0.2, 0.4), Shape("circle", 0.5, 0.5, 0.2, 0.3)),
    ],
    ids=lambda touches: "-".join(shape.kind for shape in touches),
)
def test_a_touch_surely_explains_a_start_under_it(
    evidence: TouchEvidence, solved: Callable[..., Array], touches: tuple[Shape, ...]
) -> None:
    rng = np.random.default_rng(8)
    for _ in range(2):
        z = solved(*touches, contact=np.exp(0.3 * rng.standard_normal(16)))
        found = judge_start(noisy(z, rng, FRAMES), z * NOISE / np.sqrt(FRAMES), evidence)
        assert found.verdict is StartVerdict.TOUCHED and found.sure


@pytest.mark.parametrize("name", ["mild", "field5", "field10", "shift1", "shift3", "anisotropy15", "contacts"])
@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_no_touch_surely_explains_a_skin_that_is_not_as_in_its_file(
    evidence: TouchEvidence, name: str, seed: int
) -> None:
    """So that its first tare, which fits how it is mounted, is taken without force."""
    z = np.abs(MismatchedSheet("square16", named(name).seeded(seed), "stub").solve().impedances())
    found = judge_start(noisy(z, np.random.default_rng(seed), FRAMES), z * NOISE / np.sqrt(FRAMES), evidence)
    assert found.verdict is not StartVerdict.UNTOUCHED and not found.sure
