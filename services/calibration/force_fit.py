"""Fits a skin's force law to a handful of presses of known force.

log force = log scale + exponent * log quantity + a few terms of the place. The law is monotone as long as the exponent
is above 0. It is linear in its coefficients, so leave-one-out errors cost nothing (the hat matrix gives them). The
presses choose the quantity, whether the exponent is free, and the number of terms: the law that predicts each left-out
press best wins, or a simpler one that is nearly as good. The number of presses limits the choice. The stated error is
that of presses that took no part in the fit or in the choice.

How strongly a touch acts is known far better than its size, on which pressure hangs where foam saturates. So presses of
one tip may tell its radius: the quantity is then the pressure over that area.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from models.pressure import disc
from protocol.errors import EitskinError
from services.calibration.seen import KINDS, SeenTouch
from services.contacts.force.calibration_file import Calibration, Of
from services.contacts.force.curve import TERMS, Curve, columns
from services.contacts.force.law import NAMES
from services.contacts.force.of_disc import pressure_under
from services.runtime.config import Skin

Array = NDArray[np.float64]

FEWEST = 5
PRESSES_PER_PARAMETER = 2.5
NEARLY = 1.05  # times the best cross-validated error: the simpler one is taken
OF_ONE_TIP = 1.5  # times as well must a law of one tip foretell as one of tips of any size
TIPS_M: tuple[float, ...] = tuple(np.geomspace(1.5e-3, 40e-3, 60).tolist())  # radii that are tried
SPREAD = 1.5  # ratio of the largest to the smallest force, at least
MOST_ERROR = 0.5  # rms of log force, left out: beyond it nothing was learned
LEAST_EXPONENT = 0.2
APART = 1.4  # ratio of two tips' radii that are told apart


class CalibrationError(EitskinError):
    """The presses make no force law; says what was found, what was expected and what to do."""


@dataclass(frozen=True)
class Press:
    """One press of known force, and what was seen of it; `where` names it in errors."""

    force_n: float
    seen: SeenTouch
    where: str
    tip_m: float | None = None  # radius of what pressed; None: nobody says


@dataclass(frozen=True)
class Form:
    """One of the laws that are tried."""

    reads: Of
    free_exponent: bool
    correction: str
    tip_m: float | None = None  # radius of the tip that all presses were of

    @property
    def parameters(self) -> int:
        return 1 + self.free_exponent + len(TERMS[self.correction]) + (self.tip_m is not None)


@dataclass(frozen=True, eq=False)
class Table:
    """N presses: log force, log quantity by kind, and by the radius of a tip, places [m]."""

    force: Array
    quantity: dict[Of, Array]
    of_tip: dict[float, Array]  # empty where no such law may be told
    x: Array
    y: Array
    reach: float

    def design(self, form: Form) -> tuple[Array, Array]:
        """(N, P) columns and (N,) targets; without a free exponent log quantity is on the left."""
        q = self.quantity[form.reads] if form.tip_m is None else self.of_tip[form.tip_m]
        parts = [np.ones((len(q), 1)), columns(TERMS[form.correction], self.x, self.y, self.reach)]
        if form.free_exponent:
            return np.hstack([parts[0], q[:, None], parts[1]]), self.force
        return np.hstack(parts), self.force - q

    def part(self, rows: NDArray[np.bool_]) -> Table:
        quantity: dict[Of, Array] = {k: v[rows] for k, v in self.quantity.items()}
        of_tip = {k: v[rows] for k, v in self.of_tip.items()}
        return Table(self.force[rows], quantity, of_tip, self.x[rows], self.y[rows], self.reach)


def fit(presses: Sequence[Press], most_n: float | None = None, any_tip: bool = False) -> Calibration:
    """The law of N presses. any_tip: nobody named what presses, so that presses of one tip may tell its radius.
    Raises CalibrationError.
    """
    _check(presses)
    table = _table(presses, any_tip and len(tips(presses)) < 2)
    form = _choose(table)
    left_out = _left_out(table)
    error = float(np.sqrt(np.mean(left_out**2)))
    if error > MOST_ERROR:
        raise CalibrationError(
            f"the others foretell a press only to {100 * np.expm1(error):.0f} %: check that each force belongs "
            "to its press, that one thing touched at a time, and that the tare was taken untouched"
        )
    found = _solve(table, form)
    exponent = float(found[1]) if form.free_exponent else 1.0
    terms = tuple(float(v) for v in found[1 + form.free_exponent :])
    curve = Curve(float(np.exp(found[0])), exponent, form.correction, terms, table.reach)
    known = np.array([p.seen.quantities[form.reads].relative or 0.0 for p in presses])
    own = float(np.sqrt(max(0.0, error**2 - float(np.mean((exponent * known) ** 2)))))
    forces = [p.force_n for p in presses]
    scatter, between = error * math.sqrt(form.parameters / len(presses)), _between_tips(presses, left_out)
    origin = {
        "error": {
            "left_out_rms": error,
            "left_out_median": float(np.median(np.abs(np.expm1(left_out)))),
            "law": math.hypot(scatter, between),  # of the law itself, for each of the tips
            "scatter": scatter,  # of it: what more presses mend
        },
        "presses": len(presses),
        "tips_m": tips(presses),
        "forces_n": [min(forces), max(forces)],
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return Calibration(curve, form.reads, most_n or max(forces), own, form.tip_m, origin)


def tips(presses: Sequence[Press]) -> list[float]:
    """Radii [m] of the tips that are told apart, smallest first."""
    found: list[float] = []
    for radius in sorted(p.tip_m for p in presses if p.tip_m is not None):
        if not found or radius > APART * found[-1]:
            found.append(radius)
    return found


def _between_tips(presses: Sequence[Press], left_out: Array) -> float:
    """The largest mean error of log force of one tip, where there are several: one law for all of them errs by it
    however many presses there are.
    """
    radii = np.array([np.nan if p.tip_m is None else p.tip_m for p in presses])
    sizes = tips(presses)
    if len(sizes) < 2:
        return 0.0
    edges = np.sqrt(np.array(sizes[:-1]) * np.array(sizes[1:]))
    of = np.where(np.isnan(radii), -1, np.searchsorted(edges, radii))
    return float(max(abs(left_out[of == k].mean()) for k in range(len(sizes))))


def unknown(found: Calibration, skin: Skin) -> str:
    """What presses of one size of tip leave unknown, for a person; "" where there is nothing."""
    sizes = found.origin.get("tips_m", [])
    if len(sizes) > 1 or skin.indenter is not None:
        return ""
    were = f"all presses were of one tip, radius {1e3 * sizes[0]:g} mm" if sizes else "nobody said what pressed"
    return (
        f"{were}: whether force follows the {NAMES[found.reads]} for other sizes too, these presses cannot tell; "
        f"press with two tips, one at least {APART:g} times as wide, or name the tip as `indenter` in skin.toml"
    )


def _check(presses: Sequence[Press]) -> None:
    if len(presses) < FEWEST:
        raise CalibrationError(
            f"{len(presses)} presses: at least {FEWEST} are needed, over the skin and from light to firm"
        )
    for p in presses:
        if not (np.isfinite(p.force_n) and p.force_n > 0):
            raise CalibrationError(f"{p.where}: found a force of {p.force_n} N, expected one above 0")
        values = {of: q.value for of, q in p.seen.quantities.items()}
        if not all(np.isfinite(v) and v > 0 for v in values.values()):
            found = ", ".join(f"{of} {value}" for of, value in values.items())
            raise CalibrationError(f"{p.where}: found {found}; expected all above 0: leave this press out")
    forces = [p.force_n for p in presses]
    if max(forces) < SPREAD * min(forces):
        raise CalibrationError(
            f"forces from {min(forces):g} to {max(forces):g} N: expected the largest at least {SPREAD} times the "
            "smallest, or nothing is learned about the law; press lighter and firmer too"
        )


def _table(presses: Sequence[Press], of_one_tip: bool) -> Table:
    quantity = {of: np.log([p.seen.quantities[of].value for p in presses]) for of in KINDS}
    x, y = np.array([(p.seen.x, p.seen.y) for p in presses]).T
    reach = max(float(np.max(np.abs([x, y]))), 1e-6)
    acts = [(s.value, s.value * (s.relative or 0.0)) for s in (p.seen.strength for p in presses)]
    radii = TIPS_M if of_one_tip else ()
    of_tip = {radius: np.log([pressure_under(*each, disc(radius)) for each in acts]) for radius in radii}
    return Table(np.log([p.force_n for p in presses]), quantity, of_tip, x, y, reach)


def _forms(n: int, kinds: Sequence[Of], tip_m: float | None) -> list[Form]:
    """The laws that n presses allow, simplest first."""
    every = [Form(*each) for each in itertools.product(kinds, (False, True), TERMS)]
    if tip_m is not None:
        every += [Form("pressure", *each, tip_m) for each in itertools.product((False, True), TERMS)]
    return sorted((f for f in every if PRESSES_PER_PARAMETER * f.parameters <= n), key=lambda f: f.parameters)


def _solve(table: Table, form: Form) -> Array:
    """Coefficients (P,)."""
    a, y = table.design(form)
    return np.asarray(np.linalg.lstsq(a, y, rcond=None)[0])


def _rises(table: Table, form: Form) -> bool:
    """Whether more of the quantity means more force."""
    return not form.free_exponent or bool(_solve(table, form)[1] > LEAST_EXPONENT)


def _error(table: Table, form: Form) -> float:
    """Root mean square of log force, each press left out."""
    a, y = table.design(form)
    hat = a @ np.linalg.pinv(a)
    slack = np.maximum(1 - np.diag(hat), 1e-6)
    return float(np.sqrt(np.mean(((y - hat @ y) / slack) ** 2)))


def _choose(table: Table) -> Form:
    """The simplest form that is nearly as good as the best. Raises CalibrationError where force does not rise."""
    # This looks at a quantity by itself: a law of slope 1 rises whatever the presses say.
    rising = [reads for reads in table.quantity if _rises(table, Form(reads, True, "none"))]
    if not rising:
        raise CalibrationError(
            "harder presses do not act more strongly, neither by pressure nor by peak nor by integral: expected them "
            "to; check that each force belongs to its press"
        )
    # By the likeliest tip's pressure force is most nearly a constant share.
    tip_m = min(table.of_tip, key=lambda radius: float(np.var(table.force - table.of_tip[radius])), default=None)
    forms = [f for f in _forms(len(table.force), rising, tip_m) if _rises(table, f)]
    errors = {f: _error(table, f) * (OF_ONE_TIP if f.tip_m is not None else 1.0) for f in forms}
    limit = NEARLY * min(errors.values())
    return next(f for f in forms if errors[f] <= limit)


def _left_out(table: Table) -> Array:
    """(N,) errors of log force, each press predicted by a law that was chosen and fitted without it."""
    n = len(table.force)
    errors = np.empty(n)
    for k in range(n):
        rest = np.arange(n) != k
        form = _choose(table.part(rest))
        a, y = table.design(form)
        found, *_ = np.linalg.lstsq(a[rest], y[rest], rcond=None)
        errors[k] = y[k] - a[k] @ found
    return errors
