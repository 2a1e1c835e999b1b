"""Keys over TCP: half a configuration is an error, a key that is taken away ends what it opened, commands that change
something need an operator's key.
"""

import os
import threading
import time

import msgpack
import pytest
import zmq

from protocol import transport
from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import ContactFrame, pack
from protocol.keys import KeyFolder, read_pair, read_public, write_keys
from protocol.sockets import AllReader, NewestReader, Publisher
from protocol.transport import Transport, TransportError

from .test_sockets import subscribed, until
from .test_transport import back_to_default, free_port  # noqa: F401  (a fixture that every test here uses)

pytestmark = pytest.mark.live


@pytest.fixture
def site(tmp_path):
    """Keys of a robot, of two clients and an operator, and the folders that the robot lists them in."""
    for name in ("robot", "arm", "desk", "chief"):
        write_keys(tmp_path / "keys", name)
    for folder, names in (("clients", ("arm", "desk")), ("operators", ("chief",))):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / f"{name}.key").write_bytes((tmp_path / "keys" / f"{name}.key").read_bytes())
    return tmp_path


def server(site, **more):
    return Transport(
        secret_key=site / "keys" / "robot.key_secret", clients=site / "clients", operators=site / "operators", **more
    )


def client(site, name, address):
    keys = {"publisher": site / "keys" / "robot.key"}
    return Transport(
        addresses={"publisher": address, "publisher.ctl": address},
        secret_key=site / "keys" / f"{name}.key_secret",
        server_keys=keys,
    )


@pytest.fixture
def own():
    """A context whose gate is closed with it."""
    context = zmq.Context()
    yield context
    transport.stop_gate(context)
    context.destroy(linger=0)


def test_a_secret_key_without_the_servers_key_reads_no_impostor(site, own):
    """An impostor in clear where the robot should be: what it sends must not reach a client that has a key."""
    port = free_port()
    impostor = own.socket(zmq.PUB)
    impostor.bind(f"tcp://127.0.0.1:{port}")
    address = f"tcp://127.0.0.1:{port}"
    half = Transport(addresses={"publisher": address}, secret_key=site / "keys" / "arm.key_secret")
    with pytest.raises(TransportError, match="secret_key alone"):
        transport.configure(half)
    other = Transport(
        addresses={"publisher": address}, secret_key=half.secret_key, server_keys={"inference": site / "keys/robot.key"}
    )
    transport.configure(other)  # keys of another process than the one that is read
    with pytest.raises(TransportError, match="no server key of publisher"):
        NewestReader("contact", "palm", context=own)
    transport.configure(client(site, "arm", address))
    reader = NewestReader("contact", "palm", context=own)
    for _ in range(20):
        impostor.send(pack(ContactFrame(skin="palm", valid=True)))
        assert reader.recv(0.02) is None


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"server_keys": {"publisher": "keys/robot.key"}}, "secret_key too .found server_keys"),
        ({"clients": "clients"}, "secret_key too .found clients"),
        ({"operators": "operators"}, "secret_key too .found operators"),
        ({"secret_key": "keys/robot.key_secret"}, "secret_key alone"),
        ({"secret_key": "keys/robot.key", "clients": "clients"}, "holds no secret key"),
        ({"secret_key": "keys/none", "clients": "clients"}, "No such file"),
        ({"secret_key": "clients", "clients": "clients"}, "Is a directory"),
        ({"secret_key": "keys/robot.key_secret", "clients": "nobody"}, "clients: found no folder"),
        (
            {"secret_key": "keys/robot.key_secret", "server_keys": {"publisher": "x"}, "operators": "operators"},
            "clients too.*found operators",
        ),
        ({"secret_key": "keys/robot.key_secret", "server_keys": {"publisher": "keys/none.key"}}, "No such file"),
    ],
)
def test_half_a_configuration_is_an_error_at_start(site, keys, says):
    def whole(value):
        return {name: site / file for name, file in value.items()} if isinstance(value, dict) else site / value

    with pytest.raises(TransportError, match=says):
        transport.configure(Transport(**{name: whole(value) for name, value in keys.items()}))
    assert transport.current() == Transport()


def test_clear_tcp_beyond_this_host_is_not_read_unless_told_to(own):
    with pytest.raises(TransportError, match="unencrypted"):
        NewestReader("contact", "palm", "tcp://192.0.2.1:47600", own)
    transport.configure(Transport(insecure=True))
    NewestReader("contact", "palm", "tcp://192.0.2.1:47600", own).close()


def test_a_secret_that_others_can_read_is_refused(site):
    secret = site / "keys" / "robot.key_secret"
    assert secret.stat().st_mode & 0o777 == 0o600
    for mode in (0o640, 0o604, 0o644):
        secret.chmod(mode)
        with pytest.raises(TransportError, match=f"mode 0{mode:o}.*chmod 600"):
            transport.configure(server(site))
    secret.chmod(0o400)
    transport.configure(server(site))


def test_keys_of_other_programs_fit_and_damaged_ones_are_named(tmp_path):
    import zmq.auth

    public, secret = zmq.auth.create_certificates(tmp_path, "other")
    os.chmod(secret, 0o600)
    assert read_pair(secret) == zmq.auth.load_certificate(secret)
    ours = write_keys(tmp_path, "ours")
    assert read_pair(ours[1]) == zmq.auth.load_certificate(ours[1])
    for text in (b"", b"\xff\xfe", b'public-key = "abc"', b'public-key = "' + b" " * 40 + b'"'):
        (tmp_path / "bad.key").write_bytes(text)
        with pytest.raises(TransportError, match=r"bad\.key"):
            read_public(tmp_path / "bad.key")


def test_one_bad_file_is_named_and_the_others_stay_good(site):
    folder = KeyFolder(site / "clients")
    assert sorted(folder.keys().values()) == ["arm", "desk"] and not folder.problems
    (site / "clients" / "torn.key").write_text('public-key = "')
    os.mkfifo(site / "clients" / "pipe.key")
    (site / "clients" / "gone.key").symlink_to("nowhere")
    (site / "clients" / "notes.txt").write_text("not a key, and not named like one")
    assert sorted(folder.keys().values()) == ["arm", "desk"]
    assert sorted(problem.split(":")[0].rpartition("/")[2] for problem in folder.problems) == [
        "gone.key",
        "pipe.key",
        "torn.key",
    ]
    for name in ("torn", "pipe", "gone"):
        (site / "clients" / f"{name}.key").unlink()
    assert len(folder.keys()) == 2 and not folder.problems


def test_a_key_that_is_taken_away_ends_its_live_connection_and_one_added_later_works(site, own):
    address = f"tcp://127.0.0.1:{free_port()}"
    transport.configure(server(site))
    publisher = Publisher("publisher", own, address=address)
    late = (site / "clients" / "desk.key").read_bytes()
    (site / "clients" / "desk.key").unlink()
    readers = {}
    for name in ("arm", "desk"):
        transport.configure(client(site, name, address))
        readers[name] = AllReader(["contact"], "palm", context=own)
    transport.configure(Transport())
    got = dict.fromkeys(readers, 0)

    def step():
        publisher.mind()
        publisher.poll()
        publisher.send(ContactFrame(skin="palm"))
        for name, reader in readers.items():
            got[name] += reader.recv(0.01) is not None

    def comes(name):
        before = got[name]
        step()
        return got[name] > before

    until(lambda: comes("arm"))
    assert not got["desk"]
    (site / "clients" / "desk.key").write_bytes(late)
    until(lambda: comes("desk"), 10)
    assert comes("arm") or comes("arm")  # it was not disturbed
    (site / "clients" / "arm.key").unlink()
    (site / "clients" / "bad.key").write_text("rubbish")
    until(publisher.mind)
    while readers["arm"].recv(0.05):  # what was on its way
        pass
    got = dict.fromkeys(readers, 0)
    until(lambda: comes("desk"))
    for _ in range(100):
        step()
    assert got["arm"] == 0 and got["desk"] > 5
    said = " ".join(publisher.problems)
    assert "taken from the list" in said and "bad.key" in said
    publisher.close()


def test_keys_taken_away_one_after_the_other_all_end(site, own):
    """However often the socket was opened anew just before; a key that nobody uses disturbs nobody."""
    transport.configure(server(site))
    publisher = Publisher("publisher", own, address=f"tcp://127.0.0.1:{free_port()}")
    admission = publisher._listening.admission
    for file in ("clients/arm.key", "clients/desk.key", "operators/chief.key"):
        key = read_public(site / file)
        assert admission.admit(key)  # as at its handshake
        (site / file).unlink()
        until(publisher.mind, 3)
        assert "1 key(s) were taken" in " ".join(publisher.problems)
        assert not admission.admit(key)
    (site / "clients/arm.key").write_bytes((site / "keys/arm.key").read_bytes())
    assert admission.allows(read_public(site / "clients/arm.key"))
    (site / "clients/arm.key").unlink()
    end = time.monotonic() + 1.2
    while time.monotonic() < end:
        assert not publisher.mind()
    publisher.close()


@pytest.fixture
def commanded(site, own):
    """A control socket over TCP; gives its address and the list of `tare`s that were carried out."""
    transport.configure(server(site))
    address, tares, stop = f"tcp://127.0.0.1:{free_port()}", [], threading.Event()
    control = ControlServer(
        "publisher",
        {"tare": lambda args: tares.append(args) or {}, "status": lambda args: {"level": "OK"}},
        address=address,
        context=own,
    )

    def serve():
        while not stop.is_set():
            control.serve_once(0.02)
            control.mind()
        control.close()

    thread = threading.Thread(target=serve)
    thread.start()
    yield address, tares
    stop.set()
    thread.join()


def test_a_client_may_look_and_only_an_operator_may_change_something(site, own, commanded):
    address, tares = commanded

    def call(name, command):
        transport.configure(client(site, name, address))
        return ControlClient("publisher", 3.0, context=own).call(command)

    assert call("arm", "status") == {"level": "OK"} and "monotonic_ns" in call("arm", "clock")
    with pytest.raises(ControlError, match="operator") as refused:
        call("arm", "tare")
    assert refused.value.kind == "forbidden" and not tares
    call("chief", "tare")
    assert len(tares) == 1
    (site / "operators" / "chief.key").rename(site / "clients" / "chief.key")
    with pytest.raises(ControlError, match="operator"):
        call("chief", "tare")
    assert call("chief", "status") == {"level": "OK"}
    assert call("robot", "tare") == {}  # the service's own key: its command line on its own host


def test_in_clear_only_looking_is_allowed(own):
    address, tares, stop = f"tcp://127.0.0.1:{free_port()}", [], threading.Event()
    control = ControlServer("publisher", {"tare": lambda args: tares.append(args) or {}}, address=address, context=own)
    thread = threading.Thread(target=lambda: [control.serve_once(0.02) for _ in iter(stop.is_set, True)])
    thread.start()
    try:
        asked = ControlClient("publisher", 3.0, address=address, context=own)
        assert "monotonic_ns" in asked.call("clock")
        with pytest.raises(ControlError, match="unencrypted"):
            asked.call("tare")
        # Whatever a peer says of itself, no key of an operator is believed without CURVE.
        liar = own.socket(zmq.REQ)
        liar.setsockopt(zmq.LINGER, 0)
        liar.setsockopt(zmq.METADATA, b"X-User-Id:chief")
        liar.connect(address)
        liar.send(msgpack.packb({"command": "tare", "args": {}}))
        assert liar.poll(3000) and msgpack.unpackb(liar.recv())["error"]["type"] == "forbidden"
        assert not tares
    finally:
        stop.set()
        thread.join()
        control.close()


def test_the_services_own_key_reaches_its_own_sockets_on_every_interface(site, own):
    port = free_port()
    transport.configure(server(site, addresses={"publisher": f"tcp://0.0.0.0:{port}"}))
    publisher = Publisher("publisher", own)
    reader = NewestReader("contact", "palm", context=own)
    subscribed(publisher)
    publisher.send(ContactFrame(skin="palm"))
    assert reader.recv(2.0) is not None
    publisher.close()
