"""A contact that rises between whole scans is no touch, and a touch beside an electrode is: on the stub's sheet, which
the inverse does not use.
"""

from __future__ import annotations

from bench.reliability.matrix import CONTACT_RISES, FAULT_END_S, FAULT_S, ROWS, contact_of
from bench.reliability.scenes import script
from bench.reliability.session import Session, new_pipeline
from bench.reliability.workers import sheet as solved_sheet


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
