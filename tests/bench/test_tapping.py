"""A finger that taps again and again leaves no pause in which the baseline is followed: it must not be spoiled."""

from __future__ import annotations

import numpy as np
import pytest

from bench.reliability import scenes, workers
from bench.reliability.session import Session

TAPS, PRESSED_S, PAUSE_S, BEGIN_S = 110, 0.3, 0.3, 6.0
PERIOD_S = PRESSED_S + PAUSE_S + 0.013  # the taps begin at every phase of a scan
RAMP_S = 0.001


@pytest.mark.release
def test_taps_for_a_minute_leave_the_skin_untouched_in_between() -> None:
    """After a minute without a pause that counts, drift is read from touches: not from one that began in the scan."""
    places = np.random.default_rng(1).uniform(-0.043, 0.043, (20, 2))
    touches = [scenes.circle(float(x), float(y), 2.0, 0.1) for x, y in places]
    begins = [BEGIN_S + k * PERIOD_S for k in range(TAPS)]
    tracks = [scenes.press(touches[k % 20], t, t + PRESSED_S, ramp=RAMP_S) for k, t in enumerate(begins)]
    session = Session(workers.sheet(), scenes.script(tuple(tracks)), 3, workers.pipeline("square16"))
    pauses = wrong = 0
    for m in session.run(begins[-1] + 2.0):
        free_s = min((m.middle_s - t - PRESSED_S for t in begins if m.middle_s > t + PRESSED_S), default=0.0)
        next_s = min((t - m.middle_s for t in begins if t > m.middle_s), default=1.0)
        if m.middle_s < BEGIN_S or m.truth or free_s < 0.15 or next_s < 0.03:  # a touch is in a part of the scan
            continue
        pauses += 1
        wrong += not m.valid or bool(m.contacts)
    session.close()
    assert pauses > 2 * TAPS and wrong == 0
