"""How this process's sockets reach the others: which addresses, which keys. Every socket of the project is opened
here.

By default all are ipc sockets in the runtime folder. A configuration may put producers at tcp:// addresses; then
traffic is encrypted and both ends known to each other by CURVE, or, beyond the loopback, refused.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zmq
import zmq.auth

from . import runtime
from .frames import MAX_MESSAGE

if TYPE_CHECKING:
    import zmq.auth.thread

RECONNECT_MS = 30
"""How soon a reader looks again for a producer that has gone."""

PATIENCE_MS = 2000
"""A TCP peer that says nothing for so long, not even an answer to a heartbeat (host gone, cable out), is looked for
anew; without that, a reader that never sends would wait for it for ever.
"""

Context = zmq.Context[zmq.Socket[bytes]]
Socket = zmq.Socket[bytes]


class TransportError(RuntimeError):
    """A socket cannot be opened as configured: the message says what was found and what to do."""


@dataclass(frozen=True)
class Transport:
    """Addresses and keys.

    `addresses`: producer -> address of its data socket, `<process>.ctl` -> of its control socket; the runtime
    folder's for the rest. `secret_key`: file with our key pair (as `write_keys` makes it). `server_keys`: producer ->
    file with its public key. `clients`: folder with the public keys that may connect to us. `insecure`: allow
    unencrypted TCP beyond this host.
    """

    addresses: Mapping[str, str] = field(default_factory=dict)
    secret_key: Path | None = None
    server_keys: Mapping[str, Path] = field(default_factory=dict)
    clients: Path | None = None
    insecure: bool = False

    def data_address(self, producer: str) -> str:
        """Where `producer` publishes."""
        return self.addresses.get(producer) or runtime.endpoint(producer)

    def control_address(self, process: str) -> str:
        """Where `process` takes commands."""
        return self.addresses.get(f"{process}.ctl") or runtime.control_endpoint(process)


_current = Transport()
_authenticators: dict[int, zmq.auth.thread.ThreadAuthenticator] = {}


def configure(transport: Transport) -> None:
    """Use `transport` for all sockets that this process opens from now on."""
    global _current
    _current = transport


def current() -> Transport:
    """The transport in use."""
    return _current


def bind(context: Context, kind: int, address: str, options: Mapping[int, Any]) -> Socket:
    """A bound socket. Raises TransportError for an address that is taken, or unencrypted and reachable from other
    hosts.
    """
    transport = _current
    secured = transport.secret_key is not None and address.startswith("tcp://")
    if address.startswith("tcp://") and not secured and not transport.insecure and not _is_loopback(address):
        raise TransportError(
            f"{address} would be open, unencrypted, to other hosts: configure CURVE keys, or say insecure = true"
        )
    socket = _open(context, kind, options)
    if secured:
        _authenticate(context, transport)
        socket.curve_publickey, socket.curve_secretkey = _read_keys(transport.secret_key)
        socket.curve_server = True
    try:
        socket.bind(address)
    except zmq.ZMQError as bad:
        socket.close(0)
        raise TransportError(f"cannot listen at {address}: {bad.strerror}") from None
    return socket


def connect(context: Context, kind: int, addresses: Mapping[str, str], options: Mapping[int, Any]) -> Socket:
    """A socket connected to `addresses` (name of who is there -> address); who is not there yet is found when it
    comes.
    """
    transport = _current
    socket = _open(context, kind, options)
    if any(address.startswith("tcp://") for address in addresses.values()):
        socket.setsockopt(zmq.HEARTBEAT_IVL, PATIENCE_MS // 2)
        for option in (zmq.HEARTBEAT_TIMEOUT, zmq.CONNECT_TIMEOUT):
            socket.setsockopt(option, PATIENCE_MS)
    for name, address in addresses.items():
        if address.startswith("tcp://") and name in transport.server_keys:
            socket.curve_publickey, socket.curve_secretkey = _read_keys(transport.secret_key)
            socket.curve_serverkey = zmq.auth.load_certificate(transport.server_keys[name])[0]
        try:
            socket.connect(address)
        except zmq.ZMQError as bad:
            socket.close(0)
            raise TransportError(
                f"cannot connect to {address}: {bad.strerror}; expected ipc://PATH or tcp://HOST:PORT"
            ) from None
    return socket


def write_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Make a CURVE key pair: the files (public, secret), the latter readable by us only."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    public, secret = zmq.auth.create_certificates(folder, name)
    Path(secret).chmod(0o600)
    return Path(public), Path(secret)


def stop_authenticator(context: Context) -> None:
    """End the thread that checks clients of this context's CURVE sockets; before the context is closed."""
    authenticator = _authenticators.pop(context.underlying, None)
    if authenticator is not None:
        authenticator.stop()


def _open(context: Context, kind: int, options: Mapping[int, Any]) -> Socket:
    socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE)
    socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
    for option, value in options.items():
        socket.setsockopt(option, value)
    return socket


def _is_loopback(address: str) -> bool:
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host in ("localhost", "lo")


def _read_keys(path: Path | None) -> tuple[bytes, bytes]:
    if path is None:
        raise TransportError(
            "a CURVE connection needs a key pair of our own: make one and name it in the configuration"
        )
    try:
        public, secret = zmq.auth.load_certificate(path)
    except (OSError, ValueError) as bad:
        raise TransportError(f"key file {path}: {bad}") from None
    if secret is None:
        raise TransportError(f"key file {path} holds no secret key: name the .key_secret file")
    return public, secret


def _authenticate(context: Context, transport: Transport) -> None:
    """Start this context's authenticator once: only clients whose public keys lie in `transport.clients` get in."""
    if transport.clients is None:
        raise TransportError(
            "a CURVE socket needs the folder of the clients' public keys: without it nobody could be refused"
        )
    key = context.underlying
    if key not in _authenticators:
        import zmq.auth.thread  # here: it imports asyncio, which most processes do without

        authenticator = zmq.auth.thread.ThreadAuthenticator(context)
        authenticator.start()
        _authenticators[key] = authenticator
    _authenticators[key].configure_curve(domain="*", location=str(transport.clients))
