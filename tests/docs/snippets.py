"""Everything that README, WIRE.md and the other documents show as something to type, found in their text."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BESIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "protocol/WIRE.md", "firmware_stub/README.md")
"""Besides all of docs/. bench/reports/README.md is generated from what its commands printed."""

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
COMMAND = re.compile(r"(\./skin|skin|make|docker compose|g\+\+|python -m|\.venv/bin/\S+)( |$)")
WORDS = ("skin", "make")  # inline they are the key and the program


@dataclass(frozen=True)
class Snippet:
    """kind: "command" (one line of a shell), "python", "toml", or "text" (nothing to run)."""

    file: str
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}: {self.text.splitlines()[0]}"


def documents() -> list[Path]:
    return [*(ROOT / name for name in BESIDE), *sorted((ROOT / "docs").rglob("*.md"))]


def snippets() -> list[Snippet]:
    """Each once, in the order of the documents."""
    found = (each for page in documents() for each in in_text(page.read_text("utf-8"), str(page.relative_to(ROOT))))
    return list({(each.kind, each.text): each for each in reversed(list(found))}.values())[::-1]


def in_text(text: str, file: str) -> Iterator[Snippet]:
    for language, block in FENCE.findall(text):
        if language == "sh":
            for line in block.splitlines():
                if command := line.partition(" #")[0].strip():
                    yield Snippet(file, "command", command)
        else:
            yield Snippet(file, language if language in ("python", "toml") else "text", block)
    for inline in INLINE.findall(FENCE.sub("", text)):
        if COMMAND.match(command := inline.strip()) and command not in WORDS:
            yield Snippet(file, "command", command)
