"""Each state of an electrode (protocol.frames.ELECTRODE_STATES) gives a reason, and advice for a person."""

from __future__ import annotations

from collections.abc import Iterable

from protocol.frames import ELECTRODE_STATES
from services.estimation.faults.wires import WireFault
from services.estimation.wiring import StuckBit

OK, OPEN, SHORT, UNKNOWN, DRIFTING, SWAPPED, STUCK = range(len(ELECTRODE_STATES))
REASONS = {
    OPEN: "electrode_open",
    SHORT: "electrode_short",
    UNKNOWN: "stale_baseline",
    DRIFTING: "electrode_drift",
    SWAPPED: "electrode_swapped",
    STUCK: "multiplexer",
}
ADVICE = {
    OPEN: "electrode {}: no contact; look at its wire and press it on",
    SHORT: "electrodes {}: connected to each other; part their wires",
    UNKNOWN: "electrode {}: no baseline, it was at fault when that was taken; run `skin tare`",
    DRIFTING: "electrode {}: its contact with the skin changed; press it on, then run `skin tare`",
    SWAPPED: "electrodes {}: their wires are exchanged; put them right",
    STUCK: "the multiplexers do not reach electrode {}",
}

NO_ANSWER = (
    "no electrode answers: the multiplexers are not enabled, nothing is excited (power-cycle the board), or the skin's "
    "cable is off"
)


def stuck_bit(fault: StuckBit | WireFault) -> str:
    return (
        f"an address bit of a multiplexer is stuck: bit {fault.bit} of drive{fault.side} or sense{fault.side} stays "
        f"{fault.value}, so electrodes {listed(fault.electrodes)} (numbered from 0) are never reached; look at the "
        "board's address lines"
    )


def listed(numbers: Iterable[int]) -> str:
    texts = [str(n) for n in numbers]
    return texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + " and " + texts[-1]
