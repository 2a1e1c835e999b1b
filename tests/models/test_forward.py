"""The forward model against EIDORS, against the analytic disc, and against properties it must have."""

from itertools import pairwise
from time import process_time

import numpy as np
import pytest
from skfem import MeshTri

from models import geometry, meshing
from models.analytic import disc_impedances
from models.forward import ForwardModel
from models.meshing import Grading
from models.shapes import Shape, from_rows

PATTERNS = ("pairs", "adjacent")


@pytest.fixture(scope="module")
def training():
    return ForwardModel("square16", mesh="training")


@pytest.fixture(scope="module")
def coarse():
    return ForwardModel("square16", mesh="inverse")


@pytest.fixture(scope="module")
def fine():
    return ForwardModel("square16", mesh="reference")


@pytest.fixture(scope="module")
def eidors(reference):
    return reference("eidors_reference")


def scene(model, data, i):
    """The solution of one of the reference's scenes."""
    touched = model.touched(from_rows(data["shapes"][i]), data["conductivity"][i])
    return model.solve(touched, data["contact_impedance"][i])


def off(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


# --- against EIDORS ---


@pytest.mark.release
def test_reference_mesh_against_eidors(fine, eidors):
    untouched = fine.solve()
    for name in PATTERNS:
        np.testing.assert_allclose(untouched.impedances(name), eidors[f"impedance_{name}"][0], rtol=0.003)
    for i in [list(eidors["scene"]).index(s) for s in ("B0", "C24", "F2", "F6", "F7", "G1", "H0", "J0", "J1")]:
        touched = scene(fine, eidors, i)
        for name in PATTERNS:
            expected = eidors[f"impedance_{name}"][i] - eidors[f"impedance_{name}"][0]
            error = off(touched.impedances(name) - untouched.impedances(name), expected)
            assert error < 0.01, (eidors["scene"][i], name)


def test_training_mesh_against_eidors(training, eidors):
    untouched = training.solve()
    errors = {}
    for name in PATTERNS:
        np.testing.assert_allclose(untouched.impedances(name), eidors[f"impedance_{name}"][0], rtol=0.01)
    for i in range(1, len(eidors["scene"])):
        touched = scene(training, eidors, i)
        for name in PATTERNS:
            z, z0 = eidors[f"impedance_{name}"][[i, 0]]
            errors[eidors["scene"][i], name] = off(
                touched.impedances(name) / untouched.impedances(name) - 1, z / z0 - 1
            )
    touches = {key: error for key, error in errors.items() if not key[0].startswith("J")}
    assert max(touches.values()) < 0.0055, max(touches, key=touches.get)
    assert np.median([error for (_, name), error in touches.items() if name == "pairs"]) < 0.0015


@pytest.mark.release
def test_training_mesh_against_reference_mesh(training, fine):
    shapes = [[Shape("rectangle", 0.5, -0.47, 0.25, 0.39, 2.91, 2.24)], [Shape("circle", -0.6, 0.6, 0.2, 0.15)]]
    relative = [
        [m.solve(m.touched(s)).impedances() / m.solve().impedances() - 1 for s in shapes] for m in (training, fine)
    ]
    for coarse_one, fine_one in zip(*relative, strict=True):
        assert off(coarse_one, fine_one) < 0.005


# --- against the analytic disc ---


def test_disc_against_analytic_solution():
    model = ForwardModel("disc16")
    model.laminate = 1.0  # the exact limit, not what another solver's grid gives
    untouched, touched = model.solve(), model.solve(model.touched([Shape("circle", 0, 0, 0.4, 0.5)]))
    for pattern, tolerance in (("pairs", 0.006), ("adjacent", 0.002), ("opposite", 0.001)):
        skin = model.skin.with_pattern(pattern)
        whole, hollow = disc_impedances(skin, terms=3000), disc_impedances(skin, 0.4, 0.5, terms=3000)
        np.testing.assert_allclose(untouched.impedances(pattern), whole, rtol=tolerance)
        assert off(touched.impedances(pattern) - untouched.impedances(pattern), hollow - whole) < 0.002


def test_convergence_order():
    """Halving the spacing everywhere halves the error of the pairs' impedances at least."""
    skin = geometry.load("disc16").with_pattern("pairs")
    exact = disc_impedances(skin)
    grades = [Grading(8e-3 / 2**k, 0.8 / 2**k, 0.12 / 2**k, 0.0) for k in range(3)]
    errors = [np.abs(ForwardModel(skin, mesh=g).solve().impedances() / exact - 1).max() for g in grades]
    orders = [np.log2(a / b) for a, b in pairwise(errors)]
    assert min(orders) > 1.2, (errors, orders)


def test_contact_impedance_alone():
    """Between the two ends of a strip the sheet is in series with the contacts: exact, the current is uniform."""
    data = {
        "name": "bar",
        "outline": [[-1, -0.1], [1, -0.1], [1, 0.1], [-1, 0.1]],
        "metres_per_unit": 0.05,
        "contact_impedance": [0.03, 0.5, 0.07, 0.5],
        "pattern": [[2, 0, 2, 0], [1, 3, 1, 3], [0, 1, 0, 1], [0, 3, 0, 3], [1, 2, 1, 2]],
        "electrodes": {
            "width": [0.2, 1e-3, 0.2, 1e-3],
            "centre": [[1, 0], [0.9, 0.1], [-1, 0], [0.9, -0.1]],
        },
    }
    model = ForwardModel(geometry.from_dict(data), mesh="inverse")
    # length over width and conductivity, and each contact's impedance over its width
    assert model.solve(2.0).impedances()[0] == pytest.approx(2 / 0.2 / 2 + (0.03 + 0.07) / 0.2, rel=2e-4)


# --- properties ---


def test_reciprocity_and_symmetry(coarse):
    sigma = np.random.default_rng(1).uniform(0.5, 1.5, coarse.n_elements)
    solution = coarse.solve(sigma)
    rows = coarse.skin.with_pattern("adjacent").pattern
    there, back = solution.impedances(rows), solution.impedances(rows[:, [2, 3, 0, 1]])
    np.testing.assert_allclose(there, back, rtol=1e-10, atol=0)
    np.testing.assert_allclose(solution.transfer, solution.transfer.T, atol=1e-12)


def test_a_turned_scene_gives_turned_impedances(training):
    """A quarter turn of the square is electrode k -> k + 4; what differs is the mesh's own asymmetry."""
    here, turned = Shape("triangle", 0.5, 0.2, 0.3, 0.4, 0.3), Shape("triangle", -0.2, 0.5, 0.3, 0.4, 0.3 + np.pi / 2)
    rows = training.pattern
    untouched = training.solve()
    a = training.solve(training.touched([here])).impedances(rows) / untouched.impedances(rows) - 1
    shifted = (rows + 4) % 16
    b = training.solve(training.touched([turned])).impedances(shifted) / untouched.impedances(shifted) - 1
    assert off(a, b) < 0.003


def test_scaling(coarse):
    """Twice the conductivity and half the contact impedance is half the impedance."""
    z = coarse.solve(1.0, 0.01).impedances()
    np.testing.assert_allclose(coarse.solve(2.0, 0.005).impedances(), z / 2, rtol=1e-12)


@pytest.mark.parametrize("pattern", ["pairs", "adjacent"])
def test_jacobians_against_finite_differences(coarse, pattern):
    rng = np.random.default_rng(2)
    sigma, contact = rng.uniform(0.6, 1.4, coarse.n_elements), rng.uniform(0.005, 0.02, 16)
    toward, step = rng.standard_normal(coarse.n_elements), 1e-4
    solution = coarse.solve(sigma, contact)

    def z(k, c=0.0):
        return coarse.solve(sigma + k * toward, contact + c * towards_contact).impedances(pattern)

    towards_contact = contact * rng.standard_normal(16)
    expected = (z(step) - z(-step)) / (2 * step)
    np.testing.assert_allclose(
        solution.jacobian(pattern) @ toward, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max()
    )
    expected = (z(0, step) - z(0, -step)) / (2 * step)
    np.testing.assert_allclose(
        solution.jacobian_contact(pattern) @ towards_contact, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max()
    )


def test_isotropic_tensors_are_scalars(coarse):
    sigma = np.random.default_rng(3).uniform(0.5, 1.5, coarse.n_elements)
    tensor = np.column_stack([sigma, 0 * sigma, sigma])
    np.testing.assert_allclose(coarse.solve(tensor).impedances(), coarse.solve(sigma).impedances(), rtol=1e-11)


def test_touched_keeps_the_integral(training):
    shape = Shape("L", 0.2, -0.3, 0.4, 0.3, 0.7)
    training_drop = 1 - training.touched([shape])[:, [0, 2]].mean(axis=1)
    assert training_drop @ training.areas == pytest.approx(shape.integral, rel=0.02)
    np.testing.assert_allclose(training.touched([shape], 1.1), 1.1 * training.touched([shape]))


def test_pixels_and_elements(coarse):
    x = coarse.centroids[:, 0]
    image = (coarse.pixel_map(24) @ x).reshape(24, 24)
    expected = -1 + 2 * (np.arange(24) + 0.5) / 24
    np.testing.assert_allclose(image[10], expected, atol=0.03)
    np.testing.assert_allclose(np.asarray(coarse.pixel_map(24).sum(axis=1)).ravel(), 1, atol=1e-12)
    np.testing.assert_allclose(coarse.element_map(24) @ np.tile(expected, 24), x, atol=0.05)
    disc = ForwardModel("disc16", mesh="inverse").pixel_map(24)
    assert np.asarray(disc.sum(axis=1)).reshape(24, 24)[0, 0] == 0


def test_solves_per_second(training):
    training.solve()
    times = []
    for _ in range(5):
        start = process_time()
        training.solve()
        times.append(process_time() - start)
    assert min(times) < 1 / 20


# --- meshes ---


def test_meshes_differ_and_are_reproducible(training, coarse):
    assert training.n_elements in range(15_000, 20_000)
    stub = meshing.build(training.skin, "stub")
    assert len({m.p.shape[1] for m in (training.mesh, coarse.mesh, stub)}) == 3
    shared_nodes = set(map(tuple, training.mesh.p.T)) & set(map(tuple, stub.p.T))
    assert len(shared_nodes) < 0.05 * stub.p.shape[1]  # corners and electrode ends
    np.testing.assert_array_equal(meshing.build(coarse.skin, "inverse").p, coarse.mesh.p)


def test_electrode_ends_are_nodes_also_when_moved():
    skin = geometry.load("square16").moved(np.linspace(-0.03, 0.03, 16))
    mesh = meshing.build(skin, "inverse")
    ends = skin.point(skin.edges.ravel())
    distance = np.linalg.norm(ends[:, None] - mesh.p.T, axis=2).min(axis=1)
    assert distance.max() < 1e-12


def test_any_polygon():
    skin = geometry.from_dict(
        {
            "name": "glove",
            "outline": [[-1, -1], [1, -1], [1, 0.2], [0.3, 0], [0.3, 1], [-0.8, 0.9]],
            "metres_per_unit": 0.05,
            "contact_impedance": 0.01,
            "electrodes": {"width": 0.15, "count": 11},
        }
    )
    model = ForwardModel(skin, mesh="inverse")
    assert model.areas.sum() == pytest.approx(3.105, rel=1e-9)  # the shoelace formula
    z = model.solve().impedances()
    assert len(z) == 55 and (z > 0).all()


def test_bad_input_is_named(coarse):
    with pytest.raises(ValueError, match="conductivity must be positive and finite everywhere, found -0.1"):
        coarse.solve(np.full(coarse.n_elements, -0.1))
    with pytest.raises(ValueError, match=r"conductivity has shape \(3,\)"):
        coarse.solve(np.ones(3))
    with pytest.raises(ValueError, match=r"contact impedance has shape \(15,\)"):
        coarse.solve(1.0, np.full(15, 0.01))
    with pytest.raises(ValueError, match="unknown mesh 'fine': expected one of training"):
        ForwardModel("square16", mesh="fine")
    with pytest.raises(ValueError, match="both its ends must be nodes"):
        ForwardModel("square16", mesh=MeshTri().scaled(2.0).translated((-1.0, -1.0)).refined(3))
