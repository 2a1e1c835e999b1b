"""Skins as data: the shipped ones are what the recorded data says, and a skin that cannot exist is refused by name."""

import copy
import tomllib

import numpy as np
import pytest

from models import geometry
from models.geometry import GeometryError


def square():
    return tomllib.loads((geometry.SKINS / "square16.toml").read_text())


def test_square16_is_the_published_skin():
    skin = geometry.load("square16")
    centres = skin.point(skin.electrodes)
    np.testing.assert_allclose(centres[:5], [[-0.75, -1], [-0.25, -1], [0.25, -1], [0.75, -1], [1, -0.75]], atol=1e-12)
    assert skin.n_electrodes == 16 and skin.perimeter == 8.0
    assert 2 * skin.metres_per_unit == pytest.approx(0.1)
    np.testing.assert_allclose(skin.edges[0], [0.15, 0.35])
    assert len(skin.pattern) == 120


def test_disc16_holds_all_recorded_presses(reference):
    skin = geometry.load("disc16")
    xy = reference("hydrogel_disc16")["xy"]
    assert skin.inside((xy - (xy.min(0) + xy.max(0)) / 2) / skin.metres_per_unit).all()
    np.testing.assert_array_equal(skin.pattern, reference("hydrogel_disc16")["pattern"])


@pytest.mark.parametrize("name", ["square16", "disc16"])
def test_dictionary_round_trip(name):
    skin = geometry.load(name)
    again = geometry.from_dict(skin.to_dict())
    for field in ("electrodes", "widths", "contact_impedance", "pattern"):
        np.testing.assert_allclose(getattr(again, field), getattr(skin, field), atol=1e-12)
    assert (again.name, again.radius, again.metres_per_unit) == (skin.name, skin.radius, skin.metres_per_unit)


@pytest.mark.parametrize("name", ["square16", "disc16"])
def test_arc_is_the_inverse_of_point(name):
    skin = geometry.load(name)
    arcs = np.linspace(0, skin.perimeter, 77, endpoint=False) + 0.003
    np.testing.assert_allclose(skin.curve.arc(skin.point(arcs)), arcs, atol=1e-12)
    np.testing.assert_allclose(skin.curve.distance(skin.point(arcs)), 0, atol=1e-12)


def test_inside_an_l_shaped_skin():
    data = square() | {"outline": [[-1, -1], [1, -1], [1, 0], [0, 0], [0, 1], [-1, 1]]}
    data["electrodes"] = {"width": 0.1, "count": 12}
    skin = geometry.from_dict(data)
    assert skin.inside([[-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]]).tolist() == [True, True, False]


def test_moved_electrodes():
    skin = geometry.load("square16")
    shift = np.linspace(-0.02, 0.02, 16)
    moved = skin.moved(shift, 0.02)
    np.testing.assert_allclose(moved.electrodes - skin.electrodes, shift)
    assert (moved.contact_impedance == 0.02).all() and (skin.contact_impedance == 0.01).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"outline": [[-1, -1], [-1, 1], [1, 1], [1, -1]]}, "clockwise"),
        ({"outline": [[-1, -1], [1, 1], [1, -1], [-1, 1]]}, "sides 0 and 2 of the outline cross"),
        ({"outline": [[-1, -1], [1, -1]]}, "at least three corners"),
        ({"outline": [[-2, -2], [2, -2], [2, 2], [-2, 2]]}, "fit -1..1"),
        ({"outline": [[-1, -1], [-1, -1], [1, -1], [1, 1]]}, "corner 0 of the outline is given twice"),
        ({"radius": 1.0}, "either outline .* or radius"),
        ({"contact_impedance": 0.0}, "contact_impedance of electrode 0 must be positive"),
        ({"contact_impedance": [0.01] * 15}, "15 entries for 16 electrodes"),
        ({"metres_per_unit": -1.0}, "metres_per_unit must be positive"),
        ({"metres": 0.1}, "unknown key 'metres'"),
        ({"electrodes": {"width": 0.55, "count": 16}}, "electrodes 0 and 1 overlap by 0.05"),
        ({"electrodes": {"width": 0.1, "count": 3}}, "at least four electrodes"),
        ({"electrodes": {"width": 0.1}}, "either centre"),
        ({"electrodes": {"width": 0.1, "centre": [[0.0, 0.5]]}}, "electrode 0 at .* is 0.5 away from the outline"),
        ({"electrodes": {"width": "wide", "count": 16}}, "could not convert"),
        ({"pattern": "spiral"}, "unknown pattern 'spiral'"),
    ],
)
def test_impossible_skins(change, message):
    with pytest.raises(ValueError, match=message) as error:
        geometry.from_dict(copy.deepcopy(square()) | change)
    assert "skin 'square16'" in str(error.value) or "pattern" in str(error.value)


def test_a_missing_key_and_a_missing_file():
    data = square()
    del data["contact_impedance"]
    with pytest.raises(GeometryError, match="missing key 'contact_impedance'"):
        geometry.from_dict(data)
    with pytest.raises(GeometryError, match="no skin 'hexagon6': expected one of disc16, square16"):
        geometry.load("hexagon6")


def drawn(**change):
    """A disc of 60 mm with 12 electrodes, as somebody writes it who has a ruler."""
    return {
        "name": "mine",
        "unit": "mm",
        "radius": 30,
        "contact_impedance": 0.01,
        "electrodes": {"width": 5, "count": 12},
    } | change


def test_a_skin_in_millimetres():
    skin = geometry.from_dict(drawn())
    assert skin.metres_per_unit == pytest.approx(0.03) and skin.radius == 1.0
    np.testing.assert_allclose(skin.widths * skin.metres_per_unit, 0.005)
    np.testing.assert_allclose(skin.point(skin.electrodes)[3] * skin.metres_per_unit, [0, 0.03], atol=1e-9)
    again = geometry.from_dict(skin.to_dict())
    np.testing.assert_allclose(again.electrodes, skin.electrodes, atol=1e-9)


def test_a_drawn_outline_is_centred_and_its_electrodes_put_on_it():
    ell = [[10, 10], [110, 10], [110, 60], [60, 60], [60, 110], [10, 110]]
    places = [[35, 10.4], [110.3, 35], [60, 85], [9.8, 60]]  # read off by eye
    data = drawn(outline=ell, electrodes={"width": 6, "centre": places})
    del data["radius"]
    skin = geometry.from_dict(data)
    assert skin.metres_per_unit == pytest.approx(0.05)
    metres = skin.point(skin.electrodes) * skin.metres_per_unit
    np.testing.assert_allclose(metres, [[-0.025, -0.05], [0.05, -0.025], [0.0, 0.025], [-0.05, 0.0]], atol=1e-9)


def test_the_first_of_evenly_spaced_electrodes_may_be_elsewhere():
    skin = geometry.from_dict(drawn(electrodes={"width": 5, "count": 12, "first": np.pi * 30 / 2}))
    np.testing.assert_allclose(skin.point(skin.electrodes)[0], [0, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unit": "miles"}, "unit: found 'miles', expected one of m, cm, mm, inch"),
        ({"radius": 0}, "radius: found 0.0, expected a length above 0"),
        ({"metres_per_unit": 0.03}, "unknown key 'metres_per_unit'"),
        ({"electrodes": {"width": 20, "count": 12}}, r"overlap by .* \(4.3 mm\): expected a gap .* width smaller"),
        (
            {"electrodes": {"width": 5, "centre": [[20, 0]] * 4}},
            r"away from the outline \(10 mm\): expected",
        ),
        ({"electrodes": {"width": 5, "count": 12.5}}, "count: found 12.5, expected a whole number"),
        ({"electrodes": {"width": 5, "count": 12, "offset": 1}}, "unknown key 'offset'; expected width"),
        ({"electrodes": 12}, r"electrodes: found 12, expected a table \[electrodes\]"),
    ],
)
def test_impossible_skins_in_millimetres(change, message):
    with pytest.raises(GeometryError, match=message):
        geometry.from_dict(drawn(**change))


@pytest.mark.parametrize(("unit", "found"), [("m", "found 60 m x 60 m"), ("mm", "found 6e-05 m x 6e-05 m")])
def test_a_length_in_another_unit_than_is_said(tmp_path, unit, found):
    path = tmp_path / "mine.toml"
    radius = 30 if unit == "m" else 0.03
    path.write_text(
        f'name = "mine"\nunit = "{unit}"\nradius = {radius}\ncontact_impedance = 0.01\n'
        f"[electrodes]\nwidth = {radius / 6}\ncount = 12\n"
    )
    with pytest.raises(
        GeometryError, match=f"{found}, expected a longer side of 0.005 to 3 m: correct unit = '{unit}'"
    ):
        geometry.load(path)
