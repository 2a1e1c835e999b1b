"""What a calibration found of the skin as it is mounted, for `skin doctor`: a picture and what looks wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.cli.doctor_live import Finding

Array = NDArray[np.float64]

SHADES = " .:-=+*#%@"  # from the least to the best conducting
WIDTH = 48  # columns of the picture
MARK = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"  # electrodes by number


def mounting_found(name: str, said: dict[str, Any], info: dict[str, Any]) -> Finding:
    """What `skin tare` found of the skin, as info/<skin> says it."""
    what = f"{name}: mounting"
    try:
        outline = np.asarray(info["geometry"]["outline"], float)
        remarks = [str(remark) for remark in said.get("remarks", [])]
        lines = [*sentences(said), *(f"looks wrong: {remark}" for remark in remarks)]
        drawn = picture(said, info["geometry"]["electrodes"], float(np.abs(outline).max()))
    except (KeyError, TypeError, ValueError) as why:
        return Finding("WARN", what, f"calibrated, but info/{name} does not say how ({why!r}): run `skin tare` again")
    return Finding("WARN" if remarks else "OK", what, "\n".join(["calibrated by `skin tare`:", *lines, drawn]))


def sentences(said: dict[str, Any]) -> list[str]:
    """What was found, a sentence each; what looks wrong is in `said["remarks"]`."""
    contact, shift = np.asarray(said["contact_times"], float), np.asarray(said["shift_m"], float)
    e, far = int(np.abs(np.log(contact)).argmax()), int(np.abs(shift).argmax())
    angle = np.degrees(float(said["anisotropy_rad"])) % 180
    return [
        f"contact impedances {contact.min():.2g} to {contact.max():.2g} times the file's, electrode {e} furthest off",
        f"electrodes {1e3 * np.sqrt(np.mean(shift**2)):.1f} mm off their places (rms), electrode {far} "
        f"{1e3 * shift[far]:+.1f} mm along the outline",
        f"the sheet's conductivity varies by {100 * float(said['field_rms']):.1f} % (rms)",
        f"it conducts {100 * float(said['anisotropy']):.1f} % better along {angle:.0f} degrees, as much worse across",
        f"the untouched impedances are explained to {100 * float(said['misfit']):.2f} % "
        f"(by the file: {100 * float(said['misfit_before']):.1f} %)",
    ]


def picture(said: dict[str, Any], electrodes: Sequence[Sequence[float]], half_width_m: float) -> str:
    """The field as shades, y upwards, with each electrode's number where it sits; electrodes (E, 2) metres."""
    field = np.asarray(said["field"], float)
    n = len(field)
    rows = max(1, WIDTH // 2)
    inside = field > 0
    low, high = (float(f(field[inside])) if inside.any() else 1.0 for f in (np.min, np.max))
    spread = max(high - low, 0.02)  # an even sheet is one shade, not noise
    middle = 0.5 * (low + high)
    lines = []
    for r in range(rows):
        iy = min(n - 1, int((rows - 1 - r + 0.5) * n / rows))
        line = []
        for c in range(WIDTH):
            value = field[iy, min(n - 1, int((c + 0.5) * n / WIDTH))]
            share = 0.5 + (value - middle) / spread
            line.append(SHADES[int(np.clip(share * len(SHADES), 0, len(SHADES) - 1))] if value > 0 else " ")
        lines.append(line)
    for e, (x, y) in enumerate(electrodes):
        c = int(np.clip((x / half_width_m + 1) * WIDTH / 2, 0, WIDTH - 1))
        r = int(np.clip((1 - y / half_width_m) * rows / 2, 0, rows - 1))
        lines[r][c] = MARK[e % len(MARK)]
    text = "\n".join("".join(line).rstrip() for line in lines)
    return f"{text}\nconductivity over the file's, from '{SHADES[0]}' {low:.2f} to '{SHADES[-1]}' {high:.2f}"
