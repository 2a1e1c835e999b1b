"""Offline: geometry, forward model, data, networks, bundles."""

import os
import sys
from types import TracebackType

from protocol.errors import interrupted

OURS = ("bench", "examples", "firmware_stub", "models", "protocol", "services", "tests")

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when onnxruntime is loaded

EXTRAS = {
    "offline": ("ezdxf", "svgpathtools"),
    "plots": ("matplotlib", "PIL"),
    "peers": ("pyeit", "zenoh", "dask", "distributed"),
    "train": ("torch", "onnx", "joblib"),
}
"""Which extra of pyproject.toml brings a package that offline work needs and the service does not, by import name."""


def not_installed(error: ImportError) -> str:
    """What to do about a package that offline work needs and the service does not; "" for any other import error."""
    package = (error.name or "").split(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package in ("", *OURS):
        return ""
    extra = next((f" EXTRAS={extra}" for extra, found in EXTRAS.items() if package in found), "")
    return f"this needs the Python package {package!r}, which is not installed: run `make venv{extra}` first"


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
