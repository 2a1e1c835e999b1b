"""Waiting for a time that no setting of the system's clock changes."""

from __future__ import annotations

import select


def pause(seconds: float) -> None:
    """As time.sleep, which since Python 3.11 waits for a moment of the monotonic clock: under libfaketime, with that
    clock left alone, each such wait fails with EINVAL. This one names a length of time.
    """
    select.select((), (), (), seconds)
