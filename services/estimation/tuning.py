"""The numbers that the hypotheses share, each with its unit, its meaning and where it comes from.

What one check alone uses (how many frames in a row, how far off a line) stands at the top of that check's file.

`origin` is "sheet": data of the board or the foam; "prior": what is expected of touches; "measured": found on frames; a
program in bench/: it chose the number, on the scenes it names. Lengths are model units (half a side of the square
skin); d is the relative difference of |Z|. A test keeps the numbers at 30 at most.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def _number(value: Any, unit: str, meaning: str, origin: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "origin": origin})


DRIFT_ROWS = "bench/reliability/estimation.py drift"
CONTACT_SCENES = "tests/services/test_contact_evidence.py"
START_ROWS = "bench/reliability/estimation.py start"


@dataclass(frozen=True)
class Tuning:
    # drift (drift.py)
    scale_sd: float = _number(0.05, "relative", "stationary sd of the sheet's conductivity", "sheet: dries by 5 %")
    contact_sd: float = _number(0.2, "relative", "stationary sd of a contact impedance", "sheet: contacts age by 20 %")
    drift_s: float = _number(250.0, "s", "time constant of both", "sheet: 2e-4/s, 8e-4/s, as [tare] in skin.toml")
    creep_sd: float = _number(0.05, "of the touch", "stationary sd of what a touch leaves behind", "sheet: foam's set")
    creep_s: float = _number(60.0, "s", "time constant of it", "sheet: recovered within two minutes")

    # errors of the model (physics.py)
    absolute: float = _number(3e-5, "relative", "what no model of |Z| gets right", "measured: meshes that differ")
    misfit: float = _number(0.06, "of the touch's |d|", "what linear discs get wrong of a touch", DRIFT_ROWS)
    misfit_power: float = _number(
        0.8, "", "power of the Gram matrix's eigenvalues in it", "measured: looks like touches"
    )

    # touches (physics.py, evidence.py)
    radii: tuple[float, ...] = _number((0.08, 0.12, 0.18, 0.27, 0.4), "model units", "of touches told apart", "prior")
    least_drop: float = _number(0.03, "S/m", "strength from which touches are expected", "prior: 0.3 N")
    most_drop: float = _number(2.0, "S/m", "strength up to which", "prior: a drop h counts as h / (1 - h / 2)")
    fall_off: float = _number(0.15, "log", "how fast the prior falls off outside", "prior")
    touches: int = _number(3, "touches", "at most in one frame", "prior: as in training")
    another: float = _number(30.0, "nats", "gain from which there is one touch more", DRIFT_ROWS)
    apart: float = _number(0.5, "model units", "distance within which discs are of one touch", DRIFT_ROWS)

    fits: float = _number(
        10.0, "times the noise", "energy that touches and drift may leave", "measured: touches leave 5"
    )

    steady_nats: float = _number(10.0, "nats", "by which no drift must be likelier than some", DRIFT_ROWS)

    # start (start.py)
    start_contact_sd: float = _number(0.3, "relative", "contacts of an unknown skin", "training: +-30 %")
    layer_sd: float = _number(0.03, "relative", "series part of a contact against its rest", START_ROWS)
    shift_sd: float = _number(2e-4, "model units", "electrodes off their place", "sheet: 0.01 mm; mismatch scales it")
    mismatch_most: float = _number(4.0, "times", "mismatch beyond which it may hide a touch", START_ROWS)
    start_nats: float = _number(30.0, "nats", "by which a touch must explain Z0 better", START_ROWS)

    # touches that change within a scan (within_scan.py)
    changing_left: float = _number(0.03, "of |d|^2", "what such a touch leaves of its frame", "skin bench faults")

    # faults (gain.py, contact_evidence.py)
    gain_least: float = _number(3e-4, "relative", "least step of the board's gain", "sheet: less is drift's")
    gain_sigmas: float = _number(6.0, "sd", "of the common factor's noise, from which it is one", "1e-8 a frame")
    gain_left: float = _number(4.0, "sd of chi-square", "what a common factor may leave", "a touch leaves hundreds")
    lifted_sd: float = _number(2.0, "relative", "sd of a contact that lifts", "sheet: to 3 times and more")
    contact_nats: float = _number(100.0, "nats", "by which a changed contact must be likelier", CONTACT_SCENES)
    contact_apart: float = _number(
        0.3,
        "model units",
        "from an electrode, within which a touch looks like its contact",
        CONTACT_SCENES,
    )
    contact_drift_s: float = _number(10.0, "s", "for which contacts drift, within which one is well", "prior")


TUNING = Tuning()


def table(tuning: Tuning = TUNING) -> list[tuple[str, Any, str, str, str]]:
    """(name, value, unit, meaning, origin) of each number."""
    return [
        (f.name, getattr(tuning, f.name), f.metadata["unit"], f.metadata["meaning"], f.metadata["origin"])
        for f in fields(tuning)
    ]
