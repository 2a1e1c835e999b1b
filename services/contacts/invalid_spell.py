"""How long no contact frame has been valid, in words for status and `skin doctor`."""

from __future__ import annotations

from collections.abc import Sequence

from protocol.frame_types import REASONS

LASTS_S = 5.0
"""A start takes three seconds, and most faults end sooner: shorter spells need nobody."""


class InvalidSpell:
    """Of one skin's frames, in their order."""

    def __init__(self) -> None:
        self._since_ns = self._now_ns = 0
        self._reasons: list[str] = []

    def __call__(self, valid: bool, reasons: Sequence[str], sample_ns: int) -> None:
        """Take note of a frame. sample_ns: when it was measured."""
        self._now_ns = sample_ns
        if valid or sample_ns < self._since_ns:
            self._since_ns = 0
        if not valid:
            self._since_ns = self._since_ns or sample_ns
            self._reasons = list(reasons)

    @property
    def problem(self) -> str:
        """Empty while frames are valid, or were not for a few seconds only."""
        lasted = (self._now_ns - self._since_ns) * 1e-9
        if not self._since_ns or lasted < LASTS_S:
            return ""
        said = "; ".join(f"{name} ({REASONS[name]})" for name in self._reasons if name in REASONS)
        return f"no frame has been valid for {lasted:.0f} s: {said or 'no reason is given'}"
