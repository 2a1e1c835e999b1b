"""`skin new`: a skin of one's own in one command, and what it says where that skin cannot be."""

import json
import re

import pytest

from models import geometry

DRAWING = """<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">
<path d="M 0 0 L 50 0 L 50 50 L 100 50 L 100 100 L 0 100 Z M 10 70 L 20 80"/><circle cx="20" cy="80" r="3"/></svg>"""


def test_a_disc_and_a_drawing(skin, tmp_path):
    """An L, by a path of several lines of which one is closed."""
    ran = skin("new", "my-skin", "--disc", 0.06, "--electrodes", 12, "--out", tmp_path, "--json")
    said = json.loads(ran.out)
    assert ran.code == 0 and (said["electrodes"], said["measurements"], said["size_mm"]) == (12, 66, [60, 60])
    assert geometry.load(tmp_path / "my-skin.toml").metres_per_unit == pytest.approx(0.03)
    again = skin("new", "my-skin", "--disc", 0.06, "--out", tmp_path)
    assert again.code == 2 and "is there already: choose another name, or give --overwrite" in again.err
    (tmp_path / "ell.svg").write_text(DRAWING)
    ran = skin("new", "ell", "--outline", tmp_path / "ell.svg", "--first", 0.0125, "--out", tmp_path)
    assert ran.code == 0 and "a polygon of 6 corners, 100 x 100 mm, 16 electrodes 7.5 mm wide" in ran.out, ran.err
    assert "1 closed lines inside the outline were left out" in ran.out
    corner = geometry.load(tmp_path / "ell.toml").inside([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5]])
    assert corner.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mine --disc 60", "found 60 m x 60 m, expected a longer side of 0.005 to 3 m: --disc takes metres"),
        ("mine --disc 0.06 --electrodes 3", "--electrodes 3 electrodes: expected 4 to 64"),
        (
            "mine --disc 0.12 --electrodes 32 --pattern adjacent",
            r"'adjacent' are 928 measurements, at most 512 .* 'pairs' \(496\) or at most 24 electrodes with 'adjacent'",
        ),
        ("mine --disc 0.12 --electrodes 33", "are 528 measurements, at most 512 .* choose at most 32 electrodes with"),
        ("mine", "give either --disc METRES .* or --outline FILE"),
        ("My_Skin --disc 0.06", "found the name 'My_Skin', expected lower-case letters"),
    ],
)
def test_what_cannot_be(skin, tmp_path, words, message):
    ran = skin("new", *words.split(), "--out", tmp_path)
    assert ran.code == 2 and not list(tmp_path.iterdir()) and re.search(message, ran.err), ran.err
