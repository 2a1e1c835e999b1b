"""The named worlds. Each has a source for its figures; each kind of trouble comes in more than one form, because a
model that knows the form is not tried by it.

Forms that are `reported` are never used to choose a number of the service: docs/reliability.md says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from firmware_stub.sheet import Sheet
from models.mismatch import Mismatch
from protocol.errors import EitskinError

from .disturbances import Disturbances, Flicker, Hum, Telegraph
from .foam import ExponentialCreep, PowerCreep
from .nature import Nature, Rise

MESH = "world"  # of these worlds alone
SKINS = 4  # skins of a kind that is mounted wrong
PLACE_M = 0.03  # of a warm spot, from the centre
PER_DEGREE = 0.02  # of conductivity
WARMS_S = 6.0  # from when on: while the sheet warms as fast as at first, no baseline is taken at all


@dataclass(frozen=True)
class Ailment:
    """One thing that real skins do. foam: "" or a form of creep; warmth: which of them; the rest as in Disturbances.
    edge_m: standard deviation of the blur of a touch's edge.
    """

    what: str
    source: str
    foam: str = ""
    warmth: tuple[str, ...] = ()
    edge_m: float = 0.0
    mounted: bool = False
    flicker: Flicker | None = None
    telegraph: Telegraph | None = None
    hum: Hum | None = None
    reported: bool = False


CREEP = (
    "a constant force's drop grows by 5 to 15 % in a minute; 1 to 8 % stay after a release and fade: two regimes of "
    "recovery, a fast and a slow one (M. van der Schuur et al., Polymer 2004, poly(ether urethane urea) foam)"
)
POWER = (
    "the same in a minute, as a power of time with an exponent of 0.1 to 0.3 (W. N. Findley et al., Creep and "
    "Relaxation of Nonlinear Viscoelastic Materials, 1976); without an end, as C. Pichler et al. found polyurethane "
    "foam to creep (J. Eng. Mater. Technol. 2018)"
)
DEGREE = "ionic conductivity rises by 2 % a degree (aqion.de/site/112); "
WARM_UP = DEGREE + "5 degrees with a time constant of 10 minutes: a robot's first hour"
HAND = DEGREE + "skin of 33 degrees on foam of 23, of which a third arrives in the mean of its thickness, in 20 to 40 s"
MAINS = "50 Hz, twice the noise at 80 dB: electrodes beside a mains cable, of which filters leave little"
MOTOR = "twice the noise at 80 dB: a motor of 1,800 to 18,000 turns a minute, 30 to 300 Hz, up and down again"
BURST = "a drive that switches on: 50 ms of ten times the noise at 80 dB, every two seconds"
ELECTRODE = "0.1 % of the contact impedance, as 1 / f noise (E. Huigen et al., Med. Biol. Eng. Comput. 2002)"
NOISY = "0.1 % of the contact impedance, without memory: each measurement closes its multiplexers anew"
JUMPS = "three contacts that lift and close under bending by 2 %, every two seconds each: random telegraph noise"
EDGE = "foam of 5 mm is pressed beside a touch too: to where its thickness reaches, at most"
MOUNTED = "electrodes off by 1 % of the side, a field of 5 %, anisotropy of 5 %, contact impedances of 30 %: as `mild`"
MAINS_HUM = Hum(2e-4, 50.0)
SWEEP_HUM = Hum(2e-4, 30.0, 300.0)

WORLDS: Mapping[str, Ailment] = {
    "plain": Ailment("nothing but noise", "80 dB, as the board's converter has"),
    "creep": Ailment("foam relaxes and remembers, exponentially", CREEP, foam="exponentials"),
    "creep-power": Ailment("foam relaxes and remembers, as a power of time", POWER, foam="power", reported=True),
    "warming": Ailment("the sheet warms evenly, at first by half a degree a minute", WARM_UP, warmth=("even",)),
    "gradient": Ailment("one side warms more", DEGREE + "a drive under one side", warmth=("even", "slope")),
    "warm-spot": Ailment("one place warms by 3 degrees", DEGREE + "a motor underneath", warmth=("spot",)),
    "warm-hand": Ailment("the touching hand warms its place", HAND, warmth=("hand",), reported=True),
    "line": Ailment("a disturbing line", MAINS, hum=MAINS_HUM),
    "sweep": Ailment("a disturbing frequency that sweeps", MOTOR, hum=SWEEP_HUM, reported=True),
    "bursts": Ailment("bursts of disturbance", BURST, hum=Hum(1e-3, 120.0, on_s=0.05)),
    "noisy-contacts": Ailment("noisy contact impedances", NOISY, flicker=Flicker(1e-3, (1e-6,))),
    "flicker": Ailment("flickering contact impedances", ELECTRODE, flicker=Flicker(1e-3)),
    "telegraph": Ailment("contact impedances that jump", JUMPS, telegraph=Telegraph(0.02, 2.0), reported=True),
    "soft-1.5": Ailment("edges of touches soft by 1.5 mm", EDGE, edge_m=1.5e-3, reported=True),
    "soft-3": Ailment("edges of touches soft by 3 mm", EDGE, edge_m=3e-3),
    "soft-5": Ailment("edges of touches soft by 5 mm", EDGE, edge_m=5e-3),
    "mounted": Ailment("mounted a few per cent wrong", MOUNTED, mounted=True),
    "all": Ailment(
        "creep, gradient, line, flicker, edges of 3 mm and mounted wrong, at once",
        "those",
        foam="exponentials",
        warmth=("even", "slope"),
        edge_m=3e-3,
        mounted=True,
        flicker=Flicker(1e-3),
        hum=MAINS_HUM,
    ),
    "all-reported": Ailment(
        "creep-power, warm-hand, sweep, telegraph, soft-1.5 and mounted wrong, at once",
        "those",
        foam="power",
        warmth=("hand",),
        edge_m=1.5e-3,
        mounted=True,
        telegraph=Telegraph(0.02, 2.0),
        hum=SWEEP_HUM,
        reported=True,
    ),
}


class WorldError(EitskinError, ValueError):
    """No such world; the message lists those there are."""


def named(name: str) -> Ailment:
    """One of WORLDS. Raises WorldError."""
    if name not in WORLDS:
        raise WorldError(f"no world {name!r}: expected one of {', '.join(WORLDS)}")
    return WORLDS[name]


def sheet(name: str, seed: int, of: str = "square16") -> Sheet:
    """A skin of this world, on the worlds' own mesh. Raises WorldError."""
    ailment = named(name)
    mismatch = replace(Mismatch(), blur_m=ailment.edge_m)
    if ailment.mounted:
        mild = Mismatch(anisotropy=0.05, field=0.05, shift=0.02, contact_spread=0.3, blur_m=ailment.edge_m)
        mismatch = mild.seeded(1 + seed % SKINS)
    return _sheet(of, mismatch)


@lru_cache(maxsize=8)
def _sheet(of: str, mismatch: Mismatch) -> Sheet:
    return Sheet(of, mismatch, mesh=MESH)


def nature(name: str, seed: int) -> Nature | None:
    """What its foam and warmth do, drawn from the seed; None: nothing. Raises WorldError."""
    ailment = named(name)
    if not ailment.foam and not ailment.warmth:
        return None
    rng = np.random.default_rng([seed, 43])
    found: dict[str, Any] = {}
    minute, fast = float(rng.uniform(0.05, 0.15)), float(rng.uniform(0.3, 0.6))
    if ailment.foam == "exponentials":
        found["creep"] = ExponentialCreep(((fast * minute, 2.0), ((1 - fast) * minute, 40.0)))
    elif ailment.foam:
        found["creep"] = PowerCreep(1.5 * minute, float(rng.uniform(0.1, 0.3)))
    angle = float(rng.uniform(0, 2 * np.pi))
    if "even" in ailment.warmth:
        found["even"] = Rise(5 * PER_DEGREE, 600.0, WARMS_S)
    if "slope" in ailment.warmth:
        found["sloped"] = Rise(PER_DEGREE / 0.05, 600.0, WARMS_S)
        found["slope"] = float(np.cos(angle)), float(np.sin(angle))
    if "spot" in ailment.warmth:
        place = rng.uniform(-PLACE_M, PLACE_M, 2)
        found["spot"] = Rise(3 * PER_DEGREE, 120.0, WARMS_S)
        found["spot_place"] = float(place[0]), float(place[1]), 0.02
    if "hand" in ailment.warmth:
        found["hand"] = Rise(10 / 3 * PER_DEGREE, float(rng.uniform(20, 40)))
    return Nature(**found)


def disturbances(name: str, seed: int, of: Sheet) -> Disturbances | None:
    """What disturbs single measurements; None: nothing does. Raises WorldError."""
    ailment = named(name)
    if ailment.flicker is None and ailment.telegraph is None and ailment.hum is None:
        return None
    return Disturbances(of.contact_slopes(), seed, ailment.flicker, ailment.telegraph, hum=ailment.hum)
