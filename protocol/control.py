"""Commands: one control socket per process, typed replies, and no caller that waits for ever.

A request is a msgpack map {command: text, args: map}, checked against the table of protocol/commands.py; the reply
{ok: true, result: map} or {ok: false, error: {type, message}}. Any ZeroMQ REQ socket can talk to it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgpack
import zmq

from . import transport
from .commands import COMMANDS, BadArgument, Command, checked
from .errors import EitskinError
from .fields import brief
from .frames import FrameError, read_map
from .gate import described, peer_of
from .listening import Listening
from .logs import foreign
from .runtime import host_id
from .transport import Context, Socket

READ_ONLY = ("clock", "status", "state")
"""Commands that change nothing. Over TCP all others need the key of an operator."""

QUEUE = 8
"""Requests held for each peer, and answers held for one that does not read them; its further ones are dropped."""

BUSY = 100
"""Requests a second from which on status speaks of a flood. They are answered one at a time, frames come first."""

OFTEN = ("part",)
"""Commands that a replay gives after each part of a scan. Where the peer may give them they are no flood."""

SPOKEN_OF_S = 5.0

Handler = Callable[[dict[str, Any]], dict[str, Any]]

log = logging.getLogger(__name__)


class ControlError(EitskinError, RuntimeError):
    """A command was not carried out.

    `kind` is `unreachable` (no such process), `timeout` (no answer), `bad_reply`, `bad_request`, `unknown_command`,
    `forbidden` (needs an operator's key), `other_host`, or the name of the exception that the command raised in the
    process.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(kind, message)
        self.kind, self.message = kind, message

    def __str__(self) -> str:
        return self.message


class ControlServer:
    """Takes a process's commands: `handlers` maps a command's name to a function from its arguments to its result.

    Their arguments are checked by the table `commands` first: a handler gets those of its command, each of its type,
    and none that is nil. Poll `socket` and call `serve_once` when it is readable, and `mind` at least once a second. An
    exception in a handler becomes the reply; the process goes on. `clock` is built in: this host's monotonic clock,
    from which a reader elsewhere finds its offset (see `clock_offset`).

    On an ipc socket the runtime folder's rights decide who may give commands. Over TCP clients may give READ_ONLY
    ones, and operators, known by their keys, all.
    """

    def __init__(
        self,
        process: str,
        handlers: Mapping[str, Handler],
        *,
        address: str | None = None,
        context: Context | None = None,
        commands: Mapping[str, Command] = COMMANDS,
    ) -> None:
        """Raises ValueError for a handler of a command that is not in the table."""
        self.process = process
        self.handlers: dict[str, Handler] = {}
        self._table = {**commands, "clock": COMMANDS["clock"]}
        self.add({"clock": _clock, **handlers})
        self.malformed = 0
        self._listening = Listening(
            context or zmq.Context.instance(),
            zmq.ROUTER,
            address or transport.current().control_address(process),
            {zmq.LINGER: 200, zmq.RCVHWM: QUEUE, zmq.SNDHWM: QUEUE},  # so long the answer to "stop" may still go out
        )
        self._second, self._asked, self._flood, self._flood_until = 0, 0, "", 0.0

    def add(self, handlers: Mapping[str, Handler]) -> None:
        """Take further commands. Raises ValueError for one that is not in the table."""
        if unknown := sorted(handlers.keys() - self._table.keys()):
            raise ValueError(f"no command {', '.join(unknown)} in protocol/commands.py: add it with its arguments")
        self.handlers.update(handlers)

    @property
    def socket(self) -> Socket:
        """The socket in use; another one after `mind` has mended something."""
        return self._listening.socket

    @property
    def problems(self) -> list[str]:
        """What status should say of the socket."""
        flood = [self._flood] if time.monotonic() < self._flood_until else []
        return self._listening.problems + flood

    def mind(self) -> bool:
        """Check that the socket is still reachable as configured and mend it where needed; returns whether `socket` is
        another one now.
        """
        return self._listening.mind()

    def serve_once(self, timeout_s: float = 0.0) -> bool:
        """Answer one request if there is one within `timeout_s`; whether there was."""
        if not self.socket.poll(int(timeout_s * 1000)):
            return False
        try:
            frames = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return False
        peer = peer_of(frames[-1], self._listening.secured)
        if len(frames) < 3 or frames[-2].bytes != b"":
            self._count(peer)
            self.malformed += 1
            return True
        try:
            answer = self._answer(frames[-1].bytes, peer)
            self.socket.send_multipart([*(frame.bytes for frame in frames[:-1]), answer], zmq.NOBLOCK)
        except zmq.ZMQError as bad:  # the caller has gone
            log.debug("reply not sent: %s", bad)
        return True

    def _count(self, peer: str) -> None:
        """Count a peer's requests, and cut off one that asks too often."""
        now = time.monotonic()
        if int(now) != self._second:
            self._second, self._asked = int(now), 0
        self._asked += 1
        if self._asked == BUSY:
            self._flood = f"more than {BUSY} control requests a second, the last from {described(peer)}: mend or end it"
            if now > self._flood_until:
                log.warning("%s: %s", self.process, self._flood)
            self._flood_until = now + SPOKEN_OF_S

    def _forbidden(self, command: str, peer: str) -> str:
        """Why `peer` may not give this command; "" where it may."""
        if not self._listening.address.startswith("tcp://"):
            return ""
        admitted = self._listening.admission
        if admitted is not None and admitted.operates(peer.encode()):
            return ""
        if command in READ_ONLY and (admitted is None or admitted.allows(peer.encode())):
            return ""
        if admitted is None:
            return f"over unencrypted TCP only {', '.join(READ_ONLY)} are answered; {command} needs an operator's key"
        return (
            f"{command} needs the key of an operator: put the caller's public key into the folder that "
            "security.operators of the service names"
        )

    def _answer(self, request: bytes, peer: str) -> bytes:
        try:
            asked = read_map(request, f"{self.process} control")
            command, args = asked.get("command"), asked.get("args", {})
            if not isinstance(command, str) or not isinstance(args, dict):
                raise FrameError("control", "command, args", f"{brief(command)}, {type(args).__name__}", "text, map")
        except FrameError as bad:
            self._count(peer)
            self.malformed += 1
            return _refusal("bad_request", str(bad))
        handler, forbidden = self.handlers.get(command), self._forbidden(command, peer)
        if handler is None or forbidden or command not in OFTEN:
            self._count(peer)
        if handler is None:
            return _refusal(
                "unknown_command",
                f"{self.process} has no command {command[:64]!r}; it has: {', '.join(sorted(self.handlers))}",
            )
        if forbidden:
            return _refusal("forbidden", forbidden)
        try:
            return _packed({"ok": True, "result": handler(checked(command, self._table[command], args)) or {}})
        except BadArgument as bad:
            return _refusal("bad_request", str(bad))
        except ControlError as bad:
            return _refusal(bad.kind, bad.message)
        except Exception as bad:
            why = str(bad) or type(bad).__name__
            log.warning(
                "command %s failed: %s: %s", command, type(bad).__name__, foreign(why), exc_info=log.isEnabledFor(10)
            )
            return _refusal(type(bad).__name__, why)

    def close(self) -> None:
        """Close the socket, giving the last answer 0.2 s to leave."""
        self._listening.close(None)


class ControlClient:
    """Sends commands to one process. Each call uses a fresh socket: no late answer or unsent request outlives it."""

    def __init__(
        self, process: str, timeout_s: float = 2.0, *, address: str | None = None, context: Context | None = None
    ) -> None:
        self.process, self.timeout_s = process, timeout_s
        self.address = address or transport.current().control_address(process)
        self.round_trip_ns = (0, 0)
        """When the last request left and its answer came back, on our monotonic clock."""
        self._context = context or zmq.Context.instance()

    def call(self, command: str, /, **args: Any) -> dict[str, Any]:
        """The command's result. Raises ControlError, at the latest after `timeout_s`."""
        request = _packed({"command": command, "args": args})
        deadline = time.monotonic() + self.timeout_s
        # IMMEDIATE: writable only once somebody is there; no request waits for a process that starts later.
        socket = transport.connect(self._context, zmq.REQ, {self.process: self.address}, {zmq.IMMEDIATE: 1})
        try:
            if not socket.poll(_left_ms(deadline), zmq.POLLOUT):
                raise ControlError(
                    "unreachable",
                    f"{self.process} does not answer at {self.address}: is the service running (skin up)?",
                )
            sent = time.monotonic_ns()
            socket.send(request, zmq.NOBLOCK)
            if not socket.poll(_left_ms(deadline)):
                raise ControlError("timeout", f"{self.process} did not answer {command} within {self.timeout_s:g} s")
            packed = socket.recv(zmq.NOBLOCK)
            self.round_trip_ns = (sent, time.monotonic_ns())
            reply = read_map(packed, f"reply to {command}")
        except FrameError as bad:
            raise ControlError("bad_reply", str(bad)) from None
        except zmq.ZMQError as bad:
            raise ControlError("unreachable", f"{self.process} at {self.address}: {bad.strerror}") from None
        finally:
            socket.close(0)
        result, error = reply.get("result"), reply.get("error")
        if reply.get("ok") is True and isinstance(result, dict):
            return result
        if isinstance(error, dict):
            kind, message = error.get("type"), error.get("message")
            if isinstance(kind, str) and isinstance(message, str):
                unsaid = f"{self.process} refused {command} without saying why ({kind or 'no type'}): its log may"
                raise ControlError(kind or "bad_reply", message if message.strip() else unsaid)
        raise ControlError("bad_reply", f"{self.process} answered {command} with neither result nor error")


def clock_offset(client: ControlClient, tries: int = 8, host: str = "") -> tuple[int, int]:
    """How far the process's monotonic clock is ahead of ours, and the uncertainty of that, both in ns.

    The shortest of `tries` round trips, halved: the answer was made somewhere within it. With `host`, the clock of that
    one, as frames name it, and of no other. Raises ControlError.
    """
    best: tuple[int, int] | None = None
    for _ in range(tries):
        answer = client.call("clock")
        there = answer.get("monotonic_ns")
        if type(there) is not int:
            raise ControlError("bad_reply", f"{client.process} answered clock with {brief(there)}, expected ns")
        if host and answer.get("host") != host:
            raise ControlError("other_host", f"{client.process} runs on another host than {host}, whose clock is asked")
        sent, back = client.round_trip_ns
        if best is None or back - sent < 2 * best[1]:
            best = (there - (sent + back) // 2, (back - sent + 1) // 2)
    assert best is not None
    return best


def _clock(args: dict[str, Any]) -> dict[str, Any]:
    return {"monotonic_ns": time.monotonic_ns(), "host": host_id()}


def _left_ms(deadline: float) -> int:
    return max(0, int((deadline - time.monotonic()) * 1000))


def _refusal(kind: str, message: str) -> bytes:
    return _packed({"ok": False, "error": {"type": kind, "message": message}})


def _packed(value: dict[str, Any]) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed
