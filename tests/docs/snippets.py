"""Everything that README, WIRE.md and the other documents show as something to type, found in their text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BESIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "protocol/WIRE.md", "firmware_stub/README.md")
DOCUMENTS = tuple(ROOT / name for name in BESIDE)
"""Besides all of docs/. bench/reports/README.md is generated from what its commands printed (tests/bench/test_page)."""

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
COMMAND = re.compile(r"(\./skin|skin|make|docker compose|g\+\+|python -m|\.venv/bin/\S+)( |$)")
WORDS = ("skin", "make")
"""What an inline command may be a word for: `skin` the key, `make` the program. Alone they are no command."""


@dataclass(frozen=True)
class Snippet:
    """kind: "command" (one line of a shell), "python", "toml", or "text" (nothing to run)."""

    file: str
    line: int
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.text.splitlines()[0]}"


def documents() -> list[Path]:
    return [*DOCUMENTS, *sorted((ROOT / "docs").rglob("*.md"))]


def snippets() -> list[Snippet]:
    """Each once, in the order of the documents."""
    found: dict[tuple[str, str], Snippet] = {}
    for path in documents():
        for snippet in in_text(path.read_text(encoding="utf-8"), str(path.relative_to(ROOT))):
            found.setdefault((snippet.kind, snippet.text), snippet)
    return list(found.values())


def in_text(text: str, file: str = "README.md") -> Iterator[Snippet]:
    for block in FENCE.finditer(text):
        line = text[: block.start()].count("\n") + 2
        if block[1] == "sh":
            for number, command in enumerate(block[2].splitlines()):
                command = command.partition(" #")[0].strip()
                if command and not command.startswith("#"):
                    yield Snippet(file, line + number, "command", command)
        else:
            yield Snippet(file, line, block[1] if block[1] in ("python", "toml") else "text", block[2])
    prose = FENCE.sub(lambda block: "\n" * block[0].count("\n"), text)
    for inline in INLINE.finditer(prose):
        command = inline[1].strip()
        if COMMAND.match(command) and command not in WORDS:
            yield Snippet(file, prose[: inline.start()].count("\n") + 1, "command", command)
