"""What every command shares: errors of one line, exit codes, the skin meant, calls to a running service."""

from __future__ import annotations

import json
import os
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

ROOT = Path(__file__).resolve().parents[2]
FAILED, USAGE, NOT_RUNNING = 1, 2, 3
"""Exit codes: it did not work, the request itself is wrong, no service answers."""

SkinOption = Annotated[str, typer.Option("--skin", help="Which skin; default: the first of skin.toml.", metavar="NAME")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


class CliError(Exception):
    """Ends a command: one line of text, what was found, what was expected, what to do; and the exit code."""

    def __init__(self, message: str, code: int = FAILED) -> None:
        super().__init__(message)
        self.code = code


def fail(message: str, code: int = FAILED) -> NoReturn:
    raise CliError(message, code)


def nobody(skin: str, seconds: float) -> str:
    """What to say where a service was listened to and nothing came."""
    from protocol.runtime import runtime_dir

    found = f"no frame of skin {skin!r} came within {seconds:g} s at {runtime_dir()}"
    return f"{found}: start the service with `skin up`, or set EITSKIN_RUNTIME"


EXPECTED = {
    ("protocol.runtime", "RuntimeDirError"): USAGE,
    ("protocol.runtime", "AlreadyRunning"): FAILED,
    ("protocol.frames", "FrameError"): FAILED,
    ("protocol.sockets", "ControlError"): FAILED,
    ("services.config", "ConfigError"): USAGE,
    ("services.recordings.recording", "RecordingError"): USAGE,
    ("services.recordings.replay", "ReplayError"): FAILED,
    ("services.recordings.importing", "ImportRefused"): USAGE,
    ("services.calibrating.registration", "RegistrationError"): USAGE,
    ("services.calibrating.calibration_fit", "CalibrationError"): USAGE,
    ("protocol.transport", "TransportError"): FAILED,
    ("models.bundle", "BundleError"): USAGE,
}
"""Exceptions of other modules whose text is already meant for the person at the terminal, and the exit code of each."""


def expected_code(error: BaseException) -> int | None:
    """The exit code of an error whose text explains itself; None for any other. Imports nothing."""
    if isinstance(error, CliError):
        return error.code
    for (module, name), code in EXPECTED.items():
        kind = getattr(sys.modules.get(module), name, None)
        if kind is not None and isinstance(error, kind):
            return code
    return None


def config_file() -> Path:
    """The same file as services.config.config_path, without importing it."""
    return Path(os.environ.get("EITSKIN_CONFIG") or ROOT / "skin.toml")


def _configuration() -> dict[str, Any]:
    """The configuration as it stands, unchecked; empty where there is none."""
    from models.files import FileError, read_text

    try:
        found = tomllib.loads(read_text(config_file()))
        return found if isinstance(found.get("skins", {}), dict) else {}
    except (FileError, ValueError, RecursionError):
        return {}


def skin_name(given: str) -> str:
    """The skin meant: the one given, else the first that the configuration names."""
    return given or next(iter(_configuration().get("skins", {})), "palm")


def use_configured_sockets() -> None:
    """Our sockets where the configuration puts them; without a word on them, in the runtime folder."""
    if _configuration().get("sockets"):
        from protocol import transport
        from services.config import load

        transport.configure(load().transport())


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


def control(process: str, command: str, *, timeout_s: float = 2.0, **args: Any) -> dict[str, Any]:
    """One command over a process's control socket. CliError where nobody answers or the answer is a refusal."""
    from protocol import transport
    from protocol.sockets import ControlClient, ControlError

    use_configured_sockets()
    who = "the stub board" if process == "stub" else process
    address = transport.current().control_address(process)
    if address.startswith("ipc://") and not os.path.exists(address.removeprefix("ipc://")):
        fail(f"{who} does not run here (no {address}): start it with `skin up`, or set EITSKIN_RUNTIME", NOT_RUNNING)
    try:
        answer: dict[str, Any] = ControlClient(process, timeout_s).call(command, **args)
        return answer
    except ControlError as error:
        raise CliError(str(error), NOT_RUNNING if error.kind in ("unreachable", "timeout") else FAILED) from None


def load_npz(path: Path) -> dict[str, Any]:
    """All arrays of an npz file. CliError where it is none, or holds pickled objects."""
    from services.recordings import npz_file

    try:
        return npz_file.load_npz(path)
    except npz_file.InputError as error:
        fail(str(error), USAGE)
