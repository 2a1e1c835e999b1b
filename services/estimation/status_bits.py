"""The board itself gives each measurement a status, in bits; some of them give a frame its reasons."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_RTIA

# An open electrode has a bit too, but is named by all of its measurements together (electrodes.py).
REASON_OF = {STATUS_CLIPPED | STATUS_RTIA: "saturated", STATUS_FIFO: "fifo"}


def reasons_of(status: NDArray[np.uint8]) -> list[str]:
    """Returns the reasons that the bits of a scan (K,) give."""
    if not status.any():
        return []
    seen = int(np.bitwise_or.reduce(status))
    return [reason for bits, reason in REASON_OF.items() if seen & bits]
