"""Every link of the documents leads to a file of the checkout, and to a heading where it names one."""

from __future__ import annotations

import re

import pytest

from tests.docs.links import Link, anchors, links
from tests.docs.snippets import ROOT, documents
from tests.docs.world import tracked

HERE = sorted(set(link for link in links() if not link.elsewhere))
TRACKED = {ROOT / name for name in tracked()}
FOLDERS = {folder for file in TRACKED for folder in file.parents}


@pytest.mark.parametrize("link", HERE, ids=lambda link: f"{link.page}->{link.target}")
def test_it_leads_somewhere(link: Link) -> None:
    assert link.path in TRACKED | FOLDERS, f"{link.page}: {link.target} is no file of the checkout"
    if link.anchor:
        there = anchors(link.path.read_text(encoding="utf-8"))
        assert link.anchor in there, f"{link.page}: {link.target}: there are {sorted(there)}"


def test_links_elsewhere_are_encrypted_and_few() -> None:
    elsewhere = {link.target for link in links() if link.elsewhere}
    assert all(target.startswith("https://") for target in elsewhere)


def test_a_broken_link_is_found() -> None:
    assert Link("docs/ros.md", "nothing.md").path not in TRACKED
    assert "two-hosts-word-for-word" in anchors("# Security\n\n## Two hosts, word for word\n```sh\n# no heading\n```\n")
    assert anchors("## A\n## A\n") == {"a", "a-1"}


def test_every_page_can_be_reached_from_readme() -> None:
    """By links from page to page."""
    reached, waiting = set(), [ROOT / "README.md"]
    leads = {ROOT / page: {link.path for link in HERE if ROOT / link.page == ROOT / page} for page in pages()}
    while waiting:
        page = waiting.pop()
        if page not in reached:
            reached.add(page)
            waiting += [path for path in leads.get(page, ()) if path.suffix == ".md"]
    assert {str(page) for page in documents()} <= {str(page) for page in reached}


def test_the_site_has_every_page() -> None:
    """`make site`, which CI alone runs, fails on a page that is left out of its navigation."""
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = re.findall(r": (\S+\.md)$", navigation, re.MULTILINE)
    assert {str(page.relative_to(ROOT)) for page in documents()} <= set(listed)
    assert all((ROOT / page).is_file() for page in listed)


def pages() -> set[str]:
    return {link.page for link in HERE}


def test_readme_is_short() -> None:
    """Four screens: a screen shows about 45 lines of 100 characters; a table's row and a line of code count as one."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = sum(max(1, -(-len(re.sub(r"\]\([^)]*\)", "", line)) // 100)) for line in text.splitlines())
    assert lines <= 4 * 45, f"{lines} lines: move something to docs/"
    assert text.index("make test") < 1200, "picture, what it is, and two commands come first"
