"""What every bridge does as a process: settings, sockets of its own, heartbeat, commands, signals; and the loop.

A bridge is started by `python -m services.bridge NAME`, which hands it its settings as JSON in $EITSKIN_BRIDGE: it
reads no configuration itself.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zmq

from protocol import logs, transport
from protocol.control import ControlServer
from protocol.errors import EitskinError
from protocol.publishing import Publisher
from protocol.runtime import AlreadyRunning, RuntimeDirError, lock
from protocol.transport import Socket, Transport, TransportError

from .pulse import Pulse

SETTINGS = "EITSKIN_BRIDGE"
TICK_S = 0.1
"""How often a bridge looks who wants what; also the longest wait, see protocol/freshness.py:WAIT_SLICE_S."""

log = logging.getLogger(__name__)


class BridgeError(EitskinError):
    """The bridge cannot start. The text says what was found and what to do."""


@dataclass(frozen=True)
class BridgedSkin:
    """What a bridge is told of a skin."""

    frame_id: str
    stub: bool  # whether its board is the stub, which can be pressed


@dataclass(frozen=True)
class Handed:
    """The settings that a bridge is handed: the skins, how to reach the service, and the bridge's own section."""

    skins: dict[str, BridgedSkin]
    transport: Transport
    options: dict[str, Any] = field(default_factory=dict)
    log_level: str = "info"

    @staticmethod
    def read(text: str | None = None) -> Handed:
        """From JSON, $EITSKIN_BRIDGE unless given. Raises BridgeError."""
        text = os.environ.get(SETTINGS, "") if text is None else text
        try:
            found = json.loads(text)
            reach = found["transport"]
            return Handed(
                {name: BridgedSkin(str(skin["frame_id"]), bool(skin["stub"])) for name, skin in found["skins"].items()},
                Transport(
                    addresses=reach["addresses"],
                    secret_key=_path(reach["secret_key"]),
                    server_keys={name: Path(key) for name, key in reach["server_keys"].items()},
                    clients=_path(reach["clients"]),
                    operators=_path(reach["operators"]),
                    insecure=bool(reach["insecure"]),
                ),
                dict(found["options"]),
                str(found["log_level"]),
            )
        except (ValueError, LookupError, TypeError, AttributeError) as bad:
            found_text = f"found {text[:60]!r} ({type(bad).__name__}: {bad})" if text else "found nothing"
            raise BridgeError(
                f"${SETTINGS}: {found_text}, expected a bridge's settings as JSON: start it with `skin bridge NAME`"
            ) from None


def openable(host: str) -> str:
    """A host that is listened at, as part of an address to be opened on this computer: "all of them" is none."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"[{host}]" if ":" in host else host


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None


class Bridge(ABC):
    """One bridge: takes what arrives from the service, and hands it on. `pulses` keep count, skin by skin."""

    def __init__(self, name: str, handed: Handed) -> None:
        self.name, self.handed = name, handed
        self.pulses = {skin: Pulse(name, skin) for skin in handed.skins}

    @abstractmethod
    def sockets(self) -> Iterable[Socket]:
        """What to wait for. They may be others after each `tick`."""

    @abstractmethod
    def serve(self, waited_ns: int) -> None:
        """Take what has arrived; we have waited for it since `waited_ns`."""

    @abstractmethod
    def tick(self) -> None:
        """Every TICK_S: who wants what, what has fallen silent. Keeps `level`, `messages`, `idle` of each pulse."""

    @abstractmethod
    def close(self) -> None:
        """Close everything of one's own."""


INTERRUPTED = 130  # exit code of a shell's program that Ctrl-C ended


def main(name: str, make: Callable[[Handed], Bridge]) -> int:
    """A bridge's main. Returns the exit code; says on stderr what stands in the way."""
    logs.setup(f"{name}: %(message)s")
    try:
        handed = Handed.read()
        logging.getLogger().setLevel(handed.log_level.upper())
        transport.configure(handed.transport)
        with lock(process=name):
            bridge = make(handed)
            try:
                _Loop(bridge).run()
            finally:
                bridge.close()
    except KeyboardInterrupt:
        return INTERRUPTED
    except (AlreadyRunning, BridgeError, RuntimeDirError, TransportError) as why:
        print(f"{name}: {why}", file=sys.stderr)
        return 1
    return 0


class _Loop:
    """Waits for frames, commands and the clock."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._publisher = Publisher(bridge.name)
        self._control = ControlServer(bridge.name, {"status": self._status})
        self._stop = False

    def run(self) -> None:
        """Until SIGTERM; Ctrl-C raises KeyboardInterrupt, here as before the loop."""
        signal.signal(signal.SIGTERM, self._on_signal)
        next_tick = 0.0
        try:
            while not self._stop:
                waited_ns = time.monotonic_ns()
                self._wait(next_tick - waited_ns * 1e-9)
                self._bridge.serve(waited_ns)
                if time.monotonic() >= next_tick:
                    next_tick = time.monotonic() + TICK_S
                    self._tick()
        finally:
            self._control.close()
            self._publisher.close()

    def _wait(self, seconds: float) -> None:
        poller = zmq.Poller()
        for socket in (self._control.socket, self._publisher.socket, *self._bridge.sockets()):
            poller.register(socket, zmq.POLLIN)
        ready = dict(poller.poll(max(0, int(seconds * 1000 + 0.5))))
        if self._control.socket in ready:
            self._control.serve_once()
        if self._publisher.socket in ready:
            self._publisher.poll()

    def _tick(self) -> None:
        self._publisher.mind()
        self._control.mind()
        self._publisher.poll()
        self._bridge.tick()
        problems = self._publisher.problems + self._control.problems
        for pulse in self._bridge.pulses.values():
            frame = pulse.status(problems)
            if frame is not None:
                self._publisher.send(frame)

    def _status(self, args: dict[str, Any]) -> dict[str, Any]:
        skin = args.get("skin") or next(iter(self._bridge.pulses))
        if skin not in self._bridge.pulses:
            raise KeyError(f"skin, one of {', '.join(self._bridge.pulses)}")
        return self._bridge.pulses[skin].summary()

    def _on_signal(self, number: int, frame: object) -> None:
        self._stop = True
