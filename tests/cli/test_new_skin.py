"""`skin new`: a skin of one's own in one command, and what it says where that skin cannot be."""

import json
import re
from pathlib import Path

import pytest

from models import geometry


def test_a_disc_of_twelve_electrodes(skin, tmp_path):
    ran = skin("new", "my-skin", "--disc", 0.06, "--electrodes", 12, "--out", tmp_path, "--json")
    said = json.loads(ran.out)
    assert ran.code == 0 and (said["electrodes"], said["measurements"], said["size_mm"]) == (12, 66, [60, 60])
    made = geometry.load(tmp_path / "my-skin.toml")
    assert made.n_electrodes == 12 and made.metres_per_unit == pytest.approx(0.03)
    again = skin("new", "my-skin", "--disc", 0.06, "--out", tmp_path)
    assert again.code == 2 and "is there already: choose another name, or give --overwrite" in again.err
    assert (
        "next: make train SKIN=my-skin" in skin("new", "my-skin", "--disc", 0.06, "--out", tmp_path, "--overwrite").out
    )


def test_a_drawing(skin, tmp_path):
    (tmp_path / "l.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">'
        '<path d="M 0 0 H 50 V 50 H 100 V 100 H 0 Z"/><circle cx="20" cy="80" r="3"/></svg>'
    )
    ran = skin("new", "ell", "--outline", tmp_path / "l.svg", "--first", 0.0125, "--out", tmp_path)
    assert ran.code == 0 and "a polygon of 6 corners, 100 x 100 mm, 16 electrodes 7.5 mm wide" in ran.out
    assert "1 closed lines inside the outline were left out" in ran.out
    corner = geometry.load(tmp_path / "ell.toml").inside([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5]])
    assert corner.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--disc", 60), "found 60 m x 60 m, expected a longer side of 0.005 to 3 m: --disc takes metres"),
        (("--disc", 0.06, "--electrodes", 3), "--electrodes 3 electrodes: expected 4 to 64"),
        (("--disc", 0.06, "--width", 0.03), "electrodes 0 and 1 overlap by .* make their width smaller"),
        (("--disc", 0.06, "--width", -1), "--width -1: expected metres"),
        (("--disc", 0.06, "--electrodes", 13, "--pattern", "opposite"), "even number of electrodes, found 13"),
        ((), "give either --disc METRES .* or --outline FILE"),
        (("--outline", "gone.svg"), "no file gone.svg: expected a drawing"),
        (("--disc", 0.06, "--out", "/nowhere"), "no folder /nowhere: make it first"),
    ],
)
def test_what_cannot_be(skin, tmp_path: Path, arguments, message):
    out = () if "--out" in arguments else ("--out", tmp_path)
    ran = skin("new", "mine", *arguments, *out)
    assert ran.code == 2 and not list(tmp_path.iterdir())
    assert re.search(message, ran.err), ran.err


def test_a_path_that_lifts_its_pen(skin, tmp_path):
    """One path of several lines, of which one is closed: the drawings of diagrams are made of such."""
    path = tmp_path / "lines.svg"
    lines = "M 0 0 L 100 0 L 100 60 L 0 60 Z M 10 10 L 20 20 M 30 30 L 40 30 L 40 40"
    size = 'width="100mm" height="60mm" viewBox="0 0 100 60"'
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {size}><path d="{lines}"/></svg>')
    ran = skin("new", "pen", "--outline", path, "--out", tmp_path)
    assert ran.code == 0 and "100 x 60 mm" in ran.out, ran.err


def test_a_name_that_is_no_name(skin, tmp_path):
    ran = skin("new", "My Skin", "--disc", 0.06, "--out", tmp_path)
    assert ran.code == 2 and "found the name 'My Skin', expected lower-case letters" in ran.err
