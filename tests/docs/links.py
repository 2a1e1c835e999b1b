"""The links of the documents, and the anchors that they may lead to, as GitHub makes them of headings."""

import re
from typing import NamedTuple

from tests.docs.snippets import FENCE, INLINE, ROOT


class Link(NamedTuple):
    page: str
    target: str  # as written

    @property
    def elsewhere(self):
        return "://" in self.target

    @property
    def path(self):
        """The file or folder that it leads to."""
        file, page = self.target.partition("#")[0], ROOT / self.page
        return (page.parent / file).resolve() if file else page

    @property
    def anchor(self):
        return self.target.partition("#")[2]


def links_of(page):
    prose = INLINE.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    for target in re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", prose):
        yield Link(str(page.relative_to(ROOT)), target)


def anchors(text):
    """Of every heading: lower case, without punctuation, a hyphen for each space; a second one of the name gets -1."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *$", FENCE.sub("", text), re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        found.add(next(n for n in (name, *(f"{name}-{k}" for k in range(1, 100))) if n not in found))
    return found
