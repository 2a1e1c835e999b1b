"""Outlines and electrodes read from drawings: the figures are those that were drawn."""

from pathlib import Path

import ezdxf
import numpy as np
import pytest

from models import drawing
from models.outline import GeometryError

ELL = [(10, 10), (110, 10), (110, 60), (60, 60), (60, 110), (10, 110)]
ELL_M = np.array(ELL) / 1e3


def dxf(path: Path, draw, units: int = 4) -> Path:
    document = ezdxf.new()
    document.units = units
    draw(document.modelspace())
    document.saveas(path)
    return path


def svg(path: Path, body: str, head: str = 'width="120mm" height="120mm" viewBox="0 0 120 120"') -> Path:
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {head}>{body}</svg>')
    return path


def same_polygon(found: np.ndarray, expected: np.ndarray) -> None:
    """Whichever corner is the first, and wherever the origin is."""
    assert found.shape == expected.shape
    found, expected = found - found.mean(axis=0), expected - expected.mean(axis=0)
    first = int(np.hypot(*(found - expected[0]).T).argmin())
    np.testing.assert_allclose(np.roll(found, -first, axis=0), expected, atol=1e-6)


def test_a_disc_with_its_electrodes_in_dxf(tmp_path):
    angle = 0.3 + 2 * np.pi * np.arange(12) / 12

    def draw(space):
        space.add_circle((100, 50), 30)
        for a in angle[[0, 7, 3, 1, 2, 4, 5, 6, 11, 8, 9, 10]]:  # in no order, but for the first
            space.add_point((100 + 30 * np.cos(a), 50 + 30 * np.sin(a)), dxfattribs={"layer": "Electrodes"})

    found = drawing.read(dxf(tmp_path / "disc.dxf", draw))
    assert found.radius == pytest.approx(0.03, rel=1e-3) and not len(found.corners)
    np.testing.assert_allclose(found.electrodes, 0.03 * np.stack([np.cos(angle), np.sin(angle)], 1), atol=1e-5)


@pytest.mark.parametrize("turned", [False, True])
def test_an_l_as_a_polyline_whichever_way_it_runs(tmp_path, turned):
    corners = ELL[::-1] if turned else ELL
    found = drawing.read(dxf(tmp_path / "l.dxf", lambda s: s.add_lwpolyline(corners, close=True)))
    same_polygon(found.corners, ELL_M)


def test_an_l_as_separate_lines_in_inches(tmp_path):
    def draw(space):
        for a, b in zip(ELL, [*ELL[1:], ELL[0]], strict=True):
            space.add_line(np.array(a) / 25.4, np.array(b) / 25.4)

    same_polygon(drawing.read(dxf(tmp_path / "l.dxf", draw, units=1)).corners, ELL_M)


def test_an_l_in_svg_turned_upright_with_circles_for_electrodes(tmp_path):
    # y of SVG is down: the L as drawn on screen has its long side at the bottom.
    points = " ".join(f"{x},{120 - y}" for x, y in ELL)
    body = f'<g transform="translate(0,0)"><polygon id="skin" points="{points}"/></g>'
    body += '<g id="electrodes"><circle cx="35" cy="110" r="2"/><circle cx="10" cy="60" r="2"/></g>'
    body += '<circle class="electrode" cx="110" cy="85" r="2"/><circle class="electrode" cx="60" cy="35" r="2"/>'
    found = drawing.read(svg(tmp_path / "l.svg", body))
    same_polygon(found.corners, ELL_M)
    origin = found.corners.min(axis=0)
    np.testing.assert_allclose(
        found.electrodes - origin, [[0.025, 0], [0.1, 0.025], [0.05, 0.075], [0, 0.05]], atol=1e-6
    )


def test_a_curve_becomes_a_polygon_within_a_thousandth(tmp_path):
    body = '<path d="M 10 10 H 110 V 60 A 50 50 0 0 1 10 60 Z"/>'  # a square with a half disc
    found = drawing.read(svg(tmp_path / "arch.svg", body))
    x, y = found.corners.T
    area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    assert area == pytest.approx(0.1 * 0.05 + np.pi * 0.05**2 / 2, rel=2e-3)
    assert 8 < len(found.corners) < 80


def test_what_lies_inside_is_counted_not_taken(tmp_path):
    body = '<circle cx="60" cy="60" r="30"/><circle cx="60" cy="60" r="4"/>'
    found = drawing.read(svg(tmp_path / "hole.svg", body))
    assert found.radius == pytest.approx(0.03, rel=1e-3) and found.ignored == 1


def test_the_toml_of_a_drawing_is_that_skin(tmp_path):
    from models import geometry

    found = drawing.read(dxf(tmp_path / "l.dxf", lambda s: s.add_lwpolyline(ELL, close=True)))
    path = tmp_path / "ell.toml"
    path.write_text(drawing.toml("ell", found, {"count": 16, "width": 0.0075, "first": 0.0125}, 0.01, "pairs"))
    skin = geometry.load(path)
    assert skin.n_electrodes == 16 and skin.metres_per_unit == pytest.approx(0.05)
    same_polygon(skin.outline * skin.metres_per_unit, ELL_M)
    np.testing.assert_allclose(skin.widths * skin.metres_per_unit, 0.0075, rtol=1e-3)


@pytest.mark.parametrize(
    ("body", "head", "unit", "message"),
    [
        ('<path d="M 0 0 L 10 0 L 10 10"/>', None, "", "found no closed line, expected the skin's outline: close"),
        ("<rect width='9' height='9'/>", 'viewBox="0 0 9 9"', "", "does not say in which unit .*: give --unit"),
        ("<rect width='9' height='9'/>", 'viewBox="0 0 9 9"', "ell", "unit: found 'ell', expected one of mm"),
        ("<rect width='90' height='90'/><rect width='90' height='90'/>", None, "", "two closed lines of the same size"),
        ("<rect", None, "", "is no SVG file that can be read"),
    ],
)
def test_svg_files_that_show_no_skin(tmp_path, body, head, unit, message):
    path = svg(tmp_path / "wrong.svg", body, head) if head else svg(tmp_path / "wrong.svg", body)
    with pytest.raises(GeometryError, match=message):
        drawing.read(path, unit)


def test_dxf_files_that_show_no_skin(tmp_path):
    square = [(0, 0), (90, 0), (90, 90), (0, 90)]
    silent = dxf(tmp_path / "silent.dxf", lambda s: s.add_lwpolyline(square, close=True), units=0)
    with pytest.raises(GeometryError, match="does not say in which unit"):
        drawing.read(silent)
    assert np.ptp(drawing.read(silent, "mm").corners) == pytest.approx(0.09)
    said = dxf(tmp_path / "said.dxf", lambda s: s.add_lwpolyline(square, close=True))
    with pytest.raises(GeometryError, match="drawn in mm, --unit says m: leave --unit out"):
        drawing.read(said, "m")
    (tmp_path / "text.dxf").write_text("hello")
    for name, message in (("text.dxf", "no DXF file"), ("gone.dxf", "no file"), ("skin.pdf", "expected a drawing")):
        with pytest.raises(GeometryError, match=message):
            drawing.read(tmp_path / name)
