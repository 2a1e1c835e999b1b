"""The unit file that is shipped: systemd knows all of it, and what it starts is there."""

from __future__ import annotations

import configparser
import re
import subprocess
from pathlib import Path

from tests import needs
from tests.docs.snippets import ROOT

UNIT = ROOT / "docs" / "systemd" / "eitskin.service"
CHECKOUT = "/opt/eitskin"


def verified(text: str, folder: Path) -> str:
    """What `systemd-analyze verify` has to say of a unit; empty: nothing."""
    needs.SYSTEMD.here()
    (folder / UNIT.name).write_text(text)
    ran = subprocess.run(["systemd-analyze", "verify", folder / UNIT.name], capture_output=True, text=True)
    return "\n".join(line for line in ran.stderr.splitlines() if UNIT.name in line)


def test_systemd_finds_nothing_wrong(tmp_path: Path) -> None:
    """In a checkout elsewhere, since the unit's own is made by whoever installs it; by a name without a blank."""
    (tmp_path / "eitskin").symlink_to(ROOT)
    assert verified(UNIT.read_text().replace(CHECKOUT, str(tmp_path / "eitskin")), tmp_path) == ""


def test_systemd_would_say_what_is_wrong(tmp_path: Path) -> None:
    text = UNIT.read_text().replace(CHECKOUT, str(ROOT)).replace("Type=exec", "Type=nonsense\nRestrt=always")
    said = verified(text, tmp_path)
    assert "nonsense" in said and "Restrt" in said


def test_the_page_says_what_the_unit_says() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(UNIT)
    page = (ROOT / "docs" / "operations.md").read_text()
    runtime = dict(word.split("=") for word in unit["Service"]["Environment"].split())["EITSKIN_RUNTIME"]
    assert runtime == f"/run/{unit['Service']['RuntimeDirectory']}" and f"export EITSKIN_RUNTIME={runtime}" in page
    assert f"the user `{unit['Service']['User']}` from a checkout in {CHECKOUT}" in re.sub(r"\s+", " ", page)
    assert unit["Service"]["RuntimeDirectoryMode"] == "0700", "any other mode is refused: docs/security.md"
