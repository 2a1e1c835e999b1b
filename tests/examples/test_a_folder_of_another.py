"""A runtime folder that another user made, or could have, with a forged publisher in it: no example takes its contacts.

What `runtime_dir()` refuses, each client refuses before it connects: README's and WIRE.md's programs, the documents'
typed client, the controllers, C++.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zmq

from tests import needs
from tests.examples.compiled import ROOT, cpp_subscriber

pytestmark = pytest.mark.live

__all__ = ["cpp_subscriber"]
ANOTHER = 65534
WIRE = (ROOT / "protocol" / "WIRE.md").read_text()
README = (ROOT / "README.md").read_text()
TYPED = "from protocol.client import ContactSubscriber\nwith ContactSubscriber('palm') as s: print('True', s.latest())"


def ten_lines(text: str) -> str:
    return "import msgpack" + text.partition("```python\nimport msgpack")[2].partition("```")[0]


CLIENTS = {
    "README's ten lines": ("-uc", ten_lines(README)),
    "WIRE.md's ten lines": ("-uc", ten_lines(WIRE)),
    "the typed client": ("-uc", TYPED),
    "stop_on_contact": ("-m", "examples.stop_on_contact"),
    "guarded_move": ("-m", "examples.guarded_move"),
    "follow_the_finger": ("-m", "examples.follow_the_finger", "--seconds", "2"),
    "reflex": ("-m", "examples.reflex"),
}
"""What follows `python`."""


class Forger:
    """Publishes fresh, valid, empty contact frames of `palm` in a folder, as the service would."""

    def __init__(self, folder: Path) -> None:
        body = (ROOT / "protocol" / "vectors" / "frames" / "contact_empty.bin").read_bytes().partition(b"\0")[2]
        self._frame = msgpack.unpackb(body) | {"valid": True, "valid_for_s": 5.0, "reasons": [], "source": "stub"}
        host = Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
        self._frame |= {"host": host, "skin": "palm", "session": "forged"}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(f"ipc://{folder}/publisher.ipc",))
        self._thread.start()

    def _run(self, address: str) -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
            publisher.setsockopt(zmq.LINGER, 0)
            publisher.bind(address)
            while not self._ended.wait(0.02):
                self._frame["seq"] = self._frame["scan"] = self._frame["seq"] + 1
                self._frame["stamps"] = dict.fromkeys(("sample", "read", "publish"), time.monotonic_ns())
                publisher.send(b"contact/palm\0" + msgpack.packb(self._frame))

    def close(self) -> None:
        self._ended.set()
        self._thread.join(10)


@pytest.fixture(params=["of another user", "open to others", "a link"])
def forged(request: pytest.FixtureRequest, runtime: Path) -> Iterator[Path]:
    """The folder that the client will look into; it is forged in that way, and named by the expected refusal."""
    folder = runtime / "eitskin"
    behind = runtime / "elsewhere"
    behind.mkdir(mode=0o700)
    if request.param == "a link":
        folder.symlink_to(behind)
    else:
        folder.mkdir(mode=0o700)
    forger = Forger(folder)
    try:
        end = time.monotonic() + 10
        while not (folder / "publisher.ipc").exists():
            assert time.monotonic() < end
            time.sleep(0.01)
        if request.param == "open to others":
            folder.chmod(0o755)
        elif request.param == "of another user":
            if os.geteuid() != 0:
                needs.SUPERUSER.lack("right to give a folder to another user")
            os.chown(folder, ANOTHER, ANOTHER)
        yield folder
    finally:
        forger.close()


def refusal(command: tuple[str, ...], folder: Path) -> str:
    """What the client says that looks into `folder` as its desktop names it; it acted on nothing."""
    environment = {name: value for name, value in os.environ.items() if name != "EITSKIN_RUNTIME"}
    environment["XDG_RUNTIME_DIR"] = str(folder.parent)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60)
    assert "True" not in done.stdout and "valid" not in done.stdout and "moves" not in done.stdout, done.stdout
    assert done.returncode not in (0, -11), done.stdout + done.stderr
    return done.stderr.splitlines()[-1] if done.stderr else ""


def assert_says_what_to_do(said: str, folder: Path) -> None:
    assert str(folder) in said, "found"
    assert "EITSKIN_RUNTIME" in said or "chmod 700" in said or "name its target" in said, f"what to do: {said}"


@pytest.mark.parametrize("client", CLIENTS)
def test_python_refuses_a_folder_that_is_not_its_own(client: str, forged: Path) -> None:
    said = refusal((sys.executable, *CLIENTS[client]), forged)
    assert_says_what_to_do(said, forged)


def test_cpp_refuses_a_folder_that_is_not_its_own(cpp_subscriber: Path, forged: Path) -> None:
    said = refusal((str(cpp_subscriber), "palm", "5", "3"), forged)
    assert_says_what_to_do(said, forged)
    assert "expected" in said


def test_cpp_takes_the_folder_that_is_its_own(cpp_subscriber: Path, runtime: Path) -> None:
    """Also one that is not there yet: a client may start before the service."""
    environment = {**os.environ, "EITSKIN_RUNTIME": str(runtime / "new")}
    with subprocess.Popen(
        [str(cpp_subscriber), "palm", "3", "20"], env=environment, stdout=subprocess.PIPE, text=True
    ) as client:
        end = time.monotonic() + 10
        while not (runtime / "new").exists():
            assert time.monotonic() < end
            time.sleep(0.01)
        assert (runtime / "new").stat().st_mode & 0o777 == 0o700
        forger = Forger(runtime / "new")
        try:
            printed = client.communicate(timeout=30)[0]
        finally:
            forger.close()
    assert client.returncode == 0 and printed.count(" valid\n") == 3
