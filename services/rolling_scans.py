"""Messages of a scan in parts: which of them preprocessing takes for a whole scan."""

from __future__ import annotations

from typing import Any

from models.bundle import Bundle
from protocol.frames import RawFrame
from services.estimation.rolling import WholeScans, parts_of


class RollingScans:
    """Of one skin. A message has the newest value of every measurement, so each could stand for a whole scan; those
    that share no value with the one before do, so that noise, electrodes and drift are judged as in whole scans.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._parts = parts_of(bundle)
        self._whole = WholeScans()
        self.reset()

    def reset(self) -> None:
        self._whole.last = -1
        self._seen = -1  # scan of the last message

    def due(self, frame: RawFrame, stamps: dict[str, int]) -> bool:
        """Whether the message is to be taken for a whole scan; then `sample` in stamps is set to the mean time of its
        values, for which what is made of it stands.
        """
        if frame.parts == 1:
            return True
        self._seen = frame.scan
        if not self._fits(frame):
            return True  # another skin's: said once a message, as of whole scans
        if not self._whole.due(frame.scan, frame.parts):
            return False
        new = frame.new.astype(bool)
        stamps["sample"] = stamps.get("sample", 0) - round(1e3 * float(frame.age_us.mean() - frame.age_us[new].mean()))
        return True

    def handed_on(self, scan: int) -> dict[str, bool]:
        """Whether the message `scan` was seen, and whether a delta frame was made of it: a replay asks."""
        return {"seen": self._seen == scan, "handed_on": self._whole.last == scan}

    def _fits(self, frame: RawFrame) -> bool:
        count = len(frame.z)
        return frame.parts == self._parts and len(frame.age_us) == len(frame.new) == count and bool(frame.new.any())

    def state(self) -> dict[str, Any]:
        return {"whole": self._whole.last}

    def load(self, state: dict[str, Any]) -> None:
        self._whole.last = int(state.get("whole", -1))
