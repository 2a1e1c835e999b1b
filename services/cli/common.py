"""What every command shares: errors of one line, exit codes, the skin meant, calls to a running service."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import math
import os
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from protocol.errors import INCOMPLETE, EitskinError

if TYPE_CHECKING:
    from services.recordings.damage import Damage

ROOT = Path(__file__).resolve().parents[2]
FAILED, USAGE, NOT_RUNNING = 1, 2, 3
"""Exit codes: it did not work, the request itself is wrong, no service answers."""

LONGEST_S = 86400.0
"""For which a command waits or works, at most."""

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", readable=False, help="Configuration; default: the running service's, else skin.toml."),
]
RuntimeOption = Annotated[
    Path | None, typer.Option("--runtime", help="Runtime folder of the service; default: as docs/clients.md says.")
]
SkinOption = Annotated[str, typer.Option("--skin", help="Which skin; default: the first of skin.toml.", metavar="NAME")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


class CliError(EitskinError):
    """Ends a command: one line of text, what was found, what was expected, what to do; and the exit code."""

    def __init__(self, message: str, code: int = FAILED) -> None:
        super().__init__(message)
        self.code = code


def fail(message: str, code: int = FAILED) -> NoReturn:
    raise CliError(message, code)


def with_values(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command, which refuses what no range of typer's keeps out: infinite numbers, and text that is none."""
    signature = inspect.signature(command, eval_str=True)

    @functools.wraps(command)
    def wrapped(*args: Any, **given: Any) -> Any:
        for name, value in given.items():
            for one in value if isinstance(value, list) else [value]:
                _refuse(one, signature.parameters[name])
        return command(*args, **given)

    return wrapped


def _refuse(value: Any, parameter: inspect.Parameter) -> None:
    if expected := _not(value):
        found = f"{value:g}" if isinstance(value, float) else repr(value)
        fail(f"{_spelled(parameter)}: found {found}, expected {expected}", USAGE)


def _not(value: Any) -> str:
    """What a value should be and is not; "" where it is."""
    if isinstance(value, float) and not math.isfinite(value):
        return "a finite number"
    try:
        if isinstance(value, str):
            value.encode()
    except UnicodeEncodeError:
        return "text in UTF-8"
    return ""


def _spelled(parameter: inspect.Parameter) -> str:
    """An option as it is typed, an argument by its name."""
    for option in getattr(parameter.annotation, "__metadata__", ()):
        for spelling in (getattr(option, "default", None), *(getattr(option, "param_decls", None) or ())):
            if isinstance(spelling, str) and spelling.startswith("--"):
                return spelling
    return "--" + parameter.name.replace("_", "-")


def of_service(command: Callable[..., Any], starts: bool = False) -> Callable[..., Any]:
    """The command with --config and --runtime: which service it talks to. `starts`: the folder may be a new one."""

    @functools.wraps(command)
    def wrapped(*args: Any, config: Path | None = None, runtime: Path | None = None, **more: Any) -> Any:
        if runtime is not None:
            if not starts and not runtime.is_dir():
                fail(f"no folder {runtime}: no service runs there; `skin up` says which folder it uses", USAGE)
            os.environ["EITSKIN_RUNTIME"] = str(runtime.absolute())
        if config is not None:
            if not config.is_file():
                fail(f"no file {config}: expected a configuration such as {ROOT / 'skin.toml'}", USAGE)
            os.environ["EITSKIN_CONFIG"] = str(config.resolve())
        return command(*args, **more)

    signature = inspect.signature(command, eval_str=True)
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        for name, annotation in (("config", ConfigOption), ("runtime", RuntimeOption))
    ]
    found = signature.replace(parameters=[*signature.parameters.values(), *added])
    wrapped.__signature__ = found  # type: ignore[attr-defined]
    wrapped.__annotations__ = {name: parameter.annotation for name, parameter in found.parameters.items()}
    return wrapped


def nobody(skin: str, seconds: float, topic: str = "") -> str:
    """The text for a service that was listened to and sent nothing."""
    from protocol.runtime import runtime_dir

    folder = runtime_dir()
    what = f"{topic}/{skin}" if topic else f"skin {skin!r}"
    found = f"no frame of {what} came within {seconds:g} s at {folder}"
    if not (folder / "publisher.ctl").exists():
        return f"{found}: start the service with `skin up`, or name its folder with --runtime"
    skins = ", ".join(_configuration().get("skins", {}))
    return f"{found}: `skin doctor` says why (skins of {config_file()}: {skins})"


def check_whole(file: Path, damage: Damage) -> None:
    """Ends a command that has done its work with a file, with an exit code of its own, where the file is not whole."""
    if not damage.whole:
        fail(f"{file}: {damage}", INCOMPLETE)


EXPECTED = {
    ("protocol.runtime", "RuntimeDirError"): USAGE,
    ("protocol.runtime", "AlreadyRunning"): FAILED,
    ("protocol.frames", "FrameError"): FAILED,
    ("protocol.sockets", "ControlError"): FAILED,
    ("services.runtime.config", "ConfigError"): USAGE,
    ("services.runtime.room", "NoRoom"): FAILED,
    ("services.rows.order", "InputError"): USAGE,
    ("services.recordings.recording", "RecordingError"): USAGE,
    ("services.recordings.replay", "ReplayError"): FAILED,
    ("services.recordings.importing", "ImportRefused"): USAGE,
    ("services.calibration.presses", "RegistrationError"): USAGE,
    ("services.calibration.force_fit", "CalibrationError"): USAGE,
    ("protocol.transport", "TransportError"): FAILED,
    ("models.bundle", "BundleError"): USAGE,
    ("services.bridge", "MissingExtra"): USAGE,
}
"""Exceptions of other modules whose text is already meant for the person at the terminal, and the exit code of each."""


def expected_code(error: BaseException) -> int | None:
    """The exit code of an error whose text explains itself; None for other errors. This imports nothing."""
    if isinstance(error, CliError):
        return error.code
    for (module, name), code in EXPECTED.items():
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return code
    return None


def running_config() -> Path | None:
    """The configuration of the service that runs in the runtime folder (`skin up` leaves a link to it there)."""
    from protocol.runtime import CONFIG_LINK, RuntimeDirError, runtime_dir

    with contextlib.suppress(RuntimeDirError, OSError):
        link = runtime_dir(create=False) / CONFIG_LINK
        if link.is_symlink() and link.is_file():
            return Path(os.readlink(link))
    return None


def config_file() -> Path:
    """The configuration meant: $EITSKIN_CONFIG (--config sets it), else the running service's, else the checkout's."""
    return Path(os.environ.get("EITSKIN_CONFIG") or running_config() or ROOT / "skin.toml")


def _configuration() -> dict[str, Any]:
    """The configuration as it stands, unchecked; CliError where there is none that can be read."""
    from models.files import FileError, read_text

    file = config_file()
    try:
        found = tomllib.loads(read_text(file))
    except FileError as why:
        fail(f"{why}; name the configuration with --config", USAGE)
    except (ValueError, RecursionError) as why:
        fail(f"{file}: is not TOML: {why}", USAGE)
    return found if isinstance(found.get("skins", {}), dict) else {}


def skin_name(given: str) -> str:
    """The skin meant: the one given, else the first that the configuration names. CliError where the service that runs
    has no such skin.
    """
    if given and running_config() != config_file():
        return given  # a service elsewhere, or in containers: it knows
    skins = _configuration().get("skins", {})
    if given and given not in skins:
        fail(f"no skin {given!r}: {config_file()} has {', '.join(skins)}", USAGE)
    return given or next(iter(skins), "palm")


def use_configured_sockets() -> None:
    """Use the addresses that the configuration gives; without any, the sockets in the runtime folder."""
    if _configuration().get("sockets"):
        from protocol import transport
        from services.runtime.config import load

        transport.configure(load(config_file()).transport())


def emit(value: Any) -> None:
    """One line of JSON; NaN and infinity become null."""
    print(json.dumps(_plain(value), allow_nan=False, separators=(", ", ": ")), flush=True)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, complex):
        return [_plain(value.real), _plain(value.imag)]
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value


STARTED_BY = {
    "stub": 'a skin with port = "stub" in its configuration has one',
    "recorder": "`[recorder]` in skin.toml has `skin up` start one",
}


def control(process: str, command: str, *, timeout_s: float = 2.0, **args: Any) -> dict[str, Any]:
    """Give one command over a process's control socket. CliError where nobody answers or the answer is a refusal."""
    from protocol import transport
    from protocol.sockets import ControlClient, ControlError

    use_configured_sockets()
    who = "the stub board" if process == "stub" else process
    address = transport.current().control_address(process)
    if address.startswith("ipc://") and not os.path.exists(address.removeprefix("ipc://")):
        what = STARTED_BY.get(process, "start it: `skin up`")
        found = f"{who} does not run here (no {address})"
        if os.path.exists(transport.current().control_address("publisher").removeprefix("ipc://")):
            fail(f"{found}: {what}", NOT_RUNNING)
        fail(f"{found}: start the service with `skin up`, or name its folder with --runtime", NOT_RUNNING)
    try:
        answer: dict[str, Any] = ControlClient(process, timeout_s).call(command, **args)
        return answer
    except ControlError as error:
        raise CliError(str(error), NOT_RUNNING if error.kind in ("unreachable", "timeout") else FAILED) from None
