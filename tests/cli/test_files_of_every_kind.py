"""Every command that reads a file, fed with files of every kind: one clear line, a status other than 0, in bounded time
and memory.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.stream_reader import zstandard

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
MAGIC = b"\x89MCAP0\r\n"
MEGA = 2**20

COMMANDS: dict[str, tuple[str, ...]] = {
    "replay": ("replay", "FILE.mcap"),
    "import": ("import", "FILE.npz", "OUT.mcap", "--skin", "square16"),
    "reconstruct": ("reconstruct", "FILE.npz", "OUT.npz", "--skin", "square16"),
    "register": ("register", "FILE.npz", "--skin", "disc16", "--out", "OUT"),
    "calibrate, presses": ("calibrate", "force", "--csv", "FILE.csv", "--out", "OUT.json"),
    "calibrate, rows": ("calibrate", "force", "--csv", "GOOD.csv", "--measurements", "FILE.npz", "--out", "OUT.json"),
    "port, recording": ("port", "FILE.mcap"),
    "port, measurements": ("port", "FILE.npz"),
    "configuration": ("up", "--config", "FILE.toml"),
}
KINDS = ("empty", "folder", "pipe", "endless", "text", "noise", "cut", "bomb", "secret", "missing")


def make(kind: str, path: Path) -> None:
    """A file of this kind; its suffix says what it pretends to be."""
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "bomb":
        BOMBS[path.suffix](path)
    elif kind == "cut":
        path.write_bytes(CUT[path.suffix])
    elif kind != "missing":
        path.write_bytes(CONTENT.get(kind, b""))
    if kind == "endless":  # as long as a file can be, and no block of the disk
        path.write_bytes(MAGIC if path.suffix == ".mcap" else b"")
        os.truncate(path, 2**43 if path.suffix != ".mcap" else 2**39)
    elif kind == "secret":
        path.chmod(0)


CONTENT = {
    "text": b"Hello, I am a letter.\n",
    "noise": np.random.default_rng(0).bytes(5000),
}
CUT = {
    ".mcap": MAGIC + struct.pack("<BQ", 6, 10_000) + bytes(300),
    ".npz": b"PK\3\4" + bytes(200),
    ".csv": b"force_n,x_m,y",
    ".toml": b'[skins.palm]\nport = "st',
}


def _bomb_npz(path: Path) -> None:
    """256 MB of zeros in 1 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("measurements", "untouched", "touched", "xy"):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array_header_1_0(  # type: ignore[no-untyped-call]
                    member, {"descr": "<f8", "fortran_order": False, "shape": (MEGA, 8)}
                )
                for _ in range(64):
                    member.write(bytes(MEGA))


def _bomb_mcap(path: Path) -> None:
    """Gigabytes of messages in 200 kB, each chunk as it should be."""
    channel = struct.pack("<HHI", 1, 0, 8) + b"raw/palm" + struct.pack("<I", 7) + b"msgpack" + struct.pack("<I", 0)
    data = struct.pack("<BQ", 4, len(channel)) + channel
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    data += message * (8 * MEGA // len(message))
    packed = zstandard.compress(data)
    body = struct.pack("<QQQII", 0, 1, len(data), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    chunk = struct.pack("<BQ", 6, len(body)) + body
    path.write_bytes(MAGIC + chunk * (200_000 // len(chunk)))


def _long_line(path: Path) -> None:
    """The largest text that is read at all, in one line."""
    path.write_bytes(b"[" * (4 * MEGA))


BOMBS = {".npz": _bomb_npz, ".mcap": _bomb_mcap, ".csv": _long_line, ".toml": _long_line}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[tuple[str, str], dict[str, Any]]]:
    """What came of every command with every kind of file, in one process."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "GOOD.csv").write_text("force_n,row\n" + "".join(f"{k},{k}\n" for k in range(1, 9)))
    runtime = folder / "rt"
    runtime.mkdir(mode=0o700)
    cases, commands = [], []
    for command, words in COMMANDS.items():
        for kind in KINDS:
            names = {}
            for word in words:
                stem, _, suffix = word.partition(".")
                if stem == "FILE":
                    names[word] = str(folder / f"{kind}.{suffix}")
                    if not os.path.lexists(names[word]):
                        make(kind, Path(names[word]))
                elif stem in ("OUT", "GOOD"):
                    names[word] = str(folder / word)
            cases.append((command, kind))
            commands.append([names.get(word, word) for word in words])
    (folder / "commands.json").write_text(json.dumps(commands))
    program = [sys.executable, str(ROOT / "tests" / "cli" / "feed_files.py"), str(folder / "commands.json")]
    environment = {**os.environ, "EITSKIN_RUNTIME": str(runtime), "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(program, capture_output=True, text=True, cwd=folder, env=environment, timeout=400)
    assert ran.returncode == 0, ran.stderr[-3000:]
    yield dict(zip(cases, json.loads(ran.stdout.splitlines()[-1]), strict=True))
    assert not [path for path in folder.iterdir() if path.name.startswith("OUT")], "something was made of a bad file"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_that_is_none_is_one_clear_line(
    answers: dict[tuple[str, str], dict[str, Any]], command: str, kind: str
) -> None:
    found = answers[command, kind]
    lines = found["err"].strip().splitlines()
    assert found["code"] in (1, 2), found
    assert len(lines) == 1 and len(lines[0]) < 500, found["err"]
    assert "Traceback" not in found["err"] and "a fault of this program" not in found["err"], found["err"]
    assert f"{kind}." in lines[0], "it names the file"
    assert found["seconds"] < 30, found
    assert found["peak"] < 700 * MEGA, found
