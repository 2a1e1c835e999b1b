"""The launcher: any folder, no installation, quick. Ctrl-C at a defined point: it leaves without a traceback."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol.frames import ContactFrame
from protocol.runtime import host_id
from protocol.sockets import Publisher
from tests.needs import ROOT
from tests.waiting import WAIT_S, until

pytestmark = pytest.mark.live


def ran(*command, **more):
    return subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, **more)


def test_it_runs_from_any_folder_through_a_link_and_without_an_installation_says_make_venv(tmp_path):
    (tmp_path / "skin").symlink_to(ROOT / "skin")
    assert "paper_49" in json.loads(ran(tmp_path / "skin", "scene", "--json", cwd=tmp_path).stdout)
    shutil.copy(ROOT / "skin", tmp_path / "alone")
    bare = [os.path.realpath(sys.executable), "-I", "-S", tmp_path / "alone", "up"]
    alone = subprocess.run(bare, capture_output=True, text=True)
    assert alone.returncode == 2 and "make venv" in alone.stderr and len(alone.stderr.splitlines()) == 1


def test_starting_a_command_loads_nothing_heavy():
    loaded = ran("-c", "import sys, services.cli.app; print(*sys.modules)", cwd=ROOT, check=True).stdout
    heavy = {*"numpy scipy onnxruntime torch zmq supervisor mcap models serial".split()}
    assert not heavy & {name.split(".")[0] for name in loaded.split()}


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
