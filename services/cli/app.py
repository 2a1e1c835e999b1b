"""The command `skin`: all commands by group, and the one place where errors become a line and an exit code."""

from __future__ import annotations

import errno
import io
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from protocol import __version__
from protocol.errors import interrupted
from services.cli import (
    board,
    bridge,
    calibrate,
    collect,
    dev,
    export,
    golden,
    info,
    new_skin,
    offline,
    recordings,
    service,
    watch,
)
from services.cli.common import FAILED, USAGE, expected_code, with_values
from services.runtime import room

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


class _Commands(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        """Runs the command that was typed. An option out of its range also says what was found."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as bad:
            if (errors := getattr(bad.__cause__, "errors", None)) is not None:  # pydantic's: it checks for typer
                bad.message += f", found {errors()[0]['input']!r}"
            raise


app = typer.Typer(
    name="skin",
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(asked: bool) -> None:
    if asked:
        print(f"eitskin {__version__}")
        raise typer.Exit()


@app.callback()
def _of_all_commands(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """A tactile skin: start it, watch it, press it, record it, reconstruct from files."""


for group in (service, watch, board, recordings, info, golden, export, calibrate, bridge, collect, new_skin, offline):
    group.register(app)
dev.register(app)


def _with_values(of: typer.Typer) -> None:
    """Every command of the app, and of the groups in it, refuses values that are none."""
    for command in of.registered_commands:
        assert command.callback is not None
        command.callback = with_values(command.callback)
    for inner in of.registered_groups:
        if inner.typer_instance is not None:
            _with_values(inner.typer_instance)


_with_values(app)


def run() -> int:
    """Runs the command line of this process and returns its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file's name need not be text, nor a terminal UTF-8
    try:
        for lacking in room.memory():
            raise room.NoRoom(lacking)
        app()
    except SystemExit as end:
        return FAILED if isinstance(end.code, str) else end.code or 0
    except BrokenPipeError:  # `skin echo contact | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (Exception, KeyboardInterrupt) as error:
        if os.environ.get("EITSKIN_DEBUG") and not interrupted(error):
            raise
        code, lines = _explained(error)
        sys.stderr.writelines(f"skin: {line}\n" for line in lines)
        return code
    return 0


def _explained(error: BaseException) -> tuple[int, list[str]]:
    """The exit code of an error, and its lines for a person."""
    if interrupted(error):
        return 130, []
    if lacking := room.sentence(error):
        return FAILED, [lacking]
    if isinstance(error, OSError) and error.filename:
        return USAGE, [f"{error.filename}: {error.strerror or error}: name another file or folder"]
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        return FAILED, [f"{error.strerror} where the output goes: send it to another file"]
    code, lines = expected_code(error), str(error).splitlines()
    if code is not None:
        return code, lines
    hint = "a fault of this program: set EITSKIN_DEBUG=1 to see where, and report it"
    return FAILED, [f"{type(error).__name__}: {(lines or [''])[0]} ({hint})"]
