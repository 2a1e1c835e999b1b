"""What a frame shows, by log evidence: faults of the stub's sheet, touched or not, and the filter over frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.shapes import Shape
from services.estimation.drift import DriftProcess
from services.estimation.evidence import TouchEvidence
from services.estimation.hypotheses import Hypotheses, Name
from services.estimation.physics import SkinPhysics
from services.estimation.posterior import ForwardFilter
from tests.services.stub_skin import sheet, transfer

Array = NDArray[np.float64]
NOISE = 1e-4
PRIOR = DriftProcess.of_skin(16, creep=False).value_covariance(1.0)
TOUCH = (Shape("circle", 0.3, -0.2, 0.2, 0.3),)


@pytest.fixture(scope="module")
def hypotheses() -> Hypotheses:
    bundle = Bundle.load("square16")
    skin = bundle.skin
    series = np.array(skin["contact_impedance"], float) / np.array(skin["electrodes"]["width"], float)
    return Hypotheses(TouchEvidence(SkinPhysics.of(bundle.matrices, series_ohm=series)))


def read(t: Array, pattern: NDArray[np.int64]) -> Array:
    dp, dm, sp, sm = pattern.T
    return np.asarray(np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm]))


def likeliest(hypotheses: Hypotheses, z: Array, seed: int = 0, before: Array | None = None) -> Name:
    rng = np.random.default_rng(seed)
    z0 = read(transfer(), hypotheses.physics.pattern)
    z = z * (1 + NOISE * rng.standard_normal(len(z)))
    z0 = z0 * (1 + NOISE / 8 * rng.standard_normal(len(z)))
    found = hypotheses(z, z0, np.full(len(z), NOISE), PRIOR, before)
    return max(found, key=lambda name: found[name])


def test_untouched_and_touched(hypotheses: Hypotheses) -> None:
    pattern = hypotheses.physics.pattern
    for seed in range(5):
        assert likeliest(hypotheses, read(transfer(), pattern), seed) == ("untouched",)
    for touch in (*TOUCH, Shape("circle", -0.6, 0.5, 0.1, 0.1), Shape("circle", 0.0, 0.7, 0.3, 0.5)):
        assert likeliest(hypotheses, read(transfer((touch,)), pattern)) == ("touched",)


@pytest.mark.parametrize("touches", [(), TOUCH], ids=["untouched", "held"])
@pytest.mark.parametrize(("e", "f"), [(0, 1), (3, 9), (5, 14)])
def test_exchanged_wires(hypotheses: Hypotheses, touches: tuple[Shape, ...], e: int, f: int) -> None:
    order = np.arange(16)
    order[[e, f]] = f, e
    t = transfer(touches)[np.ix_(order, order)]
    assert likeliest(hypotheses, read(t, hypotheses.physics.pattern)) == ("swapped", e, f)


@pytest.mark.parametrize("touches", [(), TOUCH], ids=["untouched", "held"])
@pytest.mark.parametrize(("e", "f"), [(0, 1), (3, 9), (5, 14)])
def test_shorts(hypotheses: Hypotheses, touches: tuple[Shape, ...], e: int, f: int) -> None:
    t = transfer(touches)
    joined = t[:, e] - t[:, f]
    t = t - np.outer(joined, joined) / (joined[e] - joined[f])
    assert likeliest(hypotheses, read(t, hypotheses.physics.pattern)) == ("short", e, f)


@pytest.mark.parametrize("touches", [(), TOUCH], ids=["untouched", "held"])
def test_a_stuck_address_bit(hypotheses: Hypotheses, touches: tuple[Shape, ...]) -> None:
    rows = hypotheses.physics.pattern.copy()
    rows[:, 0] |= 4
    assert likeliest(hypotheses, read(transfer(touches), rows)) == ("multiplexer", "+", 2, 1)


@pytest.mark.parametrize("factor", [2.0, 3.0, 10.0])
def test_a_contact_that_lifts(hypotheses: Hypotheses, factor: float) -> None:
    for e in (0, 6, 13):
        z = read(transfer((), ((e, factor),)), hypotheses.physics.pattern)
        assert likeliest(hypotheses, z) == ("contact", e)


def test_gain_and_frozen(hypotheses: Hypotheses) -> None:
    z0 = read(transfer(), hypotheses.physics.pattern)
    assert likeliest(hypotheses, 0.97 * z0) == ("gain",)
    rng = np.random.default_rng(3)
    z = z0 * (1 + NOISE * rng.standard_normal(len(z0)))
    found = hypotheses(z, z0, np.full(len(z0), NOISE), PRIOR, before=z.copy())
    assert max(found, key=lambda name: found[name]) == ("frozen",)


def test_a_pattern_says_what_it_can_tell() -> None:
    m = Bundle.load("disc16").matrices
    assert "short" not in Hypotheses(TouchEvidence(SkinPhysics.of(m))).named
    assert "short" in Hypotheses(TouchEvidence(SkinPhysics.of(Bundle.load("square16").matrices))).named
    assert sheet().skin.n_electrodes == 16


def test_the_filter_needs_more_for_a_fault_than_for_a_touch_and_lets_go_of_it() -> None:
    states = ForwardFilter()
    nothing: dict[Name, float] = {("untouched",): 0.0, ("touched",): -10.0, ("gain",): -10.0}
    for _ in range(20):
        p = states(nothing, 0.045)
    assert p[("untouched",)] > 0.999
    p = states({("untouched",): -12.0, ("touched",): 0.0, ("gain",): 0.0}, 0.045)  # both explain it alike
    assert p[("touched",)] > 0.95
    states = ForwardFilter()
    p = states({("untouched",): -40.0, ("touched",): -40.0, ("gain",): 0.0}, 0.045)
    assert states.likeliest == ("gain",) and p[("gain",)] > 0.99
    for _ in range(3):
        p = states({("untouched",): 0.0, ("touched",): -10.0, ("gain",): -40.0}, 0.045)
    assert p[("untouched",)] > 0.99


def test_one_frame_that_looks_wrong_at_a_thousand_to_one_is_not_believed_alone() -> None:
    states = ForwardFilter()
    p = states({("untouched",): 0.0, ("gain",): 7.0}, 0.045)
    assert p[("untouched",)] > 0.9
    for _ in range(3):
        p = states({("untouched",): 0.0, ("gain",): 7.0}, 0.045)
    assert p[("gain",)] > 0.9
