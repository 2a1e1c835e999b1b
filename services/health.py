"""Does a process answer, and do frames flow through it? What a container's healthcheck asks.

python -m services.health publisher      exit 0: yes. 1: no, and why.
"""

from __future__ import annotations

import sys

from protocol.runtime import RuntimeDirError
from protocol.sockets import ControlClient, ControlError

TIMEOUT_S = 2.0


def check(process: str) -> str:
    """What is wrong with a process: empty where frames flow through it (or nobody wants them)."""
    try:
        status = ControlClient(process, TIMEOUT_S).call("status")
    except (ControlError, RuntimeDirError) as why:
        return f"{process}: {why}"
    if status.get("flowing", True):  # recorder and stub report what is specific to them, and are well if they answer
        return ""
    return f"{process}: no frames for {status.get('quiet_s', 0):.1f} s; " + "; ".join(status.get("messages", []))


def main() -> int:
    if len(sys.argv) != 2:
        print("usage: python -m services.health PROCESS", file=sys.stderr)
        return 2
    wrong = check(sys.argv[1])
    print(wrong or f"{sys.argv[1]}: frames flow")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
