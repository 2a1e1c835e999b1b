"""The place that the documents' commands are run in: a copy of the checkout, an empty home, a desktop's environment."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import select
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.docs.snippets import ROOT

KEPT = re.compile(r"PATH|LANG|.*_proxy|PIP_.*|SSL_.*|REQUESTS_.*|EITSKIN_REFERENCE|EITSKIN_REQUIRE_.*|O.*_NUM_THREADS",
                  re.IGNORECASE)  # fmt: skip
START_S, END_S, INTERRUPT_S = 120.0, 600.0, 20.0


@dataclass
class Ran:
    """Status, and what was printed on both streams."""

    code: int
    out: str


@dataclass
class World:
    checkout: Path
    folder: Path
    environment: dict[str, str]
    files: dict[str, str] = field(default_factory=dict)

    def typed(self, line: str, instead: str) -> str:
        """What is typed for a document's line."""
        line = line.replace("FILE", shlex.quote(self.files["presses"])).replace(
            "/tmp/subscribe", str(self.folder / "subscribe")
        )
        text = re.sub(
            r"^(python|skin) ", lambda m: {"python": ".venv/bin/python ", "skin": "./skin "}[m[1]], instead or line
        )
        return (
            text.replace("{line}", line).format(
                folder=self.folder, **{k: shlex.quote(v) for k, v in self.files.items()}
            )
            if instead
            else text
        )

    def ends(self, command: str, timeout_s: float = END_S) -> Ran:
        """A command run to its end."""
        with self.started(command) as process:
            try:
                out, _ = process.communicate(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                raise AssertionError(f"`{command}` did not end within {timeout_s:g} s") from None
            return Ran(process.returncode, out)

    def runs(self, command: str, says: str, timeout_s: float = START_S) -> Ran:
        """A command run until it printed `says` (or ended), then Ctrl-C."""
        with self.started(command) as process:
            printed = self._until(process, says, timeout_s)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of it
            try:
                rest, _ = process.communicate(timeout=INTERRUPT_S)
            except subprocess.TimeoutExpired:
                raise AssertionError(f"`{command}` went on after Ctrl-C; it had printed:\n{printed}") from None
            return Ran(process.returncode, printed + rest)

    @staticmethod
    def _until(process: subprocess.Popen[str], says: str, timeout_s: float) -> str:
        assert process.stdout is not None
        printed, end = b"", time.monotonic() + timeout_s
        while not re.search(says, printed.decode(errors="replace"), re.MULTILINE):
            found = printed.decode(errors="replace")
            assert time.monotonic() < end, f"expected {says!r}, found after {timeout_s:g} s:\n{found}"
            if select.select([process.stdout], [], [], 0.1)[0]:
                more = os.read(process.stdout.fileno(), 65536)
                printed += more
                if not more:
                    break
        return printed.decode(errors="replace")

    @contextlib.contextmanager
    def started(self, command: str) -> Iterator[subprocess.Popen[str]]:
        process = subprocess.Popen(
            ["bash", "-c", command],
            cwd=self.checkout,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=_ends_with_us,
        )
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1


def _ends_with_us() -> None:
    """A command has a session of its own, so nobody else would end it where the tests themselves are killed. It keeps
    this across exec, and ends what it started as it does after any SIGTERM.
    """
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@contextlib.contextmanager
def world(*, installed: bool = True) -> Iterator[World]:
    """`installed`: with this checkout's virtual environment; else as cloned."""
    folder = Path(tempfile.mkdtemp(prefix="eit", dir="/tmp"))  # short: a socket's path has at most 107 bytes
    try:
        checkout = folder / "eitskin"
        for name in tracked():
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, checkout / name, follow_symlinks=False)
        if installed:
            (checkout / ".venv").symlink_to(ROOT / ".venv")
        for name in ("home", "xdg", "stub"):
            (folder / name).mkdir(mode=0o700)
        environment = {name: value for name, value in os.environ.items() if KEPT.fullmatch(name)}
        environment.setdefault("EITSKIN_REFERENCE", str((ROOT / ".." / "shared" / "data").resolve()))
        environment |= {"HOME": str(folder / "home"), "XDG_RUNTIME_DIR": str(folder / "xdg"), "TERM": "xterm-256color"}
        environment |= {"COLUMNS": "80", "LINES": "24", "PYTHONUNBUFFERED": "1"}
        made = World(checkout, folder, environment)
        made.files = _files(folder, Path(environment["EITSKIN_REFERENCE"]))
        yield made
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def tracked() -> list[str]:
    """What a clone has, as it stands here: also what is not committed yet."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [name for name in names if (ROOT / name).is_file()]


def _files(folder: Path, reference: Path) -> dict[str, str]:
    """The files that a reader would bring: measurements of the square skin, presses of the disc, forces."""
    from models.bundle import Bundle

    rng = np.random.default_rng(0)
    z0 = np.asarray(Bundle.load("square16").z0)
    disc = rng.uniform(1, 2, len(Bundle.load("disc16").pattern))
    noisy = z0 * (1 + 1e-4 * rng.standard_normal((64, len(z0))))
    np.savez(folder / "measurements.npz", measurements=noisy[:2], untouched=noisy)
    np.savez(folder / "few.npz", touched=np.tile(disc, (4, 1)), untouched=np.tile(disc, (4, 1)))
    real = reference / "hydrogel_disc16.npz"
    (folder / "forces.csv").write_text(
        "force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m\n"
        + "".join(f"{n},{0.004 * n},{-0.003 * n},{n},{0.1 * n},{2.5e-5 * n}\n" for n in (1, 2, 3, 4, 5, 2.5, 3.5))
    )
    return {
        "measurements": str(folder / "measurements.npz"),
        "presses": str(real if real.is_file() else folder / "few.npz"),
        "forces": str(folder / "forces.csv"),
    }
