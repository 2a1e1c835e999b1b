"""Contacts by callback, from a thread of their own.

with ContactListener("palm", on_frame=act, on_stale=lambda why: robot.stop()):
    ...
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from types import TracebackType

from .client import ContactSubscriber
from .frames import ContactFrame
from .freshness import Stale

log = logging.getLogger(__name__)


class ContactListener:
    """Calls `on_frame` with each new valid frame, also when nothing touches, and `on_stale` for each frame that is
    not valid (NotValid) and for every `max_age` seconds of silence: one of them at least every `max_age` seconds.
    Unless given, that is how long the newest frame was valid for (0.25 s of the demo; 1 s for the first frame).

    Begins at once; ends with `close`. Both are called from one background thread, one at a time, and should return
    within a frame's time: meanwhile newer frames overtake older ones.

    An exception in `on_frame` is logged and ends the calls of it: a controller that failed is not trusted to go on.
    From then on `on_stale` is called instead, with the exception as its `__cause__`, and `close` (or the end of the
    `with`) raises it. An exception in `on_stale` is logged and raised in the same way; the calls of it go on.
    """

    def __init__(
        self,
        skin: str,
        on_frame: Callable[[ContactFrame], object],
        on_stale: Callable[[Stale], object],
        max_age: float | None = None,
        endpoint: str | None = None,
        *,
        replay: bool = False,
    ) -> None:
        self._on_frame, self._on_stale, self._max_age = on_frame, on_stale, max_age
        self._subscriber = ContactSubscriber(skin, endpoint, replay=replay)
        self.error: BaseException | None = None
        """The first exception that a callback raised."""
        self._failed: Stale | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"contacts of {skin}", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            self._subscriber.run(self._frame, self._stale, self._max_age, self._stop)
        except BaseException as fault:  # of the client itself: still nobody may think that all is well
            log.exception("the contact listener ended")
            self._keep(fault)
            self._stale(_failure("the contact listener ended", fault))
        finally:
            self._subscriber.close()

    def _frame(self, frame: ContactFrame) -> None:
        if self._failed is not None:
            self._stale(self._failed)
            return
        try:
            self._on_frame(frame)
        except BaseException as fault:
            log.exception("on_frame failed at frame %d: it is not called again", frame.seq)
            self._keep(fault)
            self._failed = _failure("on_frame failed and is not called again", fault)
            self._stale(self._failed)

    def _stale(self, why: Stale) -> None:
        try:
            self._on_stale(self._failed or why)
        except BaseException as fault:
            log.exception("on_stale failed")
            self._keep(fault)

    def _keep(self, fault: BaseException) -> None:
        if self.error is None:
            self.error = fault

    def close(self) -> None:
        """End the calls and wait for the last one. Raises the first exception that a callback raised."""
        self._stop.set()
        if threading.current_thread() is self._thread:  # called by a callback, which cannot wait for itself
            return
        self._thread.join()
        if self.error is not None:
            error, self.error = self.error, None
            raise error

    def __enter__(self) -> ContactListener:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _failure(what: str, fault: BaseException) -> Stale:
    failure = Stale(f"{what}: {type(fault).__name__}: {fault}")
    failure.__cause__ = fault
    return failure
