"""Electrodes are counted from 0 wherever a number is shown; WIRE.md and README say so, and nothing says otherwise."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from tests.docs.snippets import ROOT

FROM_ONE = re.compile(
    r"electrodes?[^.\n]{0,60}(number 1\b|counted from 1\b|numbered from 1\b|1-based|\b1 to 16)|electrode 1 stands", re.I
)
SENTENCE = re.compile(r"Electrodes\s+are\s+counted\s+from\s+0", re.I)
FOLDERS = ("protocol", "services", "bridges", "models", "firmware_stub", "bench", "examples", "docs")
TEXTS = {".md", ".py", ".toml", ".cpp", ".html", ".js"}


def texts() -> Iterator[Path]:
    yield from (ROOT / "README.md", ROOT / "skin.toml")
    for folder in FOLDERS:
        paths = ((p, p.relative_to(ROOT).parts) for p in (ROOT / folder).rglob("*"))
        yield from (path for path, parts in paths if path.suffix in TEXTS and "work" not in parts)


def test_nothing_counts_electrodes_from_one() -> None:
    assert FROM_ONE.search("# Centre of each electrode on the outline, number 1 at the bottom left")
    files = list(texts())
    assert len(files) > 250
    found = [str(path.relative_to(ROOT)) for path in files if FROM_ONE.search(path.read_text("utf-8"))]
    assert not found, f"these count electrodes from 1: {found}"


def test_wire_md_and_readme_say_it_once() -> None:
    for name in ("protocol/WIRE.md", "README.md"):
        assert len(SENTENCE.findall((ROOT / name).read_text("utf-8"))) == 1, name
