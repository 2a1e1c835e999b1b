"""The client over TCP: encrypted, with keys, and through a network that falls silent without a word."""

import selectors
import socket
import threading

import pytest
import zmq

from protocol import transport
from protocol.client import ContactSubscriber, Stale
from protocol.sockets import Publisher
from tests import needs

from .test_client import frame
from .test_sockets import subscribed, until
from .test_transport import back_to_default, free_port  # noqa: F401  (a fixture that every test here uses)

pytestmark = pytest.mark.live


def test_contacts_over_tcp_with_keys(runtime, tmp_path):
    if not zmq.has("curve"):
        needs.CURVE.lack("CURVE in libzmq")
    context = zmq.Context()
    server_public, server_secret = transport.write_keys(tmp_path / "server", "server")
    _, friend = transport.write_keys(tmp_path / "allowed", "friend")
    address = f"tcp://127.0.0.1:{free_port()}"
    transport.configure(transport.Transport(secret_key=server_secret, clients=tmp_path / "allowed"))
    publisher = Publisher("publisher", context, address=address)
    transport.configure(
        transport.Transport(
            addresses={"publisher": address}, secret_key=friend, server_keys={"publisher": server_public}
        )
    )
    try:
        with ContactSubscriber("palm") as skin:
            subscribed(publisher)
            publisher.send(frame())
            assert skin.latest(max_age=2.0, wait_s=2.0, valid=True).seq == 0
    finally:
        publisher.close()
        transport.stop_gate(context)
        context.destroy(linger=0)


class Cable:
    """A TCP relay that can be cut: what is connected stays so and says nothing any more, new connections are served."""

    def __init__(self, to_port):
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port, self._to = self.listening.getsockname()[1], to_port
        self._pairs, self._all, self._ending = {}, [self.listening], False
        self._thread = threading.Thread(target=self._relay, daemon=True)
        self._thread.start()

    def _relay(self):
        with selectors.DefaultSelector() as ready:
            ready.register(self.listening, selectors.EVENT_READ)
            while not self._ending:
                for key, _ in ready.select(0.05):
                    if key.fileobj is self.listening:
                        pair = self.listening.accept()[0], socket.create_connection(("127.0.0.1", self._to))
                        self._all += pair
                        for one, other in (pair, pair[::-1]):
                            self._pairs[one] = other
                            ready.register(one, selectors.EVENT_READ)
                        continue
                    data = key.fileobj.recv(65536)
                    other = self._pairs.get(key.fileobj)
                    if not data:
                        ready.unregister(key.fileobj)
                    elif other is not None:
                        other.sendall(data)

    def cut(self):
        self._pairs = {}

    def close(self):
        self._ending = True
        self._thread.join()
        for one in self._all:
            one.close()


def test_a_connection_that_died_without_a_word_is_made_anew(runtime, context, monkeypatch):
    monkeypatch.setattr(transport, "PATIENCE_MS", 300)
    port = free_port()
    publisher = Publisher("publisher", context, address=f"tcp://127.0.0.1:{port}")
    cable = Cable(port)

    def arrives(skin):
        publisher.poll()
        publisher.send(frame())
        try:
            skin.next_frame(0.05)
        except Stale:
            return False
        return True

    try:
        with ContactSubscriber("palm", f"tcp://127.0.0.1:{cable.port}") as skin:
            until(lambda: arrives(skin))
            cable.cut()
            until(lambda: not arrives(skin))
            until(lambda: arrives(skin))
    finally:
        cable.close()
        publisher.close()
