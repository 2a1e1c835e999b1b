"""Follows docs/extending.md: every block applied to a copy of the checkout, and what was added is then there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.snippets import ROOT, in_text

pytestmark = pytest.mark.live

BLOCKS = [
    s for s in in_text((ROOT / "docs" / "extending.md").read_text("utf-8"), "docs/extending.md") if s.kind == "text"
]
COPIED = ("protocol", "models", "services", "bridges", "firmware_stub", "bench", "pyproject.toml")

ADDED = """
import numpy as np
from bench.reliability.matrix import ROWS
from firmware_stub.analog import BoardNoise
from firmware_stub.faults import FAULTS
from firmware_stub.rig import Rig
from models import patterns
from models.bundle import NETWORKS
from models.bundle import Bundle
from protocol.frame_types import AlarmFrame
from protocol.frames import Contact, ContactFrame, pack, unpack
from services.alarm import Alarm
from services.estimation.faults.board import FaultState
from services.estimation.faults.noise import NoiseRise
from services.estimation.asked.question import AS_IT_IS, NOISE
from services.estimation.values.judgement import Verdict, reasons
from services.runtime.config import Skin
from services.runtime.stage import PROCESSES
import services.contacts.contact_writer, services.estimation.estimator

assert FAULTS["noisy"].args == {"times": 20.0} and "noisy" in {row.fault for row in ROWS}
(row,) = (row for row in ROWS if row.fault == "noisy")
assert row.names[0] == "low_snr" and FaultState(np.zeros(16)).noise.since_s == np.inf
noise = NoiseRise()
first, *_, last = [noise.judged(NOISE, 0.044 * scan) for scan in range(6)]
assert first.verdict is Verdict.PASS and reasons([last]) == ["low_snr"]
noise.explained(AS_IT_IS)
assert noise.judged(AS_IT_IS, 0.3).verdict is Verdict.PASS and noise.judged(NOISE, 0.35).verdict is Verdict.PASS
rig = Rig(seed=1)
assert rig.fault("noisy", {"times": 5.0}, 0.0)
assert patterns.check(patterns.pattern("skip_one", 16), 16).shape == (192, 4)
assert NETWORKS["wide"] and Skin(port="stub", bundle="square16", frame_id="palm", network="wide")
frame = unpack(pack(ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0, 0, 0], force_n=12.0, age_s=0.7)])))
assert frame.contacts[0].age_s == 0.7
(alarm,) = Alarm("palm", None, None).process(frame, frozenset({"alarm"}))
assert unpack(pack(alarm)).too_hard and "alarm" in PROCESSES
"""


def apply(text: str, checkout: Path) -> None:
    """One block: `--- file`, then lines that stay (blank first), go (-) and come (+)."""
    header, *lines = text.splitlines()
    file = checkout / re.fullmatch(r"--- (\S+)", header)[1]  # type: ignore[index]
    before = "".join(line[1:] + "\n" for line in lines if line[:1] != "+")
    after = "".join(line[1:] + "\n" for line in lines if line[:1] != "-")
    found = file.read_text("utf-8") if file.exists() else ""
    if not before:
        assert not file.exists(), f"{header}: the block adds a file that is there"
        file.write_text(after, "utf-8")
        return
    assert found.count(before) == 1, f"{header}: found {found.count(before)} times, expected once:\n{before}"
    file.write_text(found.replace(before, after), "utf-8")


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    checkout = tmp_path_factory.mktemp("extended")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, checkout / name, ignore=shutil.ignore_patterns("work", "bundles", "__pycache__")
            )
        else:
            shutil.copy(ROOT / name, checkout / name)
    (checkout / "models" / "bundles").symlink_to(ROOT / "models" / "bundles")
    for block in BLOCKS:
        apply(block.text, checkout)
    return checkout


def run(checkout: Path, *arguments: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=checkout, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.release
def test_every_block_fits_and_what_it_adds_is_there(extended: Path) -> None:
    assert len(BLOCKS) >= 15
    run(extended, "-c", ADDED)


def test_what_was_added_is_clean(extended: Path) -> None:
    run(extended, "-m", "ruff", "check", "--no-cache", ".")


def test_a_block_that_no_longer_fits_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("one = 1\n")
    with pytest.raises(AssertionError, match="found 0 times"):
        apply("--- a.py\n two = 2\n+three = 3\n", tmp_path)
    apply("--- a.py\n one = 1\n+two = 2\n", tmp_path)
    assert (tmp_path / "a.py").read_text() == "one = 1\ntwo = 2\n"
