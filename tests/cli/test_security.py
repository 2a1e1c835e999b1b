"""Keys as a user meets them: `skin keys new`, the examples of skin.toml and docs/security.md run as they stand, `skin
up` with a configuration that a process would die of.
"""

from __future__ import annotations

import re
import socket
import stat
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import zmq

from protocol import transport
from protocol.control import ControlClient, ControlError
from protocol.frames import ContactFrame, pack
from protocol.sockets import ControlServer, NewestReader, Publisher
from services.runtime.config import ROOT, load

pytestmark = pytest.mark.live

DOC = (ROOT / "docs" / "security.md").read_text()
SKIN_TOML = (ROOT / "skin.toml").read_text()
SKIN = '[skins.palm]\nport = "stub"\nbundle = "square16"\n'


def of_doc(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", DOC, re.DOTALL)


def of_skin_toml() -> list[str]:
    """The examples in the comments: the server's lines begin with "# ", the client's with "#   "."""
    server, client = SKIN_TOML[SKIN_TOML.index("# Contacts for other hosts") :].split("# There, in the skin.toml")
    return [
        "\n".join(re.findall(r'^# ((?:\[|"|[a-z_]+ = ).*)', server, re.MULTILINE)),
        "\n".join(re.findall(r"^#   (.*)", client, re.MULTILINE)),
    ]


def free_ports() -> tuple[int, int]:
    with socket.socket() as one, socket.socket() as two:
        one.bind(("127.0.0.1", 0))
        two.bind(("127.0.0.1", 0))
        return one.getsockname()[1], two.getsockname()[1]


@pytest.fixture
def clean(runtime: Path) -> Any:
    yield
    transport.stop_gate(zmq.Context.instance())
    transport.configure(transport.Transport())


def made_local(example: str, ports: tuple[int, int]) -> str:
    """The same on this host, at ports that are free."""
    for shown, port in (("47600", ports[0]), ("47601", ports[1])):
        assert shown in example
        example = example.replace(shown, str(port))
    return example.replace("0.0.0.0", "127.0.0.1").replace("192.0.2.7", "127.0.0.1")


@pytest.fixture
def hosts(skin: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Folders of the robot and of the client, with the keys made and exchanged as the page says."""
    robot, arm = tmp_path / "robot", tmp_path / "arm"
    for folder, script in zip((robot, arm), of_doc("sh"), strict=True):
        folder.mkdir()
        monkeypatch.chdir(folder)
        for line in script.splitlines():
            program, *arguments = line.split()
            if program == "./skin":
                assert skin(*arguments).code == 0
            else:
                subprocess.run([program, *arguments], check=True)
    (robot / "keys/clients/arm.key").write_bytes((arm / "keys/arm.key").read_bytes())
    (arm / "keys/robot.key").write_bytes((robot / "keys/robot.key").read_bytes())
    return robot, arm


def configured(folder: Path, example: str) -> transport.Transport:
    (folder / "skin.toml").write_text(SKIN + example)
    return load(folder / "skin.toml").transport()


@pytest.mark.parametrize("source", ["docs/security.md", "skin.toml"])
def test_the_examples_exchange_a_frame_and_refuse_an_impostor(
    source: str, hosts: tuple[Path, Path], clean: None
) -> None:
    server, client = of_doc("toml") if source.startswith("docs") else of_skin_toml()
    ports = free_ports()
    robot = configured(hosts[0], made_local(server, ports))
    arm = configured(hosts[1], made_local(client, ports))
    tares: list[dict[str, Any]] = []
    transport.configure(robot)
    publisher = Publisher("publisher")
    control = ControlServer("publisher", {"tare": lambda args: tares.append(args) or {}})
    transport.configure(arm)
    reader = NewestReader("contact", "palm")
    end, frame = time.monotonic() + 10, None
    while frame is None:
        publisher.send(ContactFrame(skin="palm", valid=True))
        frame = reader.recv(0.02)
        assert time.monotonic() < end
    assert _called(control, "clock")["monotonic_ns"]
    with pytest.raises(ControlError, match="operator"):
        _called(control, "tare")
    (hosts[0] / "keys/clients/arm.key").rename(hosts[0] / "keys/operators/arm.key")
    _called(control, "tare")
    assert len(tares) == 1
    publisher.close()
    control.close()

    # Somebody without the robot's secret key listens where it was.
    impostor = zmq.Context.instance().socket(zmq.PUB)
    while True:
        try:
            impostor.bind(f"tcp://127.0.0.1:{ports[0]}")
            break
        except zmq.ZMQError:
            time.sleep(0.01)
            assert time.monotonic() < end + 10
    while reader.recv(0.1) is not None:
        pass
    for _ in range(30):
        impostor.send(pack(ContactFrame(skin="palm", valid=True)))
        assert reader.recv(0.02) is None
    impostor.close(0)
    reader.close()


def _called(control: ControlServer, command: str) -> dict[str, Any]:
    import threading

    stop = threading.Event()
    thread = threading.Thread(target=lambda: [control.serve_once(0.02) for _ in iter(stop.is_set, True)])
    thread.start()
    try:
        return ControlClient("publisher", 5.0).call(command)
    finally:
        stop.set()
        thread.join()


def test_the_pages_client_runs_as_it_stands(hosts: tuple[Path, Path], clean: None) -> None:
    ports = free_ports()
    transport.configure(configured(hosts[0], made_local(of_doc("toml")[0], ports)))
    publisher = Publisher("publisher")
    (code,) = of_doc("python")
    code = made_local(code, ports).replace("from eitskin", "from protocol")
    client = subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"],
        cwd=hosts[1],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    end = time.monotonic() + 30
    while client.poll() is None and time.monotonic() < end:
        publisher.send(ContactFrame(skin="palm", valid=True, valid_for_s=1.0, stamps={"sample": time.monotonic_ns()}))
        time.sleep(0.02)
    client.kill()
    said = client.communicate()[0]
    assert client.returncode == 0 and said.split()[1:] == ["True", "0"], said
    publisher.close()


def test_new_keys_are_secret_from_the_first_moment_and_never_overwritten(skin: Any, tmp_path: Path) -> None:
    made = skin("keys", "new", "robot", "--folder", tmp_path / "keys")
    assert made.code == 0 and "security.clients" in made.out
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "keys/robot.key_secret").stat().st_mode) == 0o600
    before = (tmp_path / "keys/robot.key_secret").read_bytes()
    again = skin("keys", "new", "robot", "--folder", tmp_path / "keys")
    assert again.code == 2 and "is there already" in again.err
    assert (tmp_path / "keys/robot.key_secret").read_bytes() == before
    assert skin("keys", "new", "../robot", "--folder", tmp_path / "keys").code == 2


def refused(folder: Path, more: str) -> str:
    """What `skin up` says of a configuration it does not start."""
    (folder / "skin.toml").write_text(SKIN + more)
    command = [sys.executable, str(ROOT / "skin"), "up", "--config", str(folder / "skin.toml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode in (1, 2) and not done.stdout and "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.release
def test_up_refuses_what_a_process_would_die_of(runtime: Path, tmp_path: Path) -> None:
    address = '[sockets.addresses]\npublisher = "tcp://0.0.0.0:{}"\n'
    free, taken = free_ports()
    assert "configure CURVE keys, or say insecure = true" in refused(tmp_path, address.format(free))
    with socket.socket() as other:
        other.bind(("0.0.0.0", taken))
        other.listen()
        said = refused(tmp_path, address.format(taken) + "[security]\ninsecure = true\n")
        assert f"0.0.0.0:{taken}" in said and "another program uses it" in said
    keys = '[security]\nsecret_key = "keys/robot.key_secret"\nclients = "keys/clients"\n'
    assert "No such file" in refused(tmp_path, address.format(free) + keys)
    transport.write_keys(tmp_path / "keys", "robot")
    assert "found no folder" in refused(tmp_path, address.format(free) + keys)
    (tmp_path / "keys/clients").mkdir()
    (tmp_path / "keys/robot.key_secret").chmod(0o644)
    assert "chmod 600" in refused(tmp_path, address.format(free) + keys)
    publisher = Publisher("inference")
    assert "does already" in refused(tmp_path, "")
    publisher.close()
    twice = f'publisher = "tcp://127.0.0.1:{free}"\n"publisher.ctl" = "tcp://lo:{free}"\n'  # by another name
    assert "another of our sockets" in refused(tmp_path, f"[sockets.addresses]\n{twice}")
    others = f'[sockets.addresses]\npublisher = "ipc://{runtime}/acquisition.ipc"\n'
    assert "publisher cannot listen at" in (said := refused(tmp_path, others)) and "acquisition is to" in said
    nowhere = f'[sockets.addresses]\npublisher = "ipc://{tmp_path}/nowhere/x.ipc"\n'
    assert "there is no such folder" in refused(tmp_path, nowhere)


@pytest.mark.release
def test_up_says_the_addresses_it_really_uses(runtime: Path, tmp_path: Path) -> None:
    port = free_ports()[0]
    (tmp_path / "skin.toml").write_text(SKIN + f'[sockets.addresses]\npublisher = "tcp://127.0.0.1:{port}"\n')
    command = [sys.executable, str(ROOT / "skin"), "up", "--config", str(tmp_path / "skin.toml")]
    with open(tmp_path / "log", "wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        reader = NewestReader("contact", "palm", f"tcp://127.0.0.1:{port}")
        end = time.monotonic() + 90
        while reader.recv(0.5) is None:
            assert time.monotonic() < end and process.poll() is None, (tmp_path / "log").read_text()
        assert f"contacts at tcp://127.0.0.1:{port}" in (tmp_path / "log").read_text()
        reader.close()
    finally:
        process.terminate()
        process.wait(20)


def test_the_page_and_the_shipped_file_show_the_same(tmp_path: Path) -> None:
    assert [tomllib.loads(text) for text in of_doc("toml")] == [tomllib.loads(text) for text in of_skin_toml()]
