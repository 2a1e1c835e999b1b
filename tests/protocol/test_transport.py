"""TCP: never in clear beyond this host unless told; with CURVE only for those who are allowed."""

import socket

import pytest
import zmq

from protocol import transport
from protocol.frames import ContactFrame
from protocol.sockets import NewestReader, Publisher
from tests import needs

from .test_sockets import subscribed

pytestmark = pytest.mark.live


@pytest.fixture(autouse=True)
def back_to_default():
    yield
    transport.configure(transport.Transport())


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.mark.parametrize("host", ["0.0.0.0", "*", "192.0.2.1", "[::]", "eth0"])
def test_unencrypted_tcp_beyond_the_loopback_is_refused(context, host):
    with pytest.raises(transport.TransportError, match="insecure = true"):
        Publisher("publisher", context, address=f"tcp://{host}:{free_port()}")


def test_unencrypted_tcp_on_the_loopback_or_when_told_to(context):
    port = free_port()
    publisher = Publisher("publisher", context, address=f"tcp://127.0.0.1:{port}")
    reader = NewestReader("contact", "palm", f"tcp://127.0.0.1:{port}", context)
    subscribed(publisher)
    publisher.send(ContactFrame(skin="palm"))
    assert reader.recv(2.0) is not None
    transport.configure(transport.Transport(insecure=True))
    Publisher("publisher", context, address=f"tcp://0.0.0.0:{free_port()}").close()


def test_curve_lets_in_who_is_allowed_and_nobody_else(tmp_path):
    if not zmq.has("curve"):
        needs.CURVE.lack("CURVE in libzmq")
    context = zmq.Context()
    server_public, server_secret = transport.write_keys(tmp_path / "server", "server")
    _, friend = transport.write_keys(tmp_path / "allowed", "friend")
    _, stranger = transport.write_keys(tmp_path / "elsewhere", "stranger")
    assert friend.stat().st_mode & 0o077 == 0
    address = f"tcp://127.0.0.1:{free_port()}"

    def reader(secret):
        keys = {"publisher": server_public} if secret else {}
        transport.configure(transport.Transport(addresses={"publisher": address}, secret_key=secret, server_keys=keys))
        return NewestReader("contact", "palm", context=context)

    transport.configure(transport.Transport(secret_key=server_secret, clients=tmp_path / "allowed"))
    publisher = Publisher("publisher", context, address=address)
    readers = [reader(friend), reader(stranger), reader(None)]
    try:
        subscribed(publisher)
        publisher.send(ContactFrame(skin="palm"))
        assert readers[0].recv(2.0) is not None
        assert readers[1].recv(0.3) is None
        assert readers[2].recv(0.3) is None
        assert publisher.subscribers("contact", "palm") == 1
    finally:
        publisher.close()
        for r in readers:
            r.close()
        transport.stop_gate(context)
        context.destroy(linger=0)
