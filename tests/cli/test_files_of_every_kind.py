"""Every command that reads files, fed with any kind: one clear line, bounded memory, nothing made."""

import contextlib
import ctypes
import io
import json
import os
import resource
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import zstandard

from services.cli.app import run as skin
from tests.needs import ROOT

MAGIC = b"\x89MCAP0\r\n"
MEGA = 2**20
COMMANDS = (
    "replay FILE.mcap",
    "import FILE.npz OUT.mcap --skin square16",
    "reconstruct FILE.npz OUT.npz --skin square16",
    "register FILE.npz --skin disc16 --out OUT",
    "calibrate force --csv FILE.csv --out OUT.json",
    "up --config FILE.toml",
)
KINDS = ("empty", "folder", "pipe", "endless", "noise", "cut", "bomb", "secret", "missing")
NOISE = np.random.default_rng(0).bytes(5000)
CUT = {".mcap": MAGIC + struct.pack("<BQ", 6, 10_000) + bytes(300), ".npz": b"PK\3\4" + bytes(200)}
CUT |= {".csv": b"force_n,x_m,y", ".toml": b'[skins.palm]\nport = "st'}


def make(kind: str, path: Path) -> None:
    """A file of this kind; its suffix says what it pretends to be."""
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "bomb":
        bomb(path)
    elif kind != "missing":
        path.write_bytes({"cut": CUT[path.suffix], "noise": NOISE}.get(kind, b""))
    if kind == "endless":  # as long as a file can be, and no block of the disk
        path.write_bytes(MAGIC if path.suffix == ".mcap" else b"")
        os.truncate(path, 2**43 if path.suffix != ".mcap" else 2**39)
    elif kind == "secret":
        path.chmod(0)


def bomb(path: Path) -> None:
    """64 MB of zeros in little; gigabytes of messages in 200 kB; the largest text that is read at all, in one line."""
    if path.suffix == ".npz":
        header = {"descr": "<f8", "fortran_order": False, "shape": (MEGA, 8)}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name in ("measurements", "untouched", "touched", "xy"):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    member.write(bytes(64 * MEGA))
    elif path.suffix == ".mcap":
        channel = struct.pack("<HHI", 1, 0, 8) + b"raw/palm" + struct.pack("<I", 7) + b"msgpack" + struct.pack("<I", 0)
        message = struct.pack("<BQHIQQ", 5, 22 + 10_000, 1, 0, 0, 0) + bytes(10_000)
        data = struct.pack("<BQ", 4, len(channel)) + channel + message * (8 * MEGA // len(message))
        packed = zstandard.compress(data)
        body = struct.pack("<QQQII", 0, 1, len(data), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
        chunk = struct.pack("<BQ", 6, len(body)) + body
        path.write_bytes(MAGIC + chunk * (200_000 // len(chunk)))
    else:
        path.write_bytes(b"[" * (4 * MEGA))


@pytest.mark.live
def test_a_file_that_is_none_is_one_clear_line(runtime: Path, tmp_path: Path) -> None:
    cases = [(command, kind) for command in COMMANDS for kind in KINDS]
    for command, kind in cases:
        if not os.path.lexists(file := tmp_path / f"{kind}.{command.partition('FILE.')[2].split()[0]}"):
            make(kind, file)
    typed = [command.replace("FILE", kind) for command, kind in cases]
    how = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "capture_output": True, "text": True}
    ran = subprocess.run([sys.executable, __file__], input=json.dumps(typed), **how)
    assert ran.returncode == 0, ran.stderr[-3000:]
    wrong, answers = [], json.loads(ran.stdout.splitlines()[-1])
    for command, (_, kind), (code, err, peak) in zip(typed, cases, answers, strict=True):
        line, *more = err.strip().splitlines()
        if code not in (1, 2) or more or len(line) > 500 or f"{kind}." not in line or peak > 700 * MEGA:
            wrong.append((command, code, err, peak))
    assert not wrong and not list(tmp_path.glob("OUT*"))


def give_up_rights() -> None:
    """Root reads any file; without CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH it reads what its owner may."""
    libc, header = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: low words, then high words
    assert not libc.capget(header, sets)
    sets[0] &= ~(1 << 1 | 1 << 2)
    assert not libc.capset(header, sets)


def run(command: str) -> tuple[int, str, int]:
    """Exit status, what it said, and the most memory so far. (Not ru_maxrss, which begins with the parent's size.)"""
    sys.argv = ["skin", *command.split()]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as err:
        code = skin()
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return code, err.getvalue(), int(line.split()[1]) * 1024


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30,) * 2)  # ONNX Runtime and numpy reserve much and use little
    if os.geteuid() == 0:
        give_up_rights()
    print(json.dumps([run(command) for command in json.load(sys.stdin)]))
