"""`skin calibrate --live`: the presses that another sensor says the force of, and how far they have come."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from services.cli.common import use_configured_sockets

if TYPE_CHECKING:
    from services.calibration.force_fit import Press
    from services.calibration.seen import TouchReader


def pressed(name: str, read: TouchReader, before: Sequence[Press], tip: float, most: int, any_tip: bool) -> list[Press]:
    """The presses that are made now, until they and those of before are enough, or `most`, or Ctrl-C. any_tip: see
    `force_fit.fit`.
    """
    from services.calibration.force_fit import FEWEST, CalibrationError
    from services.calibration.live import LivePresses

    use_configured_sockets()
    _tell(f"press here and there, lightly and firmly; at most {most} presses, Ctrl-C ends before")
    found: list[Press] = []
    presses = LivePresses(name, read, _tell, tip or None)
    try:
        for press in presses:
            found.append(press)
            delay_ms = 1e3 * (presses.reference.delay_s or 0.0)
            at = f"({press.seen.x * 1e3:+.1f}, {press.seen.y * 1e3:+.1f}) mm"
            _tell(f"  {len(found)}: {press.force_n:.2f} N at {at}, the reference {delay_ms:.0f} ms later")
            if _enough([*before, *found], any_tip) or len(found) >= most:
                return found
    except (CalibrationError, KeyboardInterrupt) as why:
        if len(before) + len(found) < FEWEST:
            raise
        _tell(f"{why or 'ended'}; the law is that of the {len(before) + len(found)} presses until then")
    finally:
        presses.close()
    return found


def _enough(presses: list[Press], any_tip: bool) -> bool:
    """Whether they are, and what is known by now, told."""
    from services.calibration.force_fit import CalibrationError, fit
    from services.calibration.live import missing

    try:
        law = fit(presses, any_tip=any_tip)
    except CalibrationError as why:
        _tell(f"  no law yet: {why}")
        return False
    error, left = law.origin["error"], missing(presses, law)
    known = f"the law is known to {100 * error['law']:.1f} %, one press to {100 * error['left_out_rms']:.0f} %"
    _tell(f"  {known}; " + (f"missing: {left}" if left else "enough"))
    return not left


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
