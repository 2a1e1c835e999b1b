"""The fit of models/calibration.py as a program of its own, which the service runs beside itself, niced.

    python -m models.fit_calibration BUNDLE REQUEST.npz OUT

REQUEST.npz holds z0 and sigma (K,), |Z| of the untouched skin and its standard deviation, and baseline_hash; OUT gets
what models/calibration_file.py reads. Exit 1 and one line on stderr where no calibration can be made.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import geometry
from models.bundle import Bundle
from models.calibration import CalibrationFit, TooFewMeasured, calibrated, fields_as_mounted, fit
from models.calibration_file import pack
from models.geometry import SkinGeometry
from models.mounted import FieldModes
from models.npz import read_npz
from protocol.errors import EitskinError
from protocol.whole_file import write_whole

Array = NDArray[np.float64]

NICE = 5  # after the service's own processes, yet done in seconds on a busy machine
PICTURE = 24  # pixels a side of the field that a person is shown
# From where the mounting is worth a word, and then only if it is found to this many standard deviations.
SURE = 2.0
WORTH_CONTACT = 3.0  # times, or its inverse
WORTH_SHIFT = 0.01  # of the skin's longer side
WORTH_FIELD = 0.08  # rms, relative
WORTH_ANISOTROPY = 0.10  # better one way than the file says, and as much worse across
WORTH_MISFIT = 2e-3  # rms of |Z0|, relative: what nothing here explains


def calibrate(bundle: Bundle, z0: Array, sigma: Array, baseline_hash: str = "") -> bytes:
    """A packed calibration of this bundle. Raises TooFewMeasured."""
    if bundle.matrices.normalisation != "model":
        raise TooFewMeasured(
            f"the bundle {bundle.name} divides by its own baseline and predicts no impedances: there is nothing to "
            "calibrate it against; calibration needs a bundle of the drive pattern `pairs`"
        )
    try:
        skin = geometry.from_dict(bundle.skin)
    except EitskinError as why:
        raise TooFewMeasured(f"the bundle {bundle.name} has no geometry to calibrate ({why})") from None
    found = fit(skin, bundle.matrices, z0, sigma)
    matrices = calibrated(bundle.matrices, skin, found.mounting)
    report = {"bundle_hash": bundle.hash, "baseline_hash": baseline_hash, **describe(skin, found)}
    return pack(matrices, found.mounting.skin(skin).to_dict(), report, fields_as_mounted(skin, found.mounting))


def describe(skin: SkinGeometry, found: CalibrationFit) -> dict[str, Any]:
    """What was found, in units a person reads, as the manifest of a calibrated bundle has it."""
    mounting, sd = found.mounting, found.sd
    axis = -1 + 2 * (np.arange(PICTURE) + 0.5) / PICTURE
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside = skin.inside(points)
    field = np.exp(FieldModes(skin)(points) @ mounting.field)
    size = float(np.hypot(*mounting.anisotropy))
    report = {
        "contact_times": np.exp(mounting.contact).round(4).tolist(),
        "contact_sd": sd.contact.round(4).tolist(),
        "shift_m": (mounting.shift * skin.metres_per_unit).round(7).tolist(),
        "shift_sd_m": (sd.shift * skin.metres_per_unit).round(7).tolist(),
        "field_rms": round(float(np.std(field[inside])), 5),
        "field": np.where(inside, field.round(4), 0.0).reshape(PICTURE, PICTURE).tolist(),
        "anisotropy": round(float(np.expm1(size)), 5),
        "anisotropy_sd": round(float(sd.anisotropy.max()), 5),
        "anisotropy_rad": round(float(0.5 * np.arctan2(mounting.anisotropy[1], mounting.anisotropy[0])), 4),
        "misfit_before": found.before,
        "misfit": found.after,
    }
    return {**report, "remarks": remarks(skin, report)}


def remarks(skin: SkinGeometry, report: dict[str, Any]) -> list[str]:
    """What looks wrong with the mounting, one sentence each."""
    found = []
    side = float(np.ptp(skin.polygon(), axis=0).max()) * skin.metres_per_unit
    for e, (times, sd) in enumerate(zip(report["contact_times"], report["contact_sd"], strict=True)):
        if abs(np.log(times)) > max(np.log(WORTH_CONTACT), SURE * sd):
            todo = "press it on, clean or moisten it" if times > 1 else "look for moisture or a short beside it"
            found.append(f"electrode {e}: contact impedance {times:.2g} times the file's: {todo}")
    for e, (shift, sd) in enumerate(zip(report["shift_m"], report["shift_sd_m"], strict=True)):
        if abs(shift) > max(WORTH_SHIFT * side, SURE * sd):
            way = "further along" if shift > 0 else "back along"
            found.append(f"electrode {e}: {1e3 * abs(shift):.1f} mm {way} the outline than the file says")
    if report["field_rms"] > WORTH_FIELD:
        found.append(
            f"the sheet conducts unevenly ({100 * report['field_rms']:.0f} % rms): thickness, moisture or wear"
        )
    if report["anisotropy"] > max(WORTH_ANISOTROPY, SURE * report["anisotropy_sd"]):
        angle = np.degrees(report["anisotropy_rad"]) % 180
        found.append(
            f"the sheet conducts {100 * report['anisotropy']:.0f} % better along {angle:.0f} degrees, as much worse "
            "across: stretched when it was mounted?"
        )
    if report["misfit"] > WORTH_MISFIT:
        found.append(
            f"{100 * report['misfit']:.1f} % of the untouched impedances stay unexplained: shifts of several percent, "
            "exchanged wires, damage, or something touched the skin"
        )
    return found


def main(argv: list[str] | None = None) -> int:
    name, request, out = sys.argv[1:] if argv is None else argv
    _be_nice()
    try:
        arrays = read_npz(request)
        packed = calibrate(Bundle.load(name), arrays["z0"], arrays["sigma"], str(arrays["baseline_hash"]))
    except (EitskinError, KeyError, ValueError) as why:
        print(why, file=sys.stderr)
        return 1
    write_whole(Path(out), packed)
    return 0


def _be_nice() -> None:
    """Whoever started this may have a real-time priority and processors of its own: both are handed down, neither is
    meant for a fit.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    os.nice(NICE)


if __name__ == "__main__":
    raise SystemExit(main())
