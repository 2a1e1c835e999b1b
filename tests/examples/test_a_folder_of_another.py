"""A runtime folder that another user made, with a forged publisher in it: no example takes its contacts."""

import contextlib
import os
import re
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
from tests.needs import ROOT
from tests.waiting import WAIT_S, until

pytestmark = pytest.mark.live

TYPED = "from protocol.client import ContactSubscriber\nwith ContactSubscriber('palm') as s: print('True', s.latest())"
TEN_LINES = re.compile(r"```python\n(import msgpack.*?)```", re.DOTALL)
CLIENTS = {name: TEN_LINES.search((ROOT / name).read_text())[1] for name in ("README.md", "protocol/WIRE.md")}
COMMANDS = {name: (sys.executable, "-uc", text) for name, text in (CLIENTS | {"typed": TYPED}).items()}


@contextlib.contextmanager
def forging(folder: Path) -> Iterator[None]:
    """Publishes fresh, valid, empty contact frames of `palm` in a folder, as the service would."""
    body = (ROOT / "protocol" / "vectors" / "frames" / "contact_empty.bin").read_bytes().partition(b"\0")[2]
    frame = msgpack.unpackb(body) | {"valid": True, "valid_for_s": 5.0, "reasons": [], "source": "stub"}
    host = Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
    frame |= {"host": host, "skin": "palm", "session": "forged"}
    ended = threading.Event()

    def publish() -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
            publisher.setsockopt(zmq.LINGER, 0)
            publisher.bind(f"ipc://{folder}/publisher.ipc")
            while not ended.wait(0.02):
                frame["seq"] = frame["scan"] = frame["seq"] + 1
                frame["stamps"] = dict.fromkeys(("sample", "read", "publish"), time.monotonic_ns())
                publisher.send(b"contact/palm\0" + msgpack.packb(frame))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize("forged", ["of another user", "open to others", "a link"])
@pytest.mark.parametrize("language", ["python", "cpp"])
def test_no_client_takes_a_folder_that_is_not_its_own(request, runtime, forged, language) -> None:
    commands = COMMANDS
    if language == "cpp":
        commands = {"subscribe.cpp": (str(request.getfixturevalue("cpp_subscriber")), "palm", "5", "3")}
    folder, behind = runtime / "eitskin", runtime / "elsewhere"
    behind.mkdir(mode=0o700)
    folder.symlink_to(behind) if forged == "a link" else folder.mkdir(mode=0o700)
    with forging(folder):
        until((folder / "publisher.ipc").exists)
        if forged == "open to others":
            folder.chmod(0o755)
        elif forged == "of another user":
            if os.geteuid() != 0:
                needs.SUPERUSER.lack("right to give a folder to another user")
            os.chown(folder, 65534, 65534)
        environment = {name: value for name, value in os.environ.items() if name != "EITSKIN_RUNTIME"}
        options = {"env": environment | {"XDG_RUNTIME_DIR": str(runtime)}, "cwd": ROOT, "text": True}
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        running = {name: subprocess.Popen(command, **options) for name, command in commands.items()}
        for name, client in running.items():
            printed, said = client.communicate(timeout=WAIT_S)
            assert not re.search("True|valid|moves", printed), f"{name}: {printed}"
            assert client.returncode not in (0, -11), f"{name}: {printed}{said}"
            last = said.splitlines()[-1] if said else ""
            assert str(folder) in last, f"{name}: {said}"
            assert re.search("EITSKIN_RUNTIME|chmod 700|name its target", last), f"{name} does not say what to do"
