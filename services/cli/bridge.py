"""`skin bridge NAME`: show contacts on the live page, hand them on to ROS 2 or Foxglove."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

import typer

from protocol.topics import BRIDGES
from services.cli.common import USAGE, config_file, fail, of_service

BridgeName = Enum("BridgeName", {name: name for name in BRIDGES})  # type: ignore[misc]


def register(app: typer.Typer) -> None:
    app.command("bridge")(of_service(bridge))


def bridge(
    name: Annotated[BridgeName, typer.Argument(help="Which one; its section in skin.toml has its settings.")],
) -> None:
    """Show contacts, or hand them on to another world, in the foreground, beside a running service; Ctrl-C ends it."""
    from services.bridge import MissingExtra, become
    from services.runtime.config import load

    try:
        become(name.value, load(config_file()))
    except MissingExtra as why:
        fail(str(why), USAGE)
