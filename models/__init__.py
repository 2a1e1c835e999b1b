"""Offline: geometry, forward model, data, networks, bundles."""

import os
import sys
from types import TracebackType

from protocol.errors import interrupted

OURS = ("bench", "examples", "firmware_stub", "models", "protocol", "services", "tests")


def not_installed(error: ImportError) -> str:
    """What to do about a package that offline work needs and the service does not; "" for any other import error."""
    package = (error.name or "").split(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package in ("", *OURS):
        return ""
    return f"this needs the Python package {package!r}, which only `make venv-dev` installs: run that first"


def _last_words(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """No traceback for Ctrl-C, nor for a program that lacks what it needs."""
    if isinstance(error, ImportError) and (said := not_installed(error)):
        print(said, file=sys.stderr)
    elif not interrupted(error):
        _usual(kind, error, trace)
    elif kind is not KeyboardInterrupt:  # of which Python knows by itself how to end
        os._exit(130)


_usual = sys.excepthook
sys.excepthook = _last_words
