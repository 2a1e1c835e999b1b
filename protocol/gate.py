"""Who may connect to our sockets: the answer to ZeroMQ's question at each handshake (ZAP, ZeroMQ RFC 27).

CURVE sockets let in the keys of their list. A peer that flooded us is refused for a while, on any socket. A refused
peer gets no answer: its connection ends after HANDSHAKE_MS and its library tries again, so that a key that is added
later works without a restart. (A peer that is told no never comes back, because libzmq ends its session for good.)
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

import zmq
from zmq.utils import z85

from .logs import foreign

HANDSHAKE_MS = 1000
REFUSED_S = 60.0
"""How long a peer that flooded us is refused."""

Allowed = Callable[[bytes], bool]
"""Whether a public key may connect."""


class Gate:
    """Answers the handshakes of one context's sockets, on a thread of its own that ends with the context."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._allowed: dict[str, Allowed] = {}
        self._refused: dict[str, float] = {}
        # A shadow: closing all sockets of the context itself must not close ours under the thread that reads it.
        shadow: zmq.Context[zmq.Socket[bytes]] = zmq.Context.shadow(context.underlying)
        self._socket: zmq.Socket[bytes] = shadow.socket(zmq.ROUTER)
        self._socket.linger = 0
        self._socket.bind("inproc://zeromq.zap.01")
        self._ending = False
        self._thread = threading.Thread(target=self._answer, name="gate", daemon=True)
        self._thread.start()

    def guard(self, socket: zmq.Socket[bytes], domain: str, allowed: Allowed | None) -> None:
        """Have the handshakes of `socket`, which is not yet bound, ask this gate. None: let in all that have not
        flooded us.
        """
        socket.zap_domain = domain.encode()
        socket.handshake_ivl = HANDSHAKE_MS
        if allowed is not None:
            self._allowed[domain] = allowed

    def refuse(self, peer: str) -> None:
        """Let this peer (see `peer_of`) in no more for REFUSED_S; what is connected stays so until its socket ends."""
        now = time.monotonic()
        self._refused = {who: until for who, until in self._refused.items() if until > now}
        self._refused[peer] = now + REFUSED_S

    def _answer(self) -> None:
        while not self._ending:
            try:
                if self._socket.poll(500):
                    self._reply(self._socket.recv_multipart())
            except zmq.ZMQError:  # the context ends
                break
        self._socket.close(0)

    def _reply(self, request: list[bytes]) -> None:
        """Let in who may come. Others get no reply."""
        if len(request) < 8 or request[1:3] != [b"", b"1.0"]:
            return
        who, empty, version, number, domain, address, _, mechanism, *credentials = request
        peer = address.decode("ascii", "replace")
        if mechanism == b"CURVE":
            key = z85.encode(credentials[0]) if credentials and len(credentials[0]) == 32 else b""
            allowed = self._allowed.get(domain.decode("ascii", "replace"))
            if allowed is None or not allowed(key):
                return
            peer = key.decode()
        if self._refused.get(peer, 0.0) > time.monotonic():
            return
        with contextlib.suppress(zmq.ZMQError):  # the context ends, or the peer has gone
            self._socket.send_multipart([who, empty, version, number, b"200", b"", peer.encode(), b""])

    def stop(self) -> None:
        """End the thread; no CURVE handshake of this context succeeds any more."""
        self._ending = True
        self._thread.join(2)


def peer_of(frame: zmq.Frame, secured: bool) -> str:
    """Who sent a message: on a secured socket its public key, else its address, on an ipc socket with the process id
    ("localhost:UID:GID:PID"). Without a gate a peer may claim any key, so its word is not asked for.
    """
    try:
        return str(frame.get("User-Id" if secured else "Peer-Address"))
    except zmq.ZMQError:
        return ""


def described(peer: str) -> str:
    """The peer as text for a person."""
    parts = peer.split(":")
    if len(parts) == 4:
        return f"process {parts[3]} of user {parts[1]}" if parts[3] != "0" else "a process of another container"
    return foreign(f"the holder of the key {peer}" if len(peer) == 40 else f"a client at {peer or 'an unknown place'}")


def is_one(peer: str) -> bool:
    """Whether `peer` names one process or one key, so that refusing it hits nobody else."""
    parts = peer.split(":")
    return len(peer) == 40 or (len(parts) == 4 and parts[3] != "0")
