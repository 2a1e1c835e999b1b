"""Commands: one control socket per process, typed replies, and no caller that waits for ever.

A request is a msgpack map {command: text, args: map}; the reply {ok: true, result: map} or {ok: false, error: {type,
message}}. Any ZeroMQ REQ socket can talk to it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgpack
import zmq

from . import transport
from .frames import FrameError, read_map
from .runtime import host_id
from .transport import Context, Socket

Handler = Callable[[dict[str, Any]], dict[str, Any]]

log = logging.getLogger(__name__)


class ControlError(RuntimeError):
    """A command was not carried out.

    `kind` is `unreachable` (no such process), `timeout` (no answer), `bad_reply`, `bad_request`, `unknown_command`,
    `other_host`,
    or the name of the exception that the command raised in the process.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(kind, message)
        self.kind, self.message = kind, message

    def __str__(self) -> str:
        return self.message


class ControlServer:
    """Takes a process's commands: `handlers` maps a command's name to a function from its arguments to its result.

    Poll `socket` and call `serve_once` when it is readable. An exception in a handler becomes the reply; the process
    goes on. `clock` is built in: this host's monotonic clock, from which a reader elsewhere finds its offset (see
    `clock_offset`).
    """

    def __init__(
        self,
        process: str,
        handlers: Mapping[str, Handler],
        *,
        address: str | None = None,
        context: Context | None = None,
    ) -> None:
        self.process = process
        self.handlers: dict[str, Handler] = {"clock": _clock, **handlers}
        self.malformed = 0
        self.socket: Socket = transport.bind(
            context or zmq.Context.instance(),
            zmq.ROUTER,
            address or transport.current().control_address(process),
            {zmq.LINGER: 200},  # so that the answer to "stop" still goes out
        )

    def serve_once(self, timeout_s: float = 0.0) -> bool:
        """Answer one request if there is one within `timeout_s`; whether there was."""
        if not self.socket.poll(int(timeout_s * 1000)):
            return False
        try:
            parts = self.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return False
        if len(parts) < 3 or parts[-2] != b"":
            self.malformed += 1
            return True
        try:
            self.socket.send_multipart([*parts[:-1], self._answer(parts[-1])], zmq.NOBLOCK)
        except zmq.ZMQError as bad:  # the caller has gone
            log.debug("reply not sent: %s", bad)
        return True

    def _answer(self, request: bytes) -> bytes:
        try:
            asked = read_map(request, f"{self.process} control")
            command, args = asked.get("command"), asked.get("args", {})
            if not isinstance(command, str) or not isinstance(args, dict):
                raise FrameError("control", "command, args", f"{command!r:.40}, {type(args).__name__}", "text, map")
        except FrameError as bad:
            self.malformed += 1
            return _refusal("bad_request", str(bad))
        handler = self.handlers.get(command)
        if handler is None:
            return _refusal(
                "unknown_command",
                f"{self.process} has no command {command[:64]!r}; it has: {', '.join(sorted(self.handlers))}",
            )
        try:
            return _packed({"ok": True, "result": handler(args) or {}})
        except ControlError as bad:
            return _refusal(bad.kind, bad.message)
        except Exception as bad:
            why = f"{command} needs the argument {bad}" if isinstance(bad, KeyError) else str(bad) or type(bad).__name__
            log.warning("command %s failed: %s: %s", command, type(bad).__name__, why, exc_info=log.isEnabledFor(10))
            return _refusal(type(bad).__name__, why)

    def close(self) -> None:
        """Close the socket, giving the last answer 0.2 s to leave."""
        self.socket.close()


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
            raise ControlError(str(error.get("type")), str(error.get("message")))
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
            raise ControlError("bad_reply", f"{client.process} answered clock with no time")
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
