"""The forward model against EIDORS, the analytic disc and its own properties; drive patterns against recorded ones."""

import numpy as np
import pytest

from models import geometry, meshing, patterns
from models.analytic import disc_impedances
from models.forward import ForwardModel, shared
from models.patterns import PatternError
from models.shapes import Shape, from_rows
from models.symmetries import symmetries

PATTERNS = ("pairs", "adjacent")


@pytest.fixture(scope="module")
def training():
    return shared("square16", "training")


@pytest.fixture(scope="module")
def coarse():
    return shared("square16", "inverse")


def off(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def test_training_mesh_against_eidors(training, reference):
    eidors, untouched, errors = reference("eidors_reference"), training.solve(), {}
    for name in PATTERNS:
        np.testing.assert_allclose(untouched.impedances(name), eidors[f"impedance_{name}"][0], rtol=0.01)
    for i, scene in enumerate(eidors["scene"][1:], start=1):
        conductivity = training.touched(from_rows(eidors["shapes"][i]), eidors["conductivity"][i])
        touched = training.solve(conductivity, eidors["contact_impedance"][i])
        for name in PATTERNS:
            z, z0 = eidors[f"impedance_{name}"][[i, 0]]
            errors[scene, name] = off(touched.impedances(name) / untouched.impedances(name) - 1, z / z0 - 1)
    touches = {key: error for key, error in errors.items() if not key[0].startswith("J")}
    assert max(touches.values()) < 0.0055, max(touches, key=touches.get)
    assert np.median([error for (_, name), error in touches.items() if name == "pairs"]) < 0.0015


def test_disc_against_analytic_solution():
    model = ForwardModel("disc16")
    model.laminate = 1.0  # the exact limit, not what another solver's grid gives
    untouched, touched = model.solve(), model.solve(model.touched([Shape("circle", 0, 0, 0.4, 0.5)]))
    for pattern, tolerance in (("pairs", 0.006), ("adjacent", 0.002), ("opposite", 0.001)):
        skin = model.skin.with_pattern(pattern)
        whole, hollow = disc_impedances(skin, terms=3000), disc_impedances(skin, 0.4, 0.5, terms=3000)
        np.testing.assert_allclose(untouched.impedances(pattern), whole, rtol=tolerance)
        assert off(touched.impedances(pattern) - untouched.impedances(pattern), hollow - whole) < 0.002


def test_reciprocity_scaling_and_isotropic_tensors(coarse):
    sigma = np.random.default_rng(1).uniform(0.5, 1.5, coarse.n_elements)
    solution, rows = coarse.solve(sigma), coarse.skin.with_pattern("adjacent").pattern
    there, back = solution.impedances(rows), solution.impedances(rows[:, [2, 3, 0, 1]])
    np.testing.assert_allclose(there, back, rtol=1e-10, atol=0)
    np.testing.assert_allclose(solution.transfer, solution.transfer.T, atol=1e-12)
    z = coarse.solve(1.0, 0.01).impedances()
    np.testing.assert_allclose(coarse.solve(2.0, 0.005).impedances(), z / 2, rtol=1e-12)
    tensor = np.column_stack([sigma, 0 * sigma, sigma])
    np.testing.assert_allclose(coarse.solve(tensor).impedances(), solution.impedances(), rtol=1e-11)


def test_symmetries_are_those_of_the_forward_model_and_of_nothing_else(coarse):
    """The difference of a turned touch is the permuted difference of the touch; meshes are not symmetric: 1 %."""
    z0, skin = np.abs(coarse.solve(1.0).impedances()), coarse.skin

    def difference(image):
        return np.abs(coarse.solve(1 - coarse.element_map(96) @ image.ravel()).impedances()) / z0 - 1

    image = 0.4 * Shape("triangle", 0.3, -0.5, 0.3, 0.4, 0.4).fraction(96)
    d, found = difference(image), symmetries(skin.to_dict(), skin.pattern)
    assert len(found) == 8
    for symmetry in found:
        assert off(d[symmetry.measurements], difference(symmetry.turn.image(image))) < 0.015
    moved, disc = skin.moved(np.r_[0.05, np.zeros(15)]), geometry.load("disc16")
    other_contact = skin.to_dict() | {"contact_impedance": [0.1, *[0.01] * 15]}
    assert len(symmetries(moved.to_dict(), moved.pattern)) == len(symmetries(other_contact, skin.pattern)) == 1
    on_disc = [s.measurements for s in symmetries(disc.to_dict(), disc.pattern)]
    assert len(on_disc) == 8 and all((np.sort(measurements) == np.arange(192)).all() for measurements in on_disc)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_jacobians_against_finite_differences(coarse, pattern):
    rng, step = np.random.default_rng(2), 1e-4
    sigma, contact = rng.uniform(0.6, 1.4, coarse.n_elements), rng.uniform(0.005, 0.02, 16)
    toward, towards_contact = rng.standard_normal(coarse.n_elements), contact * rng.standard_normal(16)
    solution = coarse.solve(sigma, contact)

    def slope(a, b):
        more, less = (coarse.solve(sigma + s * a, contact + s * b).impedances(pattern) for s in (step, -step))
        return (more - less) / (2 * step)

    for found, expected in (
        (solution.jacobian(pattern) @ toward, slope(toward, 0.0)),
        (solution.jacobian_contact(pattern) @ towards_contact, slope(0.0, towards_contact)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_touches_and_pixels_keep_their_integral_and_place(training, coarse):
    shape, x = Shape("L", 0.2, -0.3, 0.4, 0.3, 0.7), coarse.centroids[:, 0]
    drop = 1 - training.touched([shape])[:, [0, 2]].mean(axis=1)
    assert drop @ training.areas == pytest.approx(shape.integral, rel=0.02)
    expected = -1 + 2 * (np.arange(24) + 0.5) / 24
    np.testing.assert_allclose((coarse.pixel_map(24) @ x).reshape(24, 24)[10], expected, atol=0.03)
    np.testing.assert_allclose(coarse.element_map(24) @ np.tile(expected, 24), x, atol=0.05)


def test_meshes_differ_are_reproducible_and_have_electrode_ends_as_nodes(training, coarse):
    stub = meshing.build(training.skin, "stub")
    shared_nodes = set(map(tuple, training.mesh.p.T)) & set(map(tuple, stub.p.T))
    assert len(shared_nodes) < 0.05 * stub.p.shape[1]  # corners and electrode ends
    np.testing.assert_array_equal(meshing.build(coarse.skin, "inverse").p, coarse.mesh.p)
    skin = coarse.skin.moved(np.linspace(-0.03, 0.03, 16))
    ends = skin.point(skin.edges.ravel())
    assert np.linalg.norm(ends[:, None] - meshing.build(skin, "inverse").p.T, axis=2).min(axis=1).max() < 1e-12
    with pytest.raises(ValueError, match="conductivity must be positive and finite everywhere, found -0.1"):
        coarse.solve(np.full(coarse.n_elements, -0.1))


def test_orders_of_the_recorded_data(reference):
    np.testing.assert_array_equal(patterns.pairs()[:, :2] + 1, reference("eidors_reference")["pairs"])
    np.testing.assert_array_equal(patterns.adjacent() + 1, reference("eidors_reference")["adjacent"])
    np.testing.assert_array_equal(patterns.opposite(), reference("hydrogel_disc16")["pattern"])


def test_counts_and_ranks():
    """n(n-1)/2 numbers describe the electrodes; adjacent without the driving ones loses n of them."""
    for n, counts in ((8, (28, 40, 32)), (16, (120, 208, 192))):
        assert tuple(len(patterns.pattern(name, n)) for name in ("pairs", "adjacent", "opposite")) == counts
    assert patterns.rank(patterns.pairs()) == 120 and patterns.rank(patterns.adjacent()) == 104


@pytest.mark.parametrize(("rows", "message"), [
    ([(0, 16, 1, 2)], "measurement 0 .* names electrode 16"),
    ([(3, 3, 1, 2)], "drives an electrode against itself"),
    ([(0, 3, 2, 2)], "senses an electrode against itself"),
    ([(0, 1, 2, 3)], "never uses electrode 4"),
    ([(i, (i + 1) % 16, i, (i + 1) % 16) for i in range(16)], "rank 16, at least 52"),
])  # fmt: skip
def test_patterns_that_are_refused(rows, message):
    with pytest.raises(PatternError, match=message):
        patterns.pattern(rows)
    with pytest.raises(PatternError, match="even number of electrodes, found 15"):
        patterns.opposite(15)
