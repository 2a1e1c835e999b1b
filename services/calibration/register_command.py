"""`skin register`: turns a file of presses at known places into a bundle of that skin and its pose."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.whole_file import write_whole
from services.calibration.locating import build
from services.calibration.presses import Presses, RegistrationError, part, read_presses
from services.calibration.registration import FEWEST, KnownPose, Registration, Similarity, register
from services.calibration.sensitivity import write_corrected
from services.recordings.reconstruction import find_skin


def register_presses(
    arrays: Mapping[str, NDArray[Any]], skin: str, count: int | None, out: Path, known: KnownPose | None = None
) -> dict[str, Any]:
    """Fits the first `count` presses (None: all), writes the bundle folder `out` and a skin.toml in it; returns the
    report.

    Raises RegistrationError, BundleError.
    """
    bundle = find_skin(skin)[1]
    if count is not None:
        held = len(arrays["xy"]) if "xy" in arrays and arrays["xy"].ndim else 0
        if not FEWEST <= count <= held:
            raise RegistrationError(f"--presses {count}: the file holds {held}, at least {FEWEST} are needed")
        arrays = part(arrays, slice(0, count))
    presses = read_presses(arrays, bundle)
    found = register(presses, bundle, known)
    locator, response, crossed = build(presses, found.similarity, bundle)
    report = summary(presses, found, len(bundle.pattern))
    report |= {"left_out": crossed.report(presses.quantity)}
    report |= {"correlation_length_m": response.assumed.length_m}
    made = write_corrected(out, presses, response, locator, report)
    write_whole(out / "skin.toml", configuration(made, found.similarity))
    return {**report, "bundle": str(out)}


def summary(presses: Presses, found: Registration, measurements: int) -> dict[str, Any]:
    """What is known of the presses and the pose."""
    similarity = found.similarity
    return {
        "understood": presses.understood,
        "presses": len(presses),
        "unusable_presses": presses.left_out,
        "unusable_measurements": measurements - int(presses.measured.sum()),
        "from_delta": presses.from_delta,
        "delta_unit": presses.unit,
        "typical_difference": float(np.sqrt(np.median((presses.difference**2).mean(axis=1)))),
        "angle_degrees": float(np.degrees(similarity.angle)),
        "angle_sigma_degrees": float(np.degrees(found.sigma["angle"])),
        "scale": similarity.scale,
        "scale_sigma": found.sigma["scale"] * similarity.scale,
        "offset_m": similarity.offset.tolist(),
        "offset_sigma_m": found.sigma["offset"],
        "mirrored": similarity.mirrored,
        "explained_variance": found.explained,
        "doubts": found.doubts,
    }


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
