"""The place that the documents' commands are run in: a checkout or a copy of one, an empty home."""

import contextlib
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from protocol.sockets import NewestReader
from tests.docs.snippets import ROOT
from tests.waiting import end, until

KEPT = re.compile(r"PATH|LANG|.*_proxy|(PIP_|SSL_|REQUESTS_|EITSKIN_(REF|REQ|STUB)).*|O.*_NUM_THREADS", re.IGNORECASE)


@dataclass
class World:
    folder: Path  # of a path short enough for sockets
    environment: dict[str, str]

    @property
    def checkout(self) -> Path:
        return self.folder / "eitskin"

    def started(self, command: str, **more) -> subprocess.Popen[str]:
        how = {"shell": True, "cwd": self.checkout, "env": self.environment, "text": True, **more}
        return subprocess.Popen(f"exec {command}", **how)

    def ends(self, command: str) -> str:
        """What a command prints that ends well."""
        process = self.started(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        out, _ = process.communicate()
        assert process.returncode == 0 and "Traceback" not in out, f"`{command}` exit {process.returncode}:\n{out}"
        return out

    @contextlib.contextmanager
    def serving(self, command: str, skin: str = "palm") -> Iterator[NewestReader]:
        """The service, once frames come."""
        with open(self.folder / "log", "w+") as log:
            process = self.started(command, stdout=log, stderr=log)
            reader = NewestReader("contact", skin, f"ipc://{self.folder}/xdg/eitskin/publisher.ipc")
            try:
                while not (self.folder / "xdg/eitskin/publisher.ctl").exists() and process.poll() is None:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(0.1)  # `make up` installs first, for minutes
                until(lambda: reader.recv(0.5), process)
                yield reader
            finally:
                reader.close()
                end(process)
            assert "Traceback" not in (self.folder / "log").read_text()


@contextlib.contextmanager
def world(*, copied: bool = True, installed: bool = True) -> Iterator[World]:
    """copied: what a clone has; else the launcher alone. installed: with this checkout's virtual environment."""
    folder = Path(tempfile.mkdtemp(prefix="eit", dir="/tmp"))
    try:
        for name in ("home", "xdg", "eitskin"):
            (folder / name).mkdir(mode=0o700)
        listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
        for name in (name for name in names if copied and (ROOT / name).is_file()):
            (folder / "eitskin" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / "eitskin" / name, follow_symlinks=False)
        for name in ([] if copied else ["skin"]) + ([".venv"] if installed else []):
            (folder / "eitskin" / name).symlink_to(ROOT / name)
        environment = {name: value for name, value in os.environ.items() if KEPT.fullmatch(name)}
        environment |= {"HOME": str(folder / "home"), "XDG_RUNTIME_DIR": str(folder / "xdg"), "TERM": "xterm-256color"}
        yield World(folder, environment | {"COLUMNS": "80", "LINES": "24", "PYTHONUNBUFFERED": "1"})
    finally:
        shutil.rmtree(folder, ignore_errors=True)
