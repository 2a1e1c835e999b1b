"""When a kept baseline was taken."""

from __future__ import annotations

from typing import Any

from services.runtime.stage import Refused

LONGEST_S = 1e9  # a saved time that is longer is none


def ages(saved: dict[str, Any]) -> tuple[float, float]:
    """When a baseline was taken and the skin last known as untouched, both in seconds before it was kept. Raises
    Refused where those are no times.
    """
    try:
        taken_s, quiet_s = (float(saved.get(key, 0.0)) for key in ("taken_s", "quiet_s"))
        if not (0 <= taken_s <= LONGEST_S and 0 <= quiet_s <= LONGEST_S):
            raise ValueError(f"found {taken_s:g} s and {quiet_s:g} s")
    except (TypeError, ValueError) as wrong:
        raise Refused(f"the saved baseline has no age ({wrong}): tare again") from None
    return taken_s, quiet_s
