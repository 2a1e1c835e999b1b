"""Did the contact of one electrode change, whatever touches meanwhile? Both answers' log evidence, from one frame.

    well      drift and touches explain the frame
    changed   drift, touches and any change of this contact: its series part and its rest, each with a wide prior

One frame is enough under a touch that moves, where no frame before is like it. But a disc on a grid misses a touch
close to an electrode by about what a contact does: of 120 touches within 6 mm of the edge, 82 look as if the nearest
contact had changed too (by 5 nats and more; up to 271). So the evidence names nothing by itself. It is asked of an
electrode that ContactDrift suspects, or that is named already. Of 900 touches right on an electrode (radius 2.5 to 20
mm, drop 0.03 to 0.85 S/m) ContactDrift suspects 21, all of them light, and the evidence speaks for a changed contact by
76 nats at most; of 700 within 6 mm it suspects 10, and one of them (radius 3 mm, drop 0.23 S/m, on the electrode's
middle) has 208. A contact that rose 1.3 times, untouched, has 90 to 110; one that is well has fewer than 0, and its
likeliest rise is next to nothing. What drifts is named sooner by its pace (steady_change.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.drift import DriftProcess
from services.estimation.evidence import evidence_of
from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]

JUMPED_NATS = 8.0  # by which a contact that seemed to jump must be likelier changed than not
WELL_WITHIN = 0.05  # relative: a contact that is farther off its old impedance is not well, however likely drift is


class ContactOpinion(NamedTuple):
    odds: float  # nats by which a changed contact is likelier than none
    elsewhere: bool  # whether touches, if any, are far enough from the electrode for `odds` to name it
    felt: Array  # (K,) d that the change makes at pairs of other electrodes
    rise: float  # of the contact impedance, relative: the likeliest, if it changed
    fits: bool  # whether a changed contact and touches are all that there is: a fault is not explained by them

    def changed(self, tuning: Tuning = TUNING) -> bool:
        return self.elsewhere and self.odds > tuning.contact_nats

    @property
    def jumped(self) -> bool:
        """The same of a contact that seemed to jump a moment ago, which is evidence too."""
        return self.elsewhere and self.fits and self.odds > JUMPED_NATS and self.rise > WELL_WITHIN

    @property
    def well(self) -> bool:
        return self.odds < 0 and abs(self.rise) < WELL_WITHIN


class ContactEvidence:
    """For a bundle that predicts impedances. A call takes two evaluations of the evidence, 20 ms."""

    def __init__(self, bundle: Bundle, tuning: Tuning = TUNING) -> None:
        self.tuning, self._evidence = tuning, evidence_of(bundle)
        self._centre = np.asarray(bundle.skin["electrodes"]["centre"], dtype=float)  # (E, 2) model units
        physics = self._evidence.physics
        self._rest = physics.contact - physics.layer  # (K, E)
        self._members = physics.members()
        process = DriftProcess.of_skin(physics.electrodes, creep=False, tuning=tuning)
        self._prior = process.value_covariance(tuning.contact_drift_s)

    def __call__(self, electrode: int, d: Array, sigma: Array, live: NDArray[np.bool_]) -> ContactOpinion:
        """d (K,) against the untouched skin, sigma (K,) of one frame; live (K,): measurements that count."""
        physics = self._evidence.physics
        error = np.diag(np.where(live, sigma, 0.0) ** 2 + self.tuning.absolute**2)
        columns = physics.columns(d)
        well = self._evidence(d, error, columns, self._prior, live)
        own = np.column_stack([physics.layer[:, electrode], self._rest[:, electrode]])
        n = columns.shape[1]
        prior = np.pad(self._prior, (0, 2))
        prior[n:, n:] = np.eye(2) * self.tuning.lifted_sd**2
        changed = self._evidence(d, error, np.column_stack([columns, own]), prior, live)
        alone = changed.untouched >= changed.touched
        apart = [float(np.linalg.norm(t.position - self._centre[electrode])) for t in changed.touches]
        common = changed.drift[1 + electrode]
        felt = np.where(self._members[:, electrode], 0.0, self._rest[:, electrode] * (common + changed.drift[-1]))
        return ContactOpinion(
            max(changed.touched, changed.untouched) - max(well.touched, well.untouched),
            alone or min(apart, default=np.inf) > self.tuning.contact_apart,
            felt,
            float(common + changed.drift[-2]),
            changed.fits,
        )
