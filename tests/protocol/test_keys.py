"""TCP and its keys: nobody reads, changes or is believed who is not listed; in clear only within this host."""

import shutil

import pytest
import zmq
import zmq.auth

from protocol import transport
from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import ContactFrame, pack
from protocol.keys import KeyFolder, read_pair, read_public, write_keys
from protocol.sockets import AllReader, NewestReader, Publisher
from protocol.transport import Transport, TransportError
from tests.waiting import until

from .peers import free_port, served


@pytest.fixture
def address():
    return f"tcp://127.0.0.1:{free_port()}"


@pytest.fixture
def site(tmp_path, context):
    """Keys of a robot, its clients arm and desk, its operator chief and of a stranger; the robot lists all but him."""
    for name in ("robot", "arm", "desk", "chief", "stranger"):
        write_keys(tmp_path / "keys", name)
    for folder, names in (("clients", ("arm", "desk")), ("operators", ("chief",))):
        (tmp_path / folder).mkdir()
        for name in names:
            shutil.copy(tmp_path / "keys" / f"{name}.key", tmp_path / folder)
    return tmp_path


def server(site, **more):
    secret = site / "keys" / "robot.key_secret"
    return Transport(secret_key=secret, clients=site / "clients", operators=site / "operators", **more)


def client(site, name, address):
    """Where `name` is "", one without any key."""
    addresses = {"publisher": address, "publisher.ctl": address}
    if not name:
        return Transport(addresses=addresses)
    keys = {"publisher": site / "keys" / "robot.key"}
    return Transport(addresses=addresses, secret_key=site / "keys" / f"{name}.key_secret", server_keys=keys)


@pytest.mark.live
@pytest.mark.parametrize("its_keys", ["none", "its own"])
def test_an_impostor_is_not_believed(site, context, its_keys):
    impostor = context.socket(zmq.XPUB)
    if its_keys != "none":
        impostor.curve_publickey, impostor.curve_secretkey = zmq.curve_keypair()
        impostor.curve_server = True
    transport.configure(client(site, "arm", f"tcp://127.0.0.1:{impostor.bind_to_random_port('tcp://127.0.0.1')}"))
    reader = NewestReader("contact", "palm", context=context)
    for _ in range(20):
        impostor.send(pack(ContactFrame(skin="palm", valid=True)))
        assert reader.recv(0.02) is None and not impostor.poll(0)


ROBOT, ARM = {"publisher": "keys/robot.key"}, "keys/arm.key_secret"


@pytest.mark.parametrize(("keys", "says"), [
    ({"server_keys": ROBOT}, "secret_key too .found server_keys"),
    ({"operators": "operators"}, "secret_key too .found operators"),
    ({"secret_key": ARM}, "secret_key alone"),
    ({"secret_key": "keys/arm.key", "server_keys": ROBOT}, "holds no secret key"),
    ({"secret_key": ARM, "clients": "nobody"}, "clients: found no folder"),
    ({"secret_key": ARM, "server_keys": ROBOT, "operators": "operators"}, "clients too.*found operators"),
    ({"secret_key": ARM, "server_keys": {"publisher": "keys/none.key"}}, "No such file"),
])  # fmt: skip
def test_half_a_configuration_is_an_error_at_start(site, keys, says):
    whole = {k: {n: site / f for n, f in v.items()} if isinstance(v, dict) else site / v for k, v in keys.items()}
    with pytest.raises(TransportError, match=says):
        transport.configure(Transport(**whole))
    assert transport.current() == Transport()


def test_keys_of_another_process_do_not_open_this_one(site, context, address):
    keys = {"inference": site / "keys/robot.key"}
    transport.configure(Transport({"publisher": address}, site / ARM, server_keys=keys))
    with pytest.raises(TransportError, match="no server key of publisher"):
        NewestReader("contact", "palm", context=context)
    with pytest.raises(TransportError, match="needs `clients`"):
        Publisher("publisher", context)


@pytest.mark.live
def test_clear_tcp_beyond_this_host_is_neither_written_nor_read_unless_told_to(context):
    for host in ("0.0.0.0", "*", "192.0.2.1", "[::]", "eth0"):
        with pytest.raises(TransportError, match="insecure = true"):
            Publisher("publisher", context, address=f"tcp://{host}:{free_port()}")
    with pytest.raises(TransportError, match="unencrypted"):
        NewestReader("contact", "palm", "tcp://192.0.2.1:47600", context)
    transport.configure(Transport(insecure=True))
    NewestReader("contact", "palm", "tcp://192.0.2.1:47600", context).close()
    Publisher("publisher", context, address=f"tcp://0.0.0.0:{free_port()}").close()


def test_key_files_are_as_other_programs_have_them_and_open_or_damaged_ones_are_named(site):
    secret = site / "keys" / "robot.key_secret"
    assert secret.stat().st_mode & 0o777 == 0o600
    for mode in (0o640, 0o604):
        secret.chmod(mode)
        with pytest.raises(TransportError, match=f"mode 0{mode:o}.*chmod 600"):
            transport.configure(server(site))
    secret.chmod(0o400)
    transport.configure(server(site))
    assert read_pair(secret) == zmq.auth.load_certificate(secret)
    clients = KeyFolder(site / "clients")
    assert sorted(clients.keys().values()) == ["arm", "desk"] and not clients.problems
    (site / "clients" / "notes.txt").write_text("not a key, and not named like one")
    for text in (b"", b"\xff\xfe", b'public-key = "abc"', b'public-key = "' + b" " * 40 + b'"'):
        (site / "clients" / "bad.key").write_bytes(text)
        with pytest.raises(TransportError, match=r"bad\.key"):
            read_public(site / "clients" / "bad.key")
        assert sorted(clients.keys().values()) == ["arm", "desk"], "the others stay good"
        assert len(clients.problems) == 1 and "bad.key" in clients.problems[0]


@pytest.mark.live
def test_who_is_listed_reads_and_nobody_else_as_the_list_is_now(site, context, address):
    transport.configure(server(site))
    everywhere = address.replace("127.0.0.1", "0.0.0.0")
    publisher = Publisher("publisher", context, address=everywhere)
    (site / "clients" / "desk.key").unlink()
    readers, got = {}, {}
    for name in ("robot", "arm", "desk", "stranger", ""):  # its own key reaches its own sockets on every interface
        own = server(site, addresses={"publisher": everywhere})
        transport.configure(client(site, name, address) if name != "robot" else own)
        readers[name] = AllReader(["contact"], "palm", context=context)
    transport.configure(Transport())

    def come(*names):
        """Whether all of these have got something since they were counted anew."""
        publisher.mind()
        publisher.send(ContactFrame(skin="palm"))
        for name, reader in readers.items():
            got[name] = got.get(name, 0) + (reader.recv(0.01) is not None)
        return all(got[name] for name in names)

    until(lambda: come("arm", "robot"))
    assert not got["desk"]
    shutil.copy(site / "keys" / "desk.key", site / "clients")
    until(lambda: come("desk"))  # a key that is added later works without a restart
    got.clear()
    until(lambda: come("arm", "desk"))
    assert readers["arm"].gaps == 0, "it was not disturbed"
    assert publisher.subscribers("contact", "palm") == 3 and not got["stranger"] and not got[""]
    (site / "clients" / "arm.key").unlink()
    (site / "clients" / "bad.key").write_text("rubbish")
    until(publisher.mind)
    while readers["arm"].recv(0.05):  # what was on its way
        pass
    got.clear()
    until(lambda: come("desk") and got["desk"] > 50)
    assert not (got["arm"] or got["stranger"] or got[""])
    said = " ".join(publisher.problems)
    assert "taken from the list" in said and "bad.key" in said
    publisher.close()


@pytest.fixture
def control(context, address):
    tares = []
    handlers = {"tare": lambda args: tares.append(args) or {}, "status": lambda args: {"level": "OK"}}
    return tares, lambda: served(ControlServer("publisher", handlers, address=address, context=context))


@pytest.mark.live
def test_a_client_may_look_and_only_an_operator_may_change_something(site, context, address, control):
    def call(name, command):
        transport.configure(client(site, name, address))
        return ControlClient("publisher", 60.0, context=context).call(command)

    transport.configure(server(site))
    tares, serving = control
    with serving():
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


@pytest.mark.live
def test_in_clear_only_looking_is_allowed(context, address, control):
    tares, serving = control
    with serving():
        asked = ControlClient("publisher", 60.0, address=address, context=context)
        assert "monotonic_ns" in asked.call("clock")
        with pytest.raises(ControlError, match="unencrypted"):
            asked.call("tare")
    assert not tares
