"""three.js, fetched once by the npm client and checked by its hash: `python -m bridges.page.fetch_three`

It is what draws the skin as a surface. Where it cannot be had, the page shows the flat map alone.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

VERSION = "0.180.0"
SHA256 = {
    "three.core.min.js": "61ba0df005b05991361d040d8ff670e1aadfd0ce7aeebd1fdb0725957a8957de",
    "three.module.min.js": "e2b5ee6bccd38fd6d8a2428546b83c5f2426d84b152ef82be8055556e3b40eb6",
}
TIMEOUT_S = 120


def three_folder() -> Path:
    """Where it is put: in the virtual environment."""
    return Path(sys.prefix) / "share" / "eitskin-page"


def verified(folder: Path) -> dict[str, bytes]:
    """name -> content of three.js in `folder`; empty where a file is missing or is another than we know."""
    found: dict[str, bytes] = {}
    for name, digest in SHA256.items():
        try:
            content = (folder / name).read_bytes()
        except OSError:
            return {}
        if hashlib.sha256(content).hexdigest() != digest:
            return {}
        found[name] = content
    return found


def fetch(folder: Path) -> str:
    """Put three.js into `folder`; "" or why it could not be had."""
    npm = shutil.which("npm")
    if npm is None:
        return "there is no npm here"
    with tempfile.TemporaryDirectory(prefix="eitskin-three-") as work:
        command = [npm, "pack", f"three@{VERSION}", "--silent"]
        try:
            subprocess.run(command, cwd=work, check=True, capture_output=True, timeout=TIMEOUT_S)
            package = next(Path(work).glob("three-*.tgz"))
            with tarfile.open(package) as archive:
                for name in SHA256:
                    part = archive.extractfile(f"package/build/{name}")
                    (Path(work) / name).write_bytes(part.read() if part else b"")
        except (OSError, subprocess.SubprocessError, StopIteration, tarfile.TarError, KeyError) as why:
            return f"npm could not fetch three@{VERSION} ({type(why).__name__})"
        if not (found := verified(Path(work))):
            return f"what npm fetched is not the three@{VERSION} that we know"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in found.items():
        (folder / name).write_bytes(content)
    return ""


def main() -> int:
    folder = three_folder()
    if not verified(folder) and (why := fetch(folder)):
        print(f"page: no three.js, since {why}: the page shows the flat map alone")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
