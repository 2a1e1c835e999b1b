"""Time questions: the TIME_ASKs that the board is sent, and which of them an answer belongs to. Without I/O."""

from __future__ import annotations

import os

from protocol import link

ASK_EVERY_S = 0.5
ASK_OFTEN_S = 0.1  # while the board's clock is not known well
PATIENCE_S = 0.2  # that a question waits for a moment when nothing is on the line, where answers come soonest
MOST_UNANSWERED = 128  # questions


class TimeQuestions:
    """The time questions of one connection."""

    def __init__(self) -> None:
        self._sent_s: dict[int, float] = {}
        self._due_s = 0.0

    def begin(self, now_s: float) -> None:
        """The board has been started: ask it soon. What was sent before counts no more."""
        self._sent_s.clear()
        self._due_s = now_s

    def to_send(self, now_s: float, well_known: bool, line_busy: bool) -> bytes:
        """Returns the question that is due now, or b""."""
        if now_s < self._due_s or (line_busy and now_s < self._due_s + PATIENCE_S):
            return b""
        self._due_s = now_s + (ASK_EVERY_S if well_known else ASK_OFTEN_S)
        nonce = int.from_bytes(os.urandom(4), "little")  # no answer of an earlier connection is taken for one of this
        self._sent_s[nonce] = now_s
        if len(self._sent_s) > MOST_UNANSWERED:
            self._sent_s.pop(next(iter(self._sent_s)))
        return link.encode(link.TimeAsk(nonce=nonce))

    def sent_s(self, answer: link.Time) -> float | None:
        """Returns when the question that this answers was sent; None for no question of ours."""
        return self._sent_s.pop(answer.nonce, None)
