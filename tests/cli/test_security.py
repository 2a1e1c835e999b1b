"""Keys as a user meets them: `skin keys new`, docs/security.md as it stands, `skin up` where a process would die."""

import re
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq

from protocol import transport
from protocol.frames import ContactFrame
from protocol.sockets import NewestReader, Publisher
from services.runtime.config import ROOT, load
from tests.protocol.peers import free_port
from tests.waiting import WAIT_S, end, until

pytestmark = pytest.mark.live

SKIN = '[skins.palm]\nport = "stub"\nbundle = "square16"\n'


def of_page(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs" / "security.md").read_text(), re.DOTALL)


def made_local(example: str, ports: tuple[int, int]) -> str:
    """The same on this host, at ports that are free."""
    assert "47600" in example and "47601" in example
    example = example.replace("47600", str(ports[0])).replace("47601", str(ports[1]))
    return example.replace("0.0.0.0", "127.0.0.1").replace("192.0.2.7", "127.0.0.1")


@pytest.fixture
def hosts(skin, runtime: Path, tmp_path: Path, monkeypatch):
    """Folders of the robot and of the client, with the keys made and exchanged as the page says."""
    robot, arm = tmp_path / "robot", tmp_path / "arm"
    for folder, script in zip((robot, arm), of_page("sh"), strict=True):
        folder.mkdir()
        monkeypatch.chdir(folder)
        for program, *words in map(str.split, script.splitlines()):
            if program == "./skin":
                assert skin(*words).code == 0
            else:
                subprocess.run([program, *words], check=True)
    (robot / "keys/clients/arm.key").write_bytes((arm / "keys/arm.key").read_bytes())
    (arm / "keys/robot.key").write_bytes((robot / "keys/robot.key").read_bytes())
    yield robot, arm
    transport.stop_gate(zmq.Context.instance())
    transport.configure(transport.Transport())


def test_the_pages_hosts_exchange_frames(hosts: tuple[Path, Path]) -> None:
    ports = free_port(), free_port()
    for folder, example in zip(hosts, of_page("toml"), strict=True):
        (folder / "skin.toml").write_text(SKIN + made_local(example, ports))
    robot, arm = (load(folder / "skin.toml").transport() for folder in hosts)
    transport.configure(robot)
    publisher, sent = Publisher("publisher"), ContactFrame(skin="palm", valid=True, valid_for_s=WAIT_S)
    sent.stamps["sample"] = time.monotonic_ns()
    transport.configure(arm)
    reader = NewestReader("contact", "palm")
    until(lambda: (publisher.send(sent), reader.recv(0.02))[1])
    reader.close()

    (code,) = of_page("python")  # the page's client, as it stands
    code = made_local(code, ports).replace("from eitskin", "from protocol")
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"]
    client = subprocess.Popen(command, cwd=hosts[1], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        until(lambda: (publisher.send(sent), client.poll())[1] is not None)
    finally:
        end(client)
    said = client.communicate()[0]
    assert client.returncode == 0 and said.split()[1:] == ["True", "0"], said
    publisher.close()


def test_new_keys_are_secret_from_the_first_moment_and_never_overwritten(skin, tmp_path: Path) -> None:
    made = skin("keys", "new", "robot", "--folder", tmp_path / "keys")
    secret = tmp_path / "keys/robot.key_secret"
    assert made.code == 0 and "security.clients" in made.out
    assert stat.S_IMODE(secret.parent.stat().st_mode) == 0o700 and stat.S_IMODE(secret.stat().st_mode) == 0o600
    before = secret.read_bytes()
    secret.with_suffix(".key").rename(tmp_path / "at the other end")
    again = skin("keys", "new", "robot", "--folder", tmp_path / "keys")
    assert again.code == 2 and "is there already" in again.err and secret.read_bytes() == before
    assert skin("keys", "new", "../robot", "--folder", tmp_path / "keys").code == 2


LISTENS = "import socket as s, sys; a = s.socket(s.AF_UNIX); a.bind(sys.argv[1]); a.listen(); print(flush=1); input()"


def test_up_refuses_what_a_process_would_die_of(skin, runtime: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("services.runtime.supervision.up", lambda *_, **__: pytest.fail("it starts"))

    def refused(more: str, *says: str) -> None:
        (tmp_path / "skin.toml").write_text(SKIN + more)
        ran = skin("up", "--config", tmp_path / "skin.toml")
        assert ran.code in (1, 2) and not ran.out and all(each in ran.err for each in says), ran

    def at(address: str) -> str:
        return f'[sockets.addresses]\npublisher = "{address}"\n'

    free, taken = free_port(), free_port()
    remote = at(f"tcp://0.0.0.0:{free}")
    keys = '[security]\nsecret_key = "keys/robot.key_secret"\nclients = "keys/clients"\n'
    command, pipe = [sys.executable, "-c", LISTENS, str(runtime / "inference.ipc")], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as other:
        other.stdout.readline()
        refused("", f"process {other.pid} does already")
        other.communicate(b"\n")
    refused(remote, "configure CURVE keys, or say insecure = true")
    with socket.socket() as other:
        other.bind(("0.0.0.0", taken))
        other.listen()
        said = f"0.0.0.0:{taken}", "another program uses it"
        refused(at(f"tcp://0.0.0.0:{taken}") + "[security]\ninsecure = true\n", *said)
    refused(remote + keys, "No such file")
    transport.write_keys(tmp_path / "keys", "robot")
    refused(remote + keys, "found no folder")
    (tmp_path / "keys/clients").mkdir()
    (tmp_path / "keys/robot.key_secret").chmod(0o644)
    refused(remote + keys, "chmod 600")
    refused(at(f"ipc://{runtime}/acquisition.ipc"), "publisher cannot listen at", "acquisition is to")
