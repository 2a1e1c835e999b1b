"""A contact that rises between whole scans is no touch, and a touch beside an electrode is: on the stub's sheet, which
the inverse does not use.
"""

from __future__ import annotations

import numpy as np
import pytest

from bench.reliability.matrix import CONTACT_RISES, FAULT_END_S, FAULT_S, ROWS, contact_of
from bench.reliability.scenes import script
from bench.reliability.session import Session, new_pipeline
from bench.reliability.workers import sheet as solved_sheet
from models.shapes import Shape
from services.estimation.rolling import measured_at
from tests.services.stub_skin import sheet, transfer

SIGMA = 1e-4
AGE_US = 43_600.0


def change(bundle, touches=(), contacts=()):
    """(K,) of the sheet's |Z|."""
    dp, dm, sp, sm = bundle.pattern.T

    def read(t):
        return np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm])

    return read(transfer(touches, contacts)) / read(transfer()) - 1


def shown(bundle, evidence, places, change, fresh, newest, seed, lasts=1):
    """Whether `change` (K,), which the `fresh` newest values felt and which came within so many of them, is taken for a
    touch: without a look at contacts, and with it.
    """
    rng, at = np.random.default_rng(seed), measured_at(bundle, newest)
    course = np.clip((fresh - np.argsort(np.argsort(-at))) / lasts, 0, 1)
    d, noise, age = change * course + SIGMA * rng.standard_normal(120), np.full(120, SIGMA), (1 - at) * AGE_US
    if (onset := evidence.began(d, noise, age)) is None:
        return False, False
    place = places(d, noise, age, onset.starts)
    return place.touch.fits, place.touch.fits and evidence.no_contact(d, noise, age, place)


@pytest.mark.parametrize("times", [1.4, 1.75, 4.0])
def test_a_contact_that_rises_is_never_taken_for_a_touch(bundle, evidence, places, times):
    alike = 0
    for electrode in range(16):
        rose = change(bundle, contacts=((electrode, times),))
        for k, fresh in enumerate((5, 9, 14, 22, 37)):
            lasts = (1, 3, 12)[k % 3]
            looked = shown(bundle, evidence, places, rose, fresh, 1 + (electrode + k) % 10, k, lasts)
            alike += looked[0]
            assert not looked[1], (electrode, fresh)
    assert alike > 0, "without a look at contacts some are"


def test_a_touch_beside_an_electrode_is_shown_from_two_parts(bundle, evidence, places):
    found = []
    for electrode, (x, y) in enumerate(sheet().skin.point(sheet().skin.electrodes)):
        touched = change(bundle, (Shape("circle", 0.88 * float(x), 0.88 * float(y), 0.2, 0.2),))
        found.append(shown(bundle, evidence, places, touched, 24, 1 + electrode % 10, electrode))
    assert sum(before for before, _ in found) >= 15
    assert sum(after for _, after in found) >= 14


@pytest.mark.slow
def test_while_a_contact_rises_no_frame_shows_a_touch_and_a_whole_scan_names_it():
    """In the fault matrix, at this electrode and rise, the first parts made a phantom."""
    row = next(row for row in ROWS if row.title == CONTACT_RISES)
    session = Session(
        solved_sheet(),
        script(contact=contact_of(row, {"electrode": 12, "times": 1.75})),
        seed=6,
        pipeline=new_pipeline(scan="rolling"),
    )
    moments = [m for m in session.run(FAULT_END_S + 1.0) if m.read_s >= FAULT_S]
    session.close()
    assert not any(m.contacts for m in moments if m.valid)
    named = [m.read_s for m in moments if "electrode_drift" in m.reasons]
    assert named[0] - FAULT_S < 0.15
    assert moments[-1].valid
