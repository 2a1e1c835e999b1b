"""`skin bridge NAME`: show contacts on the live page, or hand them on to Foxglove."""

from __future__ import annotations

from typing import Annotated

import typer

from services.cli.common import USAGE, config_file, fail, of_service


def register(app: typer.Typer) -> None:
    app.command("bridge")(of_service(bridge))


def bridge(
    name: Annotated[str, typer.Argument(help="page or foxglove; its section in skin.toml has its settings.")],
) -> None:
    """Show contacts, or hand them on to another world, in the foreground, beside a running service; Ctrl-C ends it."""
    from protocol.topics import BRIDGES
    from services.bridge import MissingExtra, become
    from services.runtime.config import NO_ROS2, load

    if name == "ros2":
        fail(NO_ROS2, USAGE)
    if name not in BRIDGES:
        fail(f"no bridge {name!r}: expected {' or '.join(BRIDGES)}", USAGE)
    try:
        become(name, load(config_file()))
    except MissingExtra as why:
        fail(str(why), USAGE)
