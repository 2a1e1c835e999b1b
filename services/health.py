"""Whether a process answers and frames flow through it, for a container's healthcheck.

python -m services.health publisher      exit 0: yes. 1: no, and why.

Stages are asked about each configured skin. The stub is healthy while it is plugged in and a host has it scan. A
recorder is healthy while the number of frames it has written grows.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from protocol import transport
from protocol.pause import pause
from protocol.runtime import RuntimeDirError
from protocol.sockets import ControlClient, ControlError
from protocol.transport import TransportError
from services.runtime.config import ConfigError, load

TIMEOUT_S = 2.0
GROWING_S = 0.5  # within which a recording must grow: ten frames of a board
BESIDES = ("status", "info", "state")  # topics of a recording that arrive without frames


def check(process: str, skins: Iterable[str]) -> str:
    """What is wrong with a process: empty where frames of all `skins` flow through it (or nobody wants them)."""
    try:
        client = ControlClient(process, TIMEOUT_S)
        if process == "stub":
            return _stub(client)
        if process == "recorder":
            return _recorder(client)
        return "; ".join(filter(None, (_stage(process, client, skin) for skin in skins)))
    except (ControlError, RuntimeDirError, TransportError) as why:
        return f"{process}: {why}"


def _stage(process: str, client: ControlClient, skin: str) -> str:
    status = client.call("status", skin=skin)
    if status.get("flowing"):
        return ""
    said = "".join(f"; {message}" for message in status.get("messages", []))
    return f"{process}: no frames of {skin} for {status.get('quiet_s', 0):.1f} s{said}"


def _stub(client: ControlClient) -> str:
    status = client.call("status")
    if not status.get("plugged"):
        return "stub: unplugged, as a fault or a scene asked for"
    return "" if status.get("scanning") else "stub: not scanning, no host has started it: does acquisition run?"


def _recorder(client: ControlClient) -> str:
    before = _recorded(client.call("status"))
    pause(GROWING_S)
    status = client.call("status")
    after = _recorded(status)
    if status.get("level") == "ERROR":
        return "recorder: " + "; ".join(map(str, status.get("problems", [])))
    return "" if after > before else f"recorder: {after} frames recorded, none in the last {GROWING_S:g} s"


def _recorded(status: dict[str, Any]) -> int:
    """Frames written so far."""
    counts = status.get("messages", {})
    return sum(n for topic, n in counts.items() if topic.partition("/")[0] not in BESIDES)


def main() -> int:
    if len(sys.argv) != 2:
        print("usage: python -m services.health PROCESS", file=sys.stderr)
        return 2
    try:
        config = load()
        transport.configure(config.transport())
    except (ConfigError, TransportError) as why:
        print(why)
        return 1
    wrong = check(sys.argv[1], config.skins)
    print(wrong or f"{sys.argv[1]}: frames flow")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
