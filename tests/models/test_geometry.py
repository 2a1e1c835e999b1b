"""Skins as data and as drawings: shipped ones are what the recorded data says; one that cannot exist is refused."""

import tomllib

import ezdxf
import numpy as np
import pytest

from models import drawing, geometry
from models.geometry import GeometryError

ELL = [[10, 10], [110, 10], [110, 60], [60, 60], [60, 110], [10, 110]]


def square(**change):
    return tomllib.loads((geometry.SKINS / "square16.toml").read_text()) | change


def drawn(**change):
    """A disc of 60 mm with 12 electrodes, as somebody writes it who has a ruler."""
    electrodes = {"width": 5, "count": 12}
    disc = {"name": "mine", "unit": "mm", "radius": 30, "contact_impedance": 0.01, "electrodes": electrodes} | change
    return {key: value for key, value in disc.items() if value is not None}


def test_shipped_skins_are_those_of_the_recorded_data(reference):
    skin, disc, recorded = geometry.load("square16"), geometry.load("disc16"), reference("hydrogel_disc16")
    centres = skin.point(skin.electrodes)
    np.testing.assert_allclose(centres[:5], [[-0.75, -1], [-0.25, -1], [0.25, -1], [0.75, -1], [1, -0.75]], atol=1e-12)
    assert skin.n_electrodes == 16 and skin.perimeter == 8.0 and 2 * skin.metres_per_unit == pytest.approx(0.1)
    np.testing.assert_allclose(skin.edges[0], [0.15, 0.35])
    xy = recorded["xy"]
    assert disc.inside((xy - (xy.min(0) + xy.max(0)) / 2) / disc.metres_per_unit).all()
    np.testing.assert_array_equal(disc.pattern, recorded["pattern"])


@pytest.mark.parametrize("name", ["square16", "disc16"])
def test_a_skin_comes_back_from_its_dictionary_and_an_arc_from_its_point(name):
    skin = geometry.load(name)
    again = geometry.from_dict(skin.to_dict())
    for field in ("electrodes", "widths", "contact_impedance", "pattern"):
        np.testing.assert_allclose(getattr(again, field), getattr(skin, field), atol=1e-12)
    assert (again.name, again.radius, again.metres_per_unit) == (skin.name, skin.radius, skin.metres_per_unit)
    arcs = np.linspace(0, skin.perimeter, 77, endpoint=False) + 0.003
    np.testing.assert_allclose(skin.curve.arc(skin.point(arcs)), arcs, atol=1e-12)
    np.testing.assert_allclose(skin.curve.distance(skin.point(arcs)), 0, atol=1e-12)
    moved = skin.moved(np.linspace(-0.02, 0.02, 16), 0.02)
    np.testing.assert_allclose(moved.electrodes - skin.electrodes, np.linspace(-0.02, 0.02, 16))
    assert (moved.contact_impedance == 0.02).all() and (skin.contact_impedance != 0.02).all()


def test_skins_drawn_in_millimetres():
    skin = geometry.from_dict(drawn())
    assert skin.metres_per_unit == pytest.approx(0.03) and skin.radius == 1.0
    np.testing.assert_allclose(skin.widths * skin.metres_per_unit, 0.005)
    np.testing.assert_allclose(skin.point(skin.electrodes)[3] * skin.metres_per_unit, [0, 0.03], atol=1e-9)
    places = [[35, 10.4], [110.3, 35], [60, 85], [9.8, 60]]  # read off by eye: they are put on the outline
    ell = geometry.from_dict(drawn(outline=ELL, radius=None, electrodes={"width": 6, "centre": places}))
    metres = ell.point(ell.electrodes) * ell.metres_per_unit
    np.testing.assert_allclose(metres, [[-0.025, -0.05], [0.05, -0.025], [0.0, 0.025], [-0.05, 0.0]], atol=1e-9)
    assert ell.inside([[-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]]).tolist() == [True, True, False]


@pytest.mark.parametrize(("data", "message"), [
    (square(outline=[[-1, -1], [-1, 1], [1, 1], [1, -1]]), "clockwise"),
    (square(outline=[[-1, -1], [1, 1], [1, -1], [-1, 1]]), "sides 0 and 2 of the outline cross"),
    (square(outline=[[-2, -2], [2, -2], [2, 2], [-2, 2]]), "fit -1..1"),
    (square(contact_impedance=0.0), "contact_impedance of electrode 0 must be positive"),
    (square(electrodes={"width": 0.55, "count": 16}), "electrodes 0 and 1 overlap by 0.05"),
    (square(electrodes={"width": 0.1, "centre": [[0.0, 0.5]]}), "electrode 0 at .* is 0.5 away from the outline"),
    (drawn(electrodes={"width": 1, "count": 65}), "count: found 65, expected a whole number of 4 to 64"),
    (drawn(name="../mine"), r"name: found '../mine', expected at most 64 letters, digits"),
    (drawn(unit="miles"), "unit: found 'miles', expected one of m, cm, mm, inch"),
    (drawn(electrodes={"width": 20, "count": 12}), r"overlap by .* \(4.3 mm\): expected a gap .* width smaller"),
])  # fmt: skip
def test_skins_that_cannot_be(data, message):
    with pytest.raises(ValueError, match=message):
        geometry.from_dict(data)


def rounded(decimals):
    at = np.pi * np.arange(16) / 8 + 0.2
    centres = np.round(np.column_stack([np.cos(at), np.sin(at)]), decimals).tolist()
    disc = {"name": f"d{decimals}", "radius": 1.0, "metres_per_unit": 0.06, "contact_impedance": 0.01}
    return disc | {"electrodes": {"width": 0.1, "centre": centres}}


@pytest.mark.parametrize("decimals", [2, 3, 5, 8])
def test_an_electrode_as_far_from_the_outline_as_it_is_rounded_is_on_it(decimals, caplog):
    skin = geometry.from_dict(rounded(decimals))
    assert np.abs(np.diff(skin.electrodes) - np.pi / 8).max() < 2 * 10.0**-decimals
    assert ("as far as they are rounded, are put on it" in caplog.text) == (decimals < 6)
    moved = rounded(decimals)
    moved["electrodes"]["centre"][3][1] += 0.03
    with pytest.raises(GeometryError, match=r"electrode 3 at .* away from the outline"):
        geometry.from_dict(moved)


def test_a_length_in_another_unit_than_is_said_and_a_name_that_is_none(tmp_path):
    path = tmp_path / "mine.toml"
    said = 'name = "mine"\nunit = "m"\nradius = 30\ncontact_impedance = 0.01\n'
    path.write_text(f"{said}[electrodes]\nwidth = 5\ncount = 12\n")
    with pytest.raises(GeometryError, match="found 60 m x 60 m, expected a longer side of 0.005 to 3 m: correct unit"):
        geometry.load(path)
    with pytest.raises(GeometryError, match="no skin 'hexagon6': expected one of disc16, square16"):
        geometry.load("hexagon6")


ELL_M = np.array(ELL) / 1e3


def dxf(path, draw, units=4):
    document = ezdxf.new()
    document.units = units
    draw(document.modelspace())
    document.saveas(path)
    return path


def svg(path, body, head='width="120mm" height="120mm" viewBox="0 0 120 120"'):
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {head}>{body}</svg>')
    return path


def same_polygon(found, expected):
    """Whichever corner is the first, and wherever the origin is."""
    found, expected = found - found.mean(axis=0), expected - expected.mean(axis=0)
    first = int(np.hypot(*(found - expected[0]).T).argmin())
    np.testing.assert_allclose(np.roll(found, -first, axis=0), expected, atol=1e-6)


def test_an_l_as_a_polyline_as_lines_in_inches_and_as_the_toml_of_its_skin(tmp_path):
    def lines(space):
        space.add_point((35 / 25.4, 10 / 25.4), dxfattribs={"layer": "Electrodes"})
        for a, b in zip(ELL, [*ELL[1:], ELL[0]], strict=True):
            space.add_line(np.array(a) / 25.4, np.array(b) / 25.4)

    found = drawing.read(dxf(tmp_path / "l.dxf", lambda s: s.add_lwpolyline(ELL[::-1], close=True)))
    in_inches = drawing.read(dxf(tmp_path / "i.dxf", lines, units=1))
    np.testing.assert_allclose(in_inches.electrodes - in_inches.corners.min(axis=0), [[0.025, 0.0]], atol=1e-6)
    for each in (found, in_inches):
        same_polygon(each.corners, ELL_M)
    path = tmp_path / "ell.toml"
    path.write_text(drawing.toml("ell", found, {"count": 16, "width": 0.0075, "first": 0.0125}, 0.01, "pairs"))
    skin = geometry.load(path)
    assert skin.n_electrodes == 16 and skin.metres_per_unit == pytest.approx(0.05)
    same_polygon(skin.outline * skin.metres_per_unit, ELL_M)
    np.testing.assert_allclose(skin.widths * skin.metres_per_unit, 0.0075, rtol=1e-3)


def test_svg_is_turned_upright_and_what_lies_inside_is_counted(tmp_path):
    """y of SVG is down."""
    points = " ".join(f"{x},{120 - y}" for x, y in ELL)
    body = f'<polygon id="skin" points="{points}"/>'
    body += '<g id="electrodes"><circle cx="35" cy="110" r="2"/><circle cx="10" cy="60" r="2"/></g>'
    body += '<circle class="electrode" cx="110" cy="85" r="2"/><circle class="electrode" cx="60" cy="35" r="2"/>'
    found = drawing.read(svg(tmp_path / "l.svg", body))
    same_polygon(found.corners, ELL_M)
    electrodes = found.electrodes - found.corners.min(axis=0)
    np.testing.assert_allclose(electrodes, [[0.025, 0], [0.1, 0.025], [0.05, 0.075], [0, 0.05]], atol=1e-6)


def test_files_that_show_no_skin(tmp_path):
    for body, head, message in (
        ('<path d="M 0 0 L 10 0 L 10 10"/>', (), "found no closed line, expected the skin's outline: close"),
        ("<rect width='9' height='9'/>", ('viewBox="0 0 9 9"',), "does not say in which unit .*: give --unit"),
        ("<rect", (), "is no SVG file that can be read"),
    ):
        with pytest.raises(GeometryError, match=message):
            drawing.read(svg(tmp_path / "wrong.svg", body, *head))
    with pytest.raises(GeometryError, match="drawn in mm, --unit says m"):
        drawing.read(dxf(tmp_path / "a.dxf", lambda s: s.add_lwpolyline(ELL, close=True)), "m")
