"""Runs commands of `skin` one after the other in this process, with bounded memory and without the right to read what
is not ours; prints what came of each as JSON. A program of test_files_of_every_kind.py.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

MEMORY = 4 * 2**30  # address space, of which ONNX Runtime and numpy reserve much and use little
SECONDS = 60
CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 1, 2


def give_up_rights() -> None:
    """Root reads any file; without these two capabilities it reads what its owner may."""
    if os.geteuid() != 0:
        return
    libc, header = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: low words, then high words
    if libc.capget(header, sets):
        raise OSError(ctypes.get_errno(), "capget")
    sets[0] &= ~(1 << CAP_DAC_OVERRIDE | 1 << CAP_DAC_READ_SEARCH)
    if libc.capset(header, sets):
        raise OSError(ctypes.get_errno(), "capset")


def read_as_a_port(file: str) -> tuple[int, str]:
    """What acquisition says of `port = FILE`: the problem in its status."""
    from models.bundle import Bundle
    from services.acquisition import open_source
    from services.runtime.config import Skin

    source = open_source("palm", Skin(port=file, bundle="square16"), Bundle.load("square16"))
    with contextlib.closing(source):
        for frame in source.frames():
            if frame is not None:
                return 0, "a frame came"
            if source.problem:
                return 1, source.problem
    return 0, "nothing was said"


def run(arguments: list[str]) -> dict[str, Any]:
    from services.cli.app import run as skin

    out, err, began = io.StringIO(), io.StringIO(), time.monotonic()
    signal.alarm(SECONDS)
    if arguments[0] == "port":
        code, text = read_as_a_port(arguments[1])
        err.write(text + "\n")
    else:
        sys.argv = ["skin", *arguments]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = skin()
    signal.alarm(0)
    # Not ru_maxrss: that one begins with the size of the process that started this one.
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    peak = int(line.split()[1]) * 1024
    return {"code": code, "err": err.getvalue(), "seconds": time.monotonic() - began, "peak": peak}


def main() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    give_up_rights()
    results = [run(arguments) for arguments in json.loads(Path(sys.argv[1]).read_text())]
    print(json.dumps(results))


if __name__ == "__main__":
    main()
