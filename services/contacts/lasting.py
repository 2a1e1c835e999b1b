"""Where frames come with every part of a scan, `begin` and `end` of a contact stay for a while: a reader that takes the
newest frame only, thirty times a second, would miss them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from protocol.frames import Contact

LASTS_NS = 50_000_000


class LastingStates:
    """Of one skin's contacts. Times are `sample` stamps."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._began: dict[int, int] = {}  # when, by id
        self._ended: list[tuple[int, Contact]] = []

    def __call__(self, contacts: Sequence[Contact], now_ns: int) -> list[Contact]:
        """The contacts of a frame, the beginning and the end of the last touches repeated."""
        self._began = {number: at for number, at in self._began.items() if 0 <= now_ns - at < LASTS_NS}
        self._began |= {c.id: now_ns for c in contacts if c.state == "begin" and c.id not in self._began}
        here = {contact.id for contact in contacts}
        self._ended = [each for each in self._ended if 0 <= now_ns - each[0] < LASTS_NS and each[1].id not in here]
        repeated = [contact for _, contact in self._ended]
        self._ended += [(now_ns, contact) for contact in contacts if contact.state == "end"]
        began = [c.state == "hold" and c.id in self._began for c in contacts]
        return [replace(c, state="begin") if b else c for c, b in zip(contacts, began, strict=True)] + repeated

    def state(self) -> dict[str, Any]:
        return {
            "began": [[number, at] for number, at in self._began.items()],
            "ended": [[at, asdict(c)] for at, c in self._ended],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings have none."""
        self._began = {int(number): int(at) for number, at in state.get("began", [])}
        self._ended = [(int(at), Contact(**contact)) for at, contact in state.get("ended", [])]
