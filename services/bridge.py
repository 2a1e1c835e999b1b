"""Starts a bridge: `python -m services.bridge NAME` becomes `python -m bridges.NAME`, with its settings as JSON.

A bridge is a client: it knows `protocol` alone, and is told by us what skin.toml says.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import Any

from protocol import logs
from protocol.errors import EitskinError
from protocol.topics import BRIDGES
from services.runtime.config import ROOT, ConfigError, ConfigFile, load

NEEDS = {"page": "aiohttp", "foxglove": "foxglove"}
"""What each needs: an extra of its own in pyproject.toml, the page's among the service's own packages."""


class MissingExtra(EitskinError):
    """A bridge's packages are not installed. The text says what to do."""


def check(name: str) -> None:
    """Raises MissingExtra where the bridge cannot run here."""
    if importlib.util.find_spec(NEEDS[name]) is None:
        extra = "" if name == "page" else f" EXTRAS={name}"
        raise MissingExtra(
            f"the bridge {name} needs the package {NEEDS[name]}, which is not installed: run `make venv{extra}`"
        )


def settings(name: str, config: ConfigFile, host: str = "", port: int = 0) -> str:
    """What the bridge is told, as JSON. `host`, `port`: where it listens, whatever the configuration says."""
    reach = config.transport()
    options = getattr(config, name).model_dump(mode="json")
    if options.get("recordings") and config.recorder is not None:
        options["recordings"] = str(config.relative(Path(config.recorder.folder)))
    told: dict[str, Any] = {
        "skins": {
            skin: {"frame_id": found.frame_id, "stub": found.port == "stub"} for skin, found in config.skins.items()
        },
        "transport": {
            "addresses": dict(reach.addresses),
            "secret_key": _absolute(reach.secret_key),
            "server_keys": {name: _absolute(key) for name, key in reach.server_keys.items()},
            "clients": _absolute(reach.clients),
            "operators": _absolute(reach.operators),
            "insecure": reach.insecure,
        },
        "options": options | ({"host": host} if host else {}) | ({"port": port} if port else {}),
        "log_level": config.logging.level,
    }
    return json.dumps(told)


def _absolute(path: Any) -> str | None:
    return None if path is None else os.path.abspath(path)


def become(name: str, config: ConfigFile, host: str = "", port: int = 0) -> None:
    """Go on as the bridge, in this very process. Raises MissingExtra."""
    check(name)
    environment = {**os.environ, "EITSKIN_BRIDGE": settings(name, config, host, port)}
    os.chdir(ROOT)
    os.execve(sys.executable, [sys.executable, "-m", f"bridges.{name}"], environment)


def main() -> int:
    parser = argparse.ArgumentParser(prog="services.bridge", description="Starts a bridge, beside a running service.")
    parser.add_argument("name", choices=BRIDGES)
    parser.add_argument("--host", default="", help="where it listens, whatever skin.toml says: in a container")
    parser.add_argument("--port", type=int, default=0, help="likewise: the one that the container shows to its host")
    args = parser.parse_args()
    logs.setup(f"{args.name}: %(message)s")
    try:
        become(args.name, load(), args.host, args.port)
    except (ConfigError, MissingExtra) as why:
        print(f"{args.name}: {why}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    raise SystemExit(main())
