"""Makes connections anew that ZeroMQ has given up.

libzmq connects again by itself to a peer that goes away, but never to one that broke its protocol (a message beyond
MAXMSGSIZE, bytes that are none of ZMTP): that session ends for good, and the reader would hear nothing of the rightful
peer that takes the address later.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import zmq
from zmq.utils.monitor import parse_monitor_message

from . import transport
from .transport import Socket, TransportError

GRACE_S = 1.0
"""How long libzmq has for coming back by itself."""
CHECK_S = 0.25
EVENTS_AT_ONCE = 1000


class Connections:
    """Those of one connecting socket, to `addresses` (name of who is there -> address). Call `mind` now and then,
    from the socket's thread.
    """

    def __init__(self, socket: Socket, addresses: Mapping[str, str]) -> None:
        self._socket, self._addresses = socket, dict(addresses)
        self._monitor = socket.context.socket(zmq.PAIR)
        self._monitor.linger = self._monitor.rcvhwm = 0  # bounded, libzmq's own thread would wait for us
        where = f"inproc://connections-{id(self):x}-{time.monotonic_ns():x}"
        socket.monitor(where, zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED)
        self._monitor.connect(where)
        self._broken: dict[str, float] = {}  # endpoint as libzmq names it -> since when
        self._looked_s = 0.0
        self.renewed = 0

    def mind(self) -> None:
        """Connect anew to peers that have been missing for GRACE_S since their connection broke."""
        now = time.monotonic()
        if now - self._looked_s < CHECK_S:
            return
        self._looked_s = now
        for _ in range(EVENTS_AT_ONCE):
            if not int(self._monitor.get(zmq.EVENTS)) & zmq.POLLIN:
                break
            event = parse_monitor_message(self._monitor.recv_multipart())
            endpoint = event["endpoint"].decode(errors="replace")
            if event["event"] == zmq.EVENT_DISCONNECTED:
                self._broken.setdefault(endpoint, now)
            else:
                self._broken.pop(endpoint, None)
        for endpoint, since in list(self._broken.items()):
            if now - since >= GRACE_S:
                del self._broken[endpoint]
                self._renew(endpoint)

    def _renew(self, endpoint: str) -> None:
        named = {name: address for name, address in self._addresses.items() if transport.reachable(address) == endpoint}
        kind = endpoint.partition("://")[0]  # a host that has a name is known by its number there
        for name, address in (named or self._addresses).items():
            secured = int(self._socket.get(zmq.MECHANISM)) == zmq.CURVE
            if not address.startswith(kind) or (secured and kind == "ipc"):  # keys, once set, hold for ipc too
                continue
            try:
                self._socket.disconnect(transport.reachable(address))
                transport.attach(self._socket, name, address)
                self.renewed += 1
            except (zmq.ZMQError, TransportError):  # the key file is not there just now, perhaps
                self._broken[endpoint] = time.monotonic()

    def close(self) -> None:
        """Stop looking. To be called before the socket is closed."""
        if not self._socket.closed:
            self._socket.monitor(None, 0)
        self._monitor.close(0)
