"""`skin register`: turns a file of presses at known places into a bundle of that skin and its pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.calibration.registration import FEWEST, RegistrationError, Similarity, part, read_presses, register
from services.calibration.sensitivity import out_of_fold, write_corrected
from services.recordings.reconstruction import find_skin


def register_presses(arrays: Mapping[str, NDArray[Any]], skin: str, count: int, out: Path) -> dict[str, Any]:
    """Fits the first `count` presses, writes the bundle folder `out` and a skin.toml in it; returns the report.

    Raises RegistrationError, BundleError.
    """
    bundle = find_skin(skin)[1]
    presses = read_presses(arrays, bundle)
    if not FEWEST <= count <= len(presses):
        raise RegistrationError(f"--presses {count}: the file holds {len(presses)}, at least {FEWEST} are needed")
    presses = read_presses(part(arrays, slice(0, count)), bundle)
    similarity, explained = register(presses, bundle)
    residual = out_of_fold(presses, similarity, bundle)
    report = {
        "presses": count,
        "angle_degrees": float(np.degrees(similarity.angle)),
        "scale": similarity.scale,
        "offset_m": similarity.offset.tolist(),
        "mirrored": similarity.mirrored,
        "explained_variance": explained,
        "residual_m": {"median": float(np.median(residual)), "mean": float(residual.mean())},
    }
    made = write_corrected(out, presses, similarity, bundle, report)
    (out / "skin.toml").write_text(configuration(made, similarity), encoding="utf-8")
    return {**report, "bundle": str(out)}


def configuration(bundle: Bundle, similarity: Similarity) -> str:
    """A skin.toml with the skin's pose in the machine's frame: the bundle is in true metres, so the pose is rigid."""
    half = 0.5 * similarity.angle
    # Mirrored: the machine sees the skin from behind, that is, turned by half a turn about its x axis first.
    turn = [np.cos(half), np.sin(half), 0.0, 0.0] if similarity.mirrored else [0.0, 0.0, np.sin(half), np.cos(half)]
    quaternion = ", ".join(f"{value:.6f}" for value in turn)
    x, y = similarity.offset
    return (
        f"[skins.{bundle.name}]\n"
        'port = "stub"                  # put the board\'s port or a recording here\n'
        f'bundle = "{bundle.path.resolve()}"\n'
        f'pose = {{ parent = "machine", position_m = [{x:.6f}, {y:.6f}, 0.0], quaternion_xyzw = [{quaternion}] }}\n'
    )
