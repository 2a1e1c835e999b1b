"""Follows docs/extending.md: every block applied to a copy of the checkout, and what was added is then there."""

import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.docs.snippets import ROOT, in_text
from tests.docs.world import world

PAGE = (ROOT / "docs" / "extending.md").read_text("utf-8")
BLOCKS = [each.text for each in in_text(PAGE, "docs/extending.md") if each.kind == "text"]

ADDED = """
import services.contacts.contact_writer, services.estimation.estimator, services.alarm, simulation.faults
from firmware_stub.rig import Rig
from models import bundle, patterns
from protocol.frames import Contact, ContactFrame, pack, unpack
assert Rig(seed=1).fault("noisy", {"times": 5.0}, 0.0) and bundle.NETWORKS["wide"]
assert patterns.check(patterns.pattern("skip_one", 16), 16).shape == (192, 4)
frame = unpack(pack(ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0, 0, 0], force_n=12.0, age_s=0.7)])))
(alarm,) = services.alarm.Alarm("palm", None, None).process(frame, frozenset({"alarm"}))
assert frame.contacts[0].age_s == 0.7 and unpack(pack(alarm)).too_hard
"""


def apply(text: str, checkout: Path) -> None:
    """One block: `--- file`, then lines that stay (blank first), go (-) and come (+)."""
    header, *lines = text.splitlines()
    file = checkout / re.fullmatch(r"--- (\S+)", header)[1]
    before = "".join(line[1:] + "\n" for line in lines if line[:1] != "+")
    after = "".join(line[1:] + "\n" for line in lines if line[:1] != "-")
    if not before:
        assert not file.exists(), f"{header}: the block adds a file that is there"
        file.write_text(after, "utf-8")
        return
    found = file.read_text("utf-8")
    assert found.count(before) == 1, f"{header}: found {found.count(before)} times, expected once:\n{before}"
    file.write_text(found.replace(before, after), "utf-8")


def test_every_block_fits(tmp_path: Path) -> None:
    for name in {re.match(r"--- (\S+)", block)[1] for block in BLOCKS}:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, tmp_path / name)
    for block in BLOCKS:
        apply(block, tmp_path)


@pytest.mark.live
@pytest.mark.release
def test_what_blocks_add_is_there_and_clean() -> None:
    with world() as place:
        for block in BLOCKS:
            apply(block, place.checkout)
        place.environment["PYTHONPATH"] = str(place.checkout)
        (place.folder / "added.py").write_text(ADDED)
        place.ends(f"{sys.executable} {place.folder}/added.py")
        place.ends(f"{sys.executable} -m ruff check --no-cache .")
