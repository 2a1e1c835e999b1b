"""Ctrl-C at a defined point: it leaves, with 130 or by the signal, and without a traceback."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol.frames import ContactFrame
from protocol.runtime import host_id
from protocol.sockets import Publisher
from tests.waiting import WAIT_S, until

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]

ONCE_READY = [("skin echo contact", b"contact/palm scan"), ("-m examples.stop_on_contact", b"robot moves")]


@pytest.mark.parametrize(("words", "ready"), ONCE_READY)
def test_once_a_command_works(runtime: Path, words: str, ready: bytes) -> None:
    publisher = Publisher("publisher")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen([sys.executable, *words.split()], cwd=ROOT, start_new_session=True, **pipes)
    os.set_blocking(process.stdout.fileno(), False)
    said = bytearray()

    def is_ready() -> bool:
        stamps = {"sample": time.monotonic_ns()}
        publisher.send(ContactFrame(skin="palm", host=host_id(), valid=True, valid_for_s=60.0, stamps=stamps))
        said.extend(process.stdout.read() or b"")
        return ready in said

    try:
        until(is_ready, process)
        process.send_signal(signal.SIGINT)
        process.wait(WAIT_S)
    finally:
        process.kill()
        publisher.close()
    assert process.returncode in (130, -signal.SIGINT), said
    assert b"Traceback" not in said + (process.stdout.read() or b"")
