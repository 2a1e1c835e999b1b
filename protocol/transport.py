"""The addresses and keys with which this process's sockets reach others. Every socket of the project is opened here.

By default all are ipc sockets in the runtime folder. A configuration may put producers at tcp:// addresses. Then CURVE
encrypts the traffic and both ends check each other's keys; beyond the loopback, TCP without CURVE is refused.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import secrets
import socket as sockets
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zmq

from . import runtime
from .frames import MAX_MESSAGE
from .gate import Gate
from .keys import Admission, KeyFolder, TransportError, read_pair, read_public, write_keys

__all__ = ["Context", "Socket", "Transport", "TransportError", "bind", "configure", "connect", "current", "write_keys"]

RECONNECT_MS = 30
"""How soon a reader looks again for a producer that has gone."""

PATIENCE_MS = 2000
"""A TCP peer that says nothing for so long, not even an answer to a heartbeat (host gone, cable out), is looked for
anew; without that, a reader that never sends would wait for it for ever.
"""

Context = zmq.Context[zmq.Socket[bytes]]
Socket = zmq.Socket[bytes]


@dataclass(frozen=True)
class Transport:
    """Addresses and keys.

    `addresses`: producer -> address of its data socket, `<process>.ctl` -> of its control socket; the runtime
    folder's for the rest. `secret_key`: file with our key pair (as `write_keys` makes it). `server_keys`: producer ->
    file with its public key. `clients`: folder with the public keys that may connect to us. `operators`: folder with
    the public keys that may also give commands that change something. `insecure`: allow unencrypted TCP beyond this
    host.
    """

    addresses: Mapping[str, str] = field(default_factory=dict)
    secret_key: Path | None = None
    server_keys: Mapping[str, Path] = field(default_factory=dict)
    clients: Path | None = None
    operators: Path | None = None
    insecure: bool = False

    @property
    def keyed(self) -> bool:
        """Whether any key is configured: then no TCP socket works without keys."""
        return bool(self.secret_key or self.server_keys or self.clients or self.operators)

    def data_address(self, producer: str) -> str:
        """Where `producer` publishes."""
        return self.addresses.get(producer) or runtime.endpoint(producer)

    def control_address(self, process: str) -> str:
        """Where `process` takes commands."""
        return self.addresses.get(f"{process}.ctl") or runtime.control_endpoint(process)


_current = Transport()
_gates: dict[int, Gate] = {}


def configure(transport: Transport) -> None:
    """Use `transport` for all sockets that this process opens from now on. Raises TransportError where its keys are
    only half configured or cannot be used.
    """
    check(transport)
    global _current
    _current = transport


def current() -> Transport:
    """The transport in use."""
    return _current


def check(transport: Transport) -> None:
    """Raises TransportError where keys are half configured, or a key file cannot be used."""
    if missing := half(transport):
        raise TransportError(f"keys are half configured: expected {missing}")
    if transport.secret_key is None:
        return
    read_pair(transport.secret_key)
    for key in transport.server_keys.values():
        read_public(key)
    for what in ("clients", "operators"):
        folder: Path | None = getattr(transport, what)
        if folder is not None and not folder.is_dir():
            raise TransportError(f"{what}: found no folder {folder}: make it, and put public keys (*.key) into it")


def half(transport: Transport) -> str:
    """What is missing where keys are only half configured, so that traffic would be unencrypted or unchecked; else
    "".
    """
    if not transport.keyed:
        return ""
    if transport.secret_key is None:
        given = [name for name in ("server_keys", "clients", "operators") if getattr(transport, name)]
        return (
            f"secret_key too (found {' and '.join(given)} without it: nothing would be encrypted); "
            "make a key pair with `skin keys new`"
        )
    if transport.clients is None and transport.operators is not None:
        return "clients too, the folder of the public keys that may read (found operators without it)"
    if transport.clients is None and not transport.server_keys:
        return (
            "clients or server_keys too (found secret_key alone): a service needs the folder of its clients' public "
            "keys, a client the public key of each process it connects to"
        )
    return ""


def admission(address: str, transport: Transport | None = None) -> Admission | None:
    """The keys that a socket bound at `address` lets in; None where no key is asked for (ipc, where the folder's rights
    decide, and unencrypted TCP). Raises TransportError for an address that would be open to others against the
    configuration.
    """
    transport = transport or _current
    if not address.startswith("tcp://"):
        return None
    if not transport.keyed:
        if not transport.insecure and not _is_loopback(address):
            raise TransportError(
                f"{address} would be open, unencrypted, to other hosts: configure CURVE keys, or say insecure = true"
            )
        return None
    check(transport)
    if transport.clients is None or transport.secret_key is None:
        raise TransportError(
            f"{address} needs `clients`, the folder of the clients' public keys: without it nobody could be refused"
        )
    operators = KeyFolder(transport.operators) if transport.operators else None
    return Admission(*read_pair(transport.secret_key), KeyFolder(transport.clients), operators)


def bind(
    context: Context,
    kind: int,
    address: str,
    options: Mapping[int, Any],
    admitted: Admission | None = None,
    *,
    guarded: bool = False,
) -> Socket:
    """A bound socket. `admitted` is what `admission(address)` gave. `guarded`: peers that flooded us are refused.

    Raises TransportError for an address that is taken.
    """
    socket = _open(context, kind, options)
    try:
        if admitted is not None:
            socket.curve_publickey, socket.curve_secretkey = admitted.own, admitted.secret
            socket.curve_server = True
        if admitted is not None or guarded:
            gate(context).guard(socket, secrets.token_hex(8), admitted.admit if admitted is not None else None)
        taken_by(address)
        socket.bind(address)
    except zmq.ZMQError as bad:
        socket.close(0)
        hints = {
            zmq.EADDRINUSE: ": another program uses it, or another of our sockets; end it, or choose another port",
            errno.ENOENT: ": there is no such folder",
        }
        hint = hints.get(bad.errno or 0, "")
        raise TransportError(f"cannot listen at {address}: {bad.strerror}{hint}") from None
    except TransportError:
        socket.close(0)
        raise
    return socket


def listener(address: str) -> int | None:
    """The process that listens at an ipc address (0: of another container), None where nobody does."""
    if not address.startswith("ipc://"):
        return None
    with sockets.socket(sockets.AF_UNIX, sockets.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fsencode(address.removeprefix("ipc://")))
        except BlockingIOError:  # somebody, whose queue is full
            return 0
        except OSError:
            return None
        credentials = probe.getsockopt(sockets.SOL_SOCKET, sockets.SO_PEERCRED, struct.calcsize("3i"))
        return int(struct.unpack("3i", credentials)[0])


def taken_by(address: str) -> None:
    """Raises TransportError where another process listens at this ipc address: ZeroMQ would take it over silently."""
    owner = listener(address)
    if owner is not None and owner != os.getpid():
        who = f"process {owner}" if owner else "a process of another container"
        raise TransportError(
            f"cannot listen at {address}: {who} does already; end it, or give this service its own EITSKIN_RUNTIME"
        )


def try_out(addresses: Mapping[str, str], transport: Transport) -> None:
    """Raises TransportError where processes that are to listen at these addresses, all at once, would fail."""
    with contextlib.ExitStack() as until_all_are_bound:
        context = until_all_are_bound.enter_context(zmq.Context())
        listening: dict[str, str] = {}
        for name, address in addresses.items():
            admission(address, transport)
            if address in listening:  # of ipc, ZeroMQ would take it over silently
                raise TransportError(f"{name} cannot listen at {address}: {listening[address]} is to listen there too")
            listening[address] = name
            try:
                until_all_are_bound.callback(bind(context, zmq.XPUB, address, {}).close, 0)
            except TransportError as bad:
                raise TransportError(f"{name}: {bad}") from None


def connect(context: Context, kind: int, addresses: Mapping[str, str], options: Mapping[int, Any]) -> Socket:
    """A socket connected to `addresses` (name of who is there -> address); who is not there yet is found when it
    comes. Raises TransportError where that would be unencrypted against the configuration.
    """
    socket = _open(context, kind, options)
    try:
        if any(address.startswith("tcp://") for address in addresses.values()):
            socket.setsockopt(zmq.HEARTBEAT_IVL, PATIENCE_MS // 2)
            for option in (zmq.HEARTBEAT_TIMEOUT, zmq.CONNECT_TIMEOUT):
                socket.setsockopt(option, PATIENCE_MS)
        # ipc first: keys, once set, hold for all that is connected after.
        for name, address in sorted(addresses.items(), key=lambda item: item[1].startswith("tcp://")):
            attach(socket, name, address)
    except zmq.ZMQError as bad:
        socket.close(0)
        raise TransportError(
            f"cannot connect to {address}: {bad.strerror}; expected ipc://PATH or tcp://HOST:PORT"
        ) from None
    except TransportError:
        socket.close(0)
        raise
    return socket


def attach(socket: Socket, name: str, address: str) -> None:
    """Connect a socket to one more. Raises TransportError, zmq.ZMQError."""
    if address.startswith("tcp://"):
        _use_keys(socket, name, address)
    socket.connect(reachable(address))


def _use_keys(socket: Socket, name: str, address: str) -> None:
    """Set the keys for connecting to `name`. Raises TransportError where that would be neither encrypted nor allowed
    to be in clear.
    """
    transport = _current
    if not transport.keyed:
        if not transport.insecure and not _is_loopback(address):
            raise TransportError(
                f"{address} would be read unencrypted, from whoever answers there: configure secret_key and "
                f"server_keys for {name}, or say insecure = true"
            )
        return
    check(transport)
    assert transport.secret_key is not None
    public, secret = read_pair(transport.secret_key)
    socket.curve_publickey, socket.curve_secretkey = public, secret
    if name in transport.server_keys:
        socket.curve_serverkey = read_public(transport.server_keys[name])
    elif transport.clients is not None:  # we are this service: all its processes hold our own key
        socket.curve_serverkey = public
    else:
        raise TransportError(
            f"{address}: found a secret_key but no server key of {name}: anybody could answer there; name the file of "
            f"its public key as server_keys, {{ {name} = FILE }}"
        )


def reachable(address: str) -> str:
    """Where to connect to what listens at `address`: on this host, where it listens on every interface."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not address.startswith("tcp://") or host not in ("*", "0.0.0.0", "[::]"):
        return address
    return f"tcp://{'[::1]' if host == '[::]' else '127.0.0.1'}:{port}"


def gate(context: Context) -> Gate:
    """Who decides on the handshakes of this context's sockets; started at the first call."""
    if context.underlying not in _gates:
        _gates[context.underlying] = Gate(context)
    return _gates[context.underlying]


def stop_gate(context: Context) -> None:
    """End the thread that decides on the handshakes of this context; before the context is closed."""
    found = _gates.pop(context.underlying, None)
    if found is not None:
        found.stop()


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
