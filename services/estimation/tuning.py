"""Every number of the estimation, with its unit, its meaning and where it comes from.

`origin` is "sheet": data of the board or the foam; "measured": found on frames; or the program in bench/ that chose it.
`table()` gives them all as rows; a test keeps their number at 30 at most.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def _number(value: Any, unit: str, meaning: str, origin: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "origin": origin})


@dataclass(frozen=True)
class Tuning:
    """Lengths are model units (half a side of the square skin), drops S/m, d the relative difference of |Z|."""

    # drift (drift.py)
    scale_sd: float = _number(0.05, "relative", "stationary sd of the sheet's conductivity", "sheet: dries by 5 %")
    scale_s: float = _number(250.0, "s", "time constant of it", "scale_sd / 250 s = 2e-4/s, the old scale_per_s")
    contact_sd: float = _number(0.2, "relative", "stationary sd of a contact impedance", "sheet: contacts age by 20 %")
    contact_s: float = _number(250.0, "s", "time constant of it", "contact_sd / 250 s = 8e-4/s, the old contact_per_s")
    creep_sd: float = _number(0.05, "of the touch", "stationary sd of what a touch leaves behind", "sheet: foam's set")
    creep_s: float = _number(60.0, "s", "time constant of it", "sheet: recovered within two minutes")

    # errors of the model (errors.py)
    absolute: float = _number(3e-5, "relative", "what no model of |Z| gets right", "bench/estimation.py: meshes differ")
    misfit: float = _number(0.03, "of the touch's |d|", "what linear discs get wrong", "bench/estimation.py, drift rows")
    misfit_power: float = _number(0.8, "power", "of the Gram matrix's eigenvalues", "measured: misfit looks like touches")

    # touches (touches.py, evidence.py)
    radii: tuple[float, ...] = _number((0.08, 0.12, 0.18, 0.27, 0.4), "model units", "of the touches told apart", "prior")
    least_drop: float = _number(0.03, "S/m", "strength from which touches are expected", "prior: 0.3 N")
    most_drop: float = _number(2.0, "S/m", "strength up to which: 0.9 counts as h / (1 - h / 2)", "prior: 0.9 S/m")
    fall_off: float = _number(0.15, "log", "how fast the prior falls off outside", "prior")
    touches: int = _number(3, "touches", "at most in one frame", "prior: as in training")
    another: float = _number(30.0, "nats", "gain from which there is one touch more", "bench/estimation.py, drift rows")
    apart: float = _number(0.5, "model units", "positions within which atoms are of one touch", "prior: training's gap")

    # start (start.py)
    start_contact_sd: float = _number(0.3, "relative", "contacts of an unknown skin", "training: +-30 %")
    start_scale_sd: float = _number(1.0, "relative", "gain and conductivity of an unknown skin", "free")
    layer_sd: float = _number(0.03, "relative", "series part of a contact against the rest", "bench/estimation.py: meshes")
    shift_sd: float = _number(2e-4, "model units", "electrodes off their place", "sheet: 0.01 mm; the mismatch scales it")
    mismatch_most: float = _number(4.0, "times", "mismatch beyond which it may hide a touch", "bench/estimation.py, start")
    start_nats: float = _number(50.0, "nats", "by which a touch must explain Z0 better", "bench/estimation.py, start")

    # faults and time (faults.py, filter.py)
    gain_sd: float = _number(0.05, "relative", "sd of a step of the board's gain", "issue: steps of 0.1 to 5 %")
    changed_contact_sd: float = _number(2.0, "relative", "sd of a contact that lifts", "sheet: to 3 times and more")
    fault_misfit: float = _number(0.05, "of the fault's |d|", "what its prediction gets wrong", "touches meanwhile")
    touch_rate: float = _number(0.2, "1/s", "touches begin so often", "prior")
    release_rate: float = _number(0.2, "1/s", "and end so often", "prior")
    fault_rate: float = _number(1e-4, "1/s", "each kind of fault begins so often", "prior: once in three hours")
    mend_rate: float = _number(0.1, "1/s", "and ends so often", "prior")
    false_alarms: float = _number(1e-7, "per frame", "an untouched frame is called touched", "as [touch] false_alarms")


TUNING = Tuning()


def table(tuning: Tuning = TUNING) -> list[tuple[str, Any, str, str, str]]:
    """(name, value, unit, meaning, origin) of each number."""
    return [
        (f.name, getattr(tuning, f.name), f.metadata["unit"], f.metadata["meaning"], f.metadata["origin"])
        for f in fields(tuning)
    ]
