"""What faults of the board are to a frame, states of electrodes and judgements; and to a person, advice. Some cannot be
told with the measurements of a bundle: those checks are named, so that none looks passed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frame_types import ELECTRODE_STATES, STATUS_CLIPPED, STATUS_FIFO, STATUS_RTIA
from services.estimation.faults.wires import WireFault, WireKind, all_pairs
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Judgement, Verdict, judge

OK, OPEN, SHORT, UNKNOWN, DRIFTING, SWAPPED, STUCK = range(len(ELECTRODE_STATES))
STATE_OF = {WireKind.EXCHANGED: SWAPPED, WireKind.SHORT: SHORT, WireKind.STUCK: STUCK}
ANY = 1e-6  # share of measurements: one is enough
ROW_OF = {OPEN: "open", SHORT: "short", DRIFTING: "impedance", SWAPPED: "exchanged", STUCK: "stuck"}
ADVICE = {
    OPEN: "electrode {}: no contact; look at its wire and press it on",
    SHORT: "electrodes {}: connected to each other; part their wires",
    UNKNOWN: "electrode {}: no baseline, it was at fault when that was taken; run `skin tare`",
    DRIFTING: "electrode {}: its contact with the skin changed; press it on, then run `skin tare`",
    SWAPPED: "electrodes {}: their wires are exchanged; put them right",
    STUCK: "the multiplexers do not reach electrode {}",
}
PREDICTED = ("touches at the first start", "drift under a touch", "touches that change during a scan")
NO_ANSWER = (
    "no electrode answers: the multiplexers are not enabled, nothing is excited (power-cycle the board), or the skin's "
    "cable is off"
)


def states_of(
    electrodes: int, wire: WireFault | None, opens: tuple[int, ...], contact: int, silent: bool
) -> NDArray[np.uint8]:
    """(E,) of the wire format. contact: electrode whose impedance is changed; -1: none. silent: none answers."""
    states = np.full(electrodes, OK, np.uint8)
    if contact >= 0:
        states[contact] = DRIFTING
    states[list(opens)] = OPEN
    if wire is not None:
        states[list(wire.electrodes)] = STATE_OF[wire.kind]
    if silent:
        states[:] = STUCK
    return states


def judgements_of(
    states: NDArray[np.uint8], status: NDArray[np.uint8], failed: float, undecided: bool
) -> list[Judgement]:
    """Of states (E,), status bits (K,) and the share that failed. undecided: a contact that changed may be a touch."""
    found = [judge("silent", failed, n.SILENT)]
    for state, row in ROW_OF.items():
        named = np.flatnonzero(states == state)
        doubtful = undecided and state == DRIFTING  # it may not be named yet
        statistic, where = 1.0 if doubtful else len(named), int(named[0]) if len(named) else -1
        found.append(judge(row, statistic, 1.0, where, Verdict.REFUSE if doubtful else None))
    found.append(judge("saturated", float(np.mean(status & (STATUS_CLIPPED | STATUS_RTIA) != 0)), ANY))
    found.append(judge("fifo", float(np.mean(status & STATUS_FIFO != 0)), ANY))
    lost = int(np.isin(states, (OPEN, SHORT, DRIFTING, SWAPPED)).sum())
    found.append(judge("degraded", lost if lost < n.TOO_MANY else 0.0, n.DEGRADED))
    found.append(judge("too_many", lost, n.TOO_MANY))
    return found


def sentences(states: NDArray[np.uint8], wire: WireFault | None, silent: bool) -> list[str]:
    """To a person: which electrodes (E,) are at fault, and what to do. silent: none of them answers."""
    if silent:
        return [NO_ANSWER]
    if wire is not None and wire.kind is WireKind.STUCK:
        return [
            f"an address bit of a multiplexer is stuck: bit {wire.bit} of drive{wire.side} or sense{wire.side} stays "
            f"{wire.value}, so electrodes {_listed(wire.electrodes)} (numbered from 0) are never reached; look at the "
            "board's address lines"
        ]
    found = []
    for state, text in ADVICE.items():
        named = np.flatnonzero(states == state).tolist()
        if named:
            found.append(text.format(_listed(named)) + " (electrodes are numbered from 0)")
    return found


def skipped(bundle: Bundle) -> dict[str, str]:
    """Returns the checks that cannot be made, each with the reason, from the bundle's pattern and normalisation."""
    pattern = np.asarray(bundle.pattern)
    own = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
    predicting = [  # check, whether the pattern allows it, what it lacks otherwise
        ("exchanged wires and stuck multiplexers", all_pairs(pattern), "not all pairs of electrodes are measured"),
        ("contacts that change", own.all(), "not all pairs sense where they drive"),
        ("changes that no touch can make", own.sum() >= len(own) / 2, "few pairs sense where they drive"),
        *((check, True, "") for check in PREDICTED),
    ]
    if bundle.matrices.normalisation != "model":
        predicting = [(check, False, "a measured bundle predicts no impedances") for check, _, _ in predicting]
    checks = [("shorts between electrodes", own.any(), "no pair senses where it drives"), *predicting]
    return {check: why for check, made, why in checks if not made}


def unchecked(bundle: Bundle) -> str:
    """Says the same to a person; "" where every check is made."""
    by_reason: dict[str, list[str]] = {}
    for check, why in skipped(bundle).items():
        by_reason.setdefault(why, []).append(check)
    parts = [f"{', '.join(checks)} ({why})" for why, checks in by_reason.items()]
    return f"not checked with the bundle {bundle.name}: {'; '.join(parts)}" if parts else ""


def _listed(numbers: Iterable[int]) -> str:
    texts = [str(n) for n in numbers]
    return texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + " and " + texts[-1]
