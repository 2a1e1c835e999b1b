"""The stages' state, asked for while they run: a replay begins from it."""

from __future__ import annotations

import logging
import threading
from typing import Any, Literal

import msgpack

from protocol.control import ControlClient, ControlError
from services.runtime.stage import STAGES

TIMEOUT_S = 0.5
MOST_WAITING = 64

Purpose = Literal["file", "tare", "ring"]
"""What for: a file begins, a new baseline was taken, or so that a snapshot may begin there."""

log = logging.getLogger(__name__)


class StateReader:
    """Asks on a thread of its own, so that a silent stage holds up no message."""

    def __init__(self) -> None:
        self._asked: list[tuple[str, Purpose]] = []
        self._answers: list[tuple[str, Purpose, bytes]] = []
        self._lock = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="states", daemon=True)
        self._thread.start()

    def ask(self, skin: str, purpose: Purpose) -> None:
        with self._lock:
            if (skin, purpose) not in self._asked and len(self._asked) < MOST_WAITING:
                self._asked.append((skin, purpose))
                self._lock.notify()

    def answers(self) -> list[tuple[str, Purpose, bytes]]:
        """(skin, what for, msgpack map process -> state) not yet taken."""
        with self._lock:
            found, self._answers = self._answers, []
        return found

    def _run(self) -> None:
        while True:
            with self._lock:
                while not self._asked and not self._closing:
                    self._lock.wait()
                if self._closing:
                    return
                skin, purpose = self._asked.pop(0)
            packed: bytes = msgpack.packb(stage_states(skin, logging.DEBUG if purpose == "ring" else logging.WARNING))
            with self._lock:
                self._answers.append((skin, purpose, packed))

    def close(self) -> None:
        with self._lock:
            self._closing = True
            self._lock.notify()
        self._thread.join(len(STAGES) * TIMEOUT_S + 0.5)


def stage_states(skin: str, level: int = logging.WARNING) -> dict[str, Any]:
    """process -> state, of the stages that answer, as their control command `state` gives it."""
    found: dict[str, Any] = {}
    for process in STAGES:
        try:
            found[process] = ControlClient(process, TIMEOUT_S).call("state", skin=skin)["state"]
        except (ControlError, KeyError) as error:
            log.log(level, "the state of %s is not in the recording: %s", process, error)
    return found
