"""Outlines and electrodes read from drawings: the figures are those that were drawn."""

import ezdxf
import numpy as np
import pytest

from models import drawing, geometry
from models.outline import GeometryError

ELL = [(10, 10), (110, 10), (110, 60), (60, 60), (60, 110), (10, 110)]
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
