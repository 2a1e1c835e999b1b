"""Is the skin untouched when nothing is known of it yet? Its first |Z0|, judged.

Cold, |Z0| is held against the bundle's prediction, the gain, the sheet's conductivity and every contact impedance free.
The skin is never quite the bundle's: its mismatch (layers under the electrodes, electrodes off their places, another
mesh) has a known form and an unknown size, which is summed over a ladder of factors of two. A touch either explains
what mismatch and contacts leave, or it does not; and where the mismatch is so large that a touch could hide in it,
nothing is said.

With a baseline that is trusted, of this very skin and board, its mismatch is in both, and only drift is allowed for.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.estimation.evidence import Explanation, TouchEvidence, Whitened
from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]

LADDER = 2.0 ** np.arange(9)  # of the mismatch: up to 256 times the least
SURE_MISMATCH, SURE_LEFT = 16.0, 3.0
"""A touch surely explains the skin where it needs no more mismatch beside it, and leaves no more times what is expected
(tests/services/test_estimation_evidence.py). Touches like those of the training need 16 and leave 2.9 at most. Skins
that nothing touches and that are not as in their file need 64 or leave 3.4, at least.
"""


class StartVerdict(Enum):
    UNTOUCHED = "untouched"
    TOUCHED = "touched"
    UNKNOWN = "unknown"  # the mismatch of bundle and skin may hide a touch


class StartJudgement(NamedTuple):
    verdict: StartVerdict
    odds: float  # nats: log evidence of touched against untouched
    sure: bool  # whether a touch explains the skin, and not only better than mismatch alone does
    mismatch: float  # times the least one: the likeliest, of an untouched skin
    explanation: Explanation | None  # under the likeliest mismatch of a touched skin; drift is relative to `expected`
    expected: Array | None  # (K,) ohm: |Z0| that the frames were held against
    prior: Array | None  # (N, N) of the drift; columns are physics.columns(d)


def judge_start(
    z0: Array,
    sigma: Array,
    evidence: TouchEvidence,
    trusted: Array | None = None,
    drift_prior: Array | None = None,
    tuning: Tuning = TUNING,
) -> StartJudgement:
    """z0, sigma (K,): mean |Z| of the first frames and the standard deviation of that mean, same unit; 0 and infinite
    where not measured. trusted (K,): |Z0| of this skin untouched, in the same unit, known earlier; drift_prior
    (1 + E, 1 + E): covariance of the drift since.
    """
    physics = evidence.physics
    if trusted is None and not physics.signed:
        return StartJudgement(StartVerdict.UNKNOWN, 0.0, False, float("inf"), None, None, None)
    live = np.isfinite(z0) & (z0 > 0) & np.isfinite(sigma)
    if trusted is not None:
        live &= np.isfinite(trusted) & (trusted > 0)
    if live.sum() < len(z0) / 2:
        return StartJudgement(StartVerdict.UNKNOWN, 0.0, False, float("inf"), None, None, None)
    expected = physics.z0 if trusted is None else trusted
    gain = float(np.median(z0[live] / expected[live]))
    # Scale and contacts are what a gain of 1 leaves; a trusted skin's own gain is part of its drift.
    expected = expected * gain if trusted is None else np.where(live, expected, 1.0)
    d = np.where(live, z0 / expected - 1.0, 0.0)
    noise = np.where(live, sigma / expected, 0.0) ** 2 + tuning.absolute**2
    electrodes = physics.electrodes
    if trusted is None:
        form = tuning.layer_sd**2 * physics.layer @ physics.layer.T + tuning.absolute**2 * np.eye(len(d))
        form += tuning.shift_sd**2 * physics.shift @ physics.shift.T
        prior = np.diag([1.0, *[tuning.start_contact_sd**2] * electrodes])
    else:
        form = tuning.absolute**2 * np.eye(len(d))
        prior = np.diag([tuning.scale_sd**2, *[tuning.contact_sd**2] * electrodes])
        prior = prior if drift_prior is None else drift_prior
    columns = physics.columns(d)
    rungs = _rungs(d, noise, form, columns, prior, live)
    found = [evidence(d, np.diag(noise) + rung**2 * form, columns, prior, live) for rung in rungs]
    log_prior = -np.log(2.0) * np.log2(rungs)  # the larger, the less likely
    untouched, touched = (np.array([getattr(e, name) for e in found]) + log_prior for name in ("untouched", "touched"))
    odds = float(np.logaddexp.reduce(touched) - np.logaddexp.reduce(untouched))
    mismatch = float(rungs[int(untouched.argmax())])
    verdict = StartVerdict.UNKNOWN
    if odds > tuning.start_nats:
        verdict = StartVerdict.TOUCHED
    elif odds < 0 and mismatch <= tuning.mismatch_most:
        verdict = StartVerdict.UNTOUCHED
    best = int(touched.argmax())
    sure = bool(rungs[best] <= SURE_MISMATCH) and found[best].left < SURE_LEFT * found[best].measurements
    sure &= verdict is StartVerdict.TOUCHED
    return StartJudgement(verdict, odds, sure, mismatch, found[best], expected, prior)


def _rungs(
    d: Array, noise: Array, form: Array, columns: Array, prior: Array, live: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The mismatches worth looking at: up to beyond where an untouched skin would be likeliest."""
    on = np.ix_(live, live)
    base = (np.diag(noise) + columns @ prior @ columns.T)[on]
    density = []
    for rung in LADDER:
        white = Whitened.of(base + rung**2 * form[on])
        density.append(white.density(white(d[live])))
    return np.asarray(LADDER[: min(len(LADDER), int(np.argmax(density)) + 2)])
