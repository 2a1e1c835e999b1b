"""Hooks of mkdocs.yml: the site's pages lie where the repository has them, so that one link holds in both.

What a page links to is copied beside them, pictures and sources alike. A folder has no page: a link to one becomes its
text.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # `mkdocs` itself does not put it there
    sys.path.insert(0, str(ROOT))

from tests.docs.links import links_of  # noqa: E402
from tests.docs.snippets import documents  # noqa: E402

PAGES = (*documents(), ROOT / "bench" / "reports" / "README.md")
FOLDER = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#:\s]+)\)")


def on_files(files: Files, *, config: Any) -> Files:
    """The theme's own files, our pages, and what they link to."""
    linked = (link.path for page in PAGES for link in links_of(page) if not link.elsewhere)
    for file in list(files):
        if file.src_dir == config.docs_dir:
            files.remove(file)
    for path in dict.fromkeys((*PAGES, *linked)):
        if path.is_file():
            source = path.relative_to(ROOT).as_posix()
            files.append(File(source, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    here = (ROOT / page.file.src_uri).parent
    return FOLDER.sub(lambda link: link[1] if (here / link[2]).is_dir() else link[0], markdown)
