"""What averaging brings while a touch is held still: its error against the time since it began.

One touch under one noise says little: its first frames may be lucky. So the same touch is met again and again, each
time with a tare of its own, and the root mean square is taken over these. The floor is what no estimator can beat from
as many frames as are averaged, with that tare.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.tracking.scene import Recorded
from models import fisher
from models.bundle import Bundle
from models.pressure import FOAM, disc
from models.shapes import Shape
from services.estimation.images.averaging import MEANS
from services.pipeline import Pipeline
from services.recordings.file_source import FILE_RATE_HZ, file_frame
from services.runtime.config import Skin, TareConfig, TouchConfig

SNR_DB = 70.0
TIMES = 16  # that the touch is met
QUIET, HELD = 100, 200  # frames before it, and of it
EDGES = (0, 1, 4, 10, 22, 44, 110, HELD)  # frames since it began


def averaging(recorded: Recorded, bundle: Bundle, seed: int = 1) -> dict[str, dict[str, float]]:
    """Frames since the touch began -> rms position error [mm] with averaging and without, of the scene's one touch;
    their floors; how many frames did not see it.
    """
    touched = recorded.touches[:, 0].astype(int)
    first, last = int(touched.min()), int(touched.max())
    free = recorded.z[: first - 1].mean(axis=0)
    pressed = recorded.z[first + 2 : last - 1].mean(axis=0)  # the scans that the touch was there for all along
    _, _, x, y, newtons, radius, _ = recorded.touches[0]
    metres = bundle.metres_per_unit
    shape = Shape("circle", x / metres, y / metres, radius / metres, FOAM.flat_drop(newtons, disc(radius)))
    found: dict[str, dict[str, float]] = {}
    for name, hold in (("averaged", True), ("each alone", False)):
        rng = np.random.default_rng(seed)  # the same noise for both
        errors = np.array([_errors(free, pressed, np.array([x, y]), hold, rng, bundle) for _ in range(TIMES)])
        for a, b in zip(EDGES, EDGES[1:], strict=False):
            row = found.setdefault(str(a), {})
            row[name] = 1e3 * float(np.sqrt(np.nanmean(np.square(errors[:, a:b]))))
            row[f"{name}, floor"] = 1e3 * metres * _floor(shape, max(n for n in MEANS if n <= a + 1) if hold else 1)
            row[f"{name}, frames not seen"] = float(np.isnan(errors[:, a:b]).sum())
    return found


def _floor(shape: Shape, averaged: int) -> float:
    """Floor of the position error, model units."""
    noise = fisher.MeasurementNoise(SNR_DB + 10 * np.log10(averaged), tare_frames=TareConfig().frames / averaged)
    return float(fisher.floors("square16", shape, noise, fisher.SizePrior())["bayes"].position)


def _errors(
    free: NDArray[np.complexfloating],
    pressed: NDArray[np.complexfloating],
    place: NDArray[np.floating],
    hold: bool,
    rng: np.random.Generator,
    bundle: Bundle,
) -> NDArray[np.float64]:
    """(HELD,) distances [m] of what is found from `place`; NaN where nothing is."""
    pipeline = Pipeline(Skin(port="stub", bundle="square16", touch=TouchConfig(hold=hold)), bundle=bundle)
    errors = np.full(HELD, np.nan)
    for k in range(QUIET + HELD):
        noise = 10 ** (-SNR_DB / 20) * rng.standard_normal(len(free))
        z = (free if k < QUIET else pressed) * (1 + noise)
        frame = file_frame("skin", "", k, z, "full", round(k / FILE_RATE_HZ * 1e9))
        contacts = pipeline.run(frame).contact.contacts
        if k >= QUIET and contacts:
            errors[k - QUIET] = np.hypot(*(np.array(contacts[0].position[:2]) - place))
    return errors
