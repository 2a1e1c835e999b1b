"""What a bundle's manifest says, apart from the hashes: geometry, image, method and where it all came from."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from models.bundle import Bundle
from models.geometry import SkinGeometry
from models.linearise import NOSER_POWER
from models.prereconstruction import ONE_STEP_LAMBDA, THRESHOLD_T, Matrices

IMAGE = 96
ROOT = Path(__file__).parents[1]


def describe(name: str, skin: SkinGeometry, matrices: Matrices, **more: Any) -> dict[str, Any]:
    """A manifest of a bundle without a network; `more` (network, training, measured) is added as given."""
    h, w = matrices.inside.shape
    return {
        "name": name,
        "skin": skin.to_dict(),
        "pattern": skin.pattern_name,
        "image": {
            "n": IMAGE,
            "stack": [len(matrices.ladder), h, w],
            "half_width": 1.0,
            "metres_per_unit": skin.metres_per_unit,
            "quantity": "conductivity drop, S/m of a background of 1 S/m; [iy, ix], row 0 at the lowest y",
        },
        "normalisation": matrices.normalisation,
        "prior": {
            "noser_power": NOSER_POWER,
            "ladder": [float(v) for v in matrices.ladder],
            "model_error": matrices.model_error,
        },
        "one_step": {"lambda": ONE_STEP_LAMBDA, "t": THRESHOLD_T},
        "built": built(),
        "network": None,
        **more,
    }


def of_registered(registered: Bundle, **more: Any) -> dict[str, Any]:
    """That of a registered bundle with the networks that were trained for it; `more` is added as given."""
    kept = {key: value for key, value in registered.manifest.items() if key not in ("files", "schema")}
    return {**kept, "trained": {**built(), "from": registered.hash}, **more}


def built() -> dict[str, Any]:
    """When, of which commit and with which packages."""
    return {"utc": datetime.now(UTC).isoformat(timespec="seconds"), "commit": commit(), "versions": versions()}


def commit() -> str:
    """The checkout's commit, "-dirty" where models/ differs from it; "unknown" outside git."""
    try:
        head = _git("rev-parse", "--short=12", "HEAD")
        return head + ("-dirty" if _git("status", "--porcelain", "-uno", "--", "models/*.py") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*args: str) -> str:
    return subprocess.run(["git", *args], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("numpy", "scikit-fem", "torch", "onnx", "onnxruntime"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            pass
    return found
