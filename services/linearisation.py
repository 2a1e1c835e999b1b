"""Which matrices a skin's frames are compared with: its bundle's, or those calibrated to the skin as it is mounted.

Preprocessing fits and adopts, between two frames and only while nothing touches; its frames name what they were made
with, and inference follows. Nothing is ever fitted but after a person's `skin tare`: a start, which may have a hand on
the skin, uses what an earlier tare found, or the bundle as it is.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from models.bundle import Bundle
from models.calibration_file import CalibrationFileError
from services.estimation.initialisation.baseline import Baseline
from services.mounting import MountedSkin, MountingFit, needs_fit, save, saved

log = logging.getLogger(__name__)

UNKNOWN, SELDOM = 3, 20
"""What cannot be found is looked for again at the next UNKNOWN frames, and then at every SELDOM-th: a calibration may
come late, and looking takes as long as reading a megabyte.
"""

REMEMBERED = 16  # calibrations, a megabyte each

_adopted: dict[str, MountedSkin] = {}  # by hash, in this process: the stages of a pipeline share it without a file


class Linearisation:
    """Of one skin. `bundle` is what is in use, `file` the bundle as it was loaded; `name` is "" or the hash of the
    calibrated one.
    """

    def __init__(self, skin: str, file: Bundle) -> None:
        self.skin, self.file = skin, file
        self.mounted: MountedSkin | None = None
        self._fit = MountingFit(file, save_as=skin)
        self._back = False  # to the bundle as it is, as soon as nothing touches
        self._ready: MountedSkin | None = None
        self._missing = ("", 0)

    @property
    def bundle(self) -> Bundle:
        return self.file if self.mounted is None else self.mounted.bundle

    @property
    def name(self) -> str:
        return "" if self.mounted is None else self.mounted.bundle.hash

    @property
    def problem(self) -> str:
        return self._fit.problem

    @property
    def busy(self) -> bool:
        return self._fit.busy or self._ready is not None

    # after a person's tare

    def tared(self, baseline: Baseline) -> bool:
        """A person has said that nothing touches: whether a fit was begun."""
        self._back, self._ready = False, None
        self._fit.stop()
        if needs_fit(baseline, self.file):
            if self.mounted is not None and not needs_fit(baseline, self.bundle):
                return False  # it is mounted as it was
            self._fit.start(baseline)
            return self._fit.busy
        self._back = self.mounted is not None
        return False

    def follows(self, touched: bool) -> bool:
        """Whether another bundle is to be used from the next frame on; `bundle` is that one then. Never waits."""
        self._ready = self._fit.poll() or self._ready
        if touched or not (self._back or self._ready):
            return False
        if self._back:
            save(self.skin, None)
        self._use(self._ready)
        self._back, self._ready = False, None
        return True

    # elsewhere

    def follow(self, name: str) -> bool | None:
        """Use what a frame was made with: whether that is another one than before, None where it cannot be found."""
        if name == self.name:
            return False
        if not name:
            self.mounted = None
            return True
        missing, times = self._missing
        times = times + 1 if missing == name else 1
        self._missing = (name, times)
        if times > UNKNOWN and times % SELDOM:
            return None
        found = _adopted.get(name) or saved(self.skin, self.file)
        if found is None or found.bundle.hash != name:
            return None
        self._missing = ("", 0)
        self._use(found)
        return True

    def restore(self, state: dict[str, Any]) -> bool:
        """At a start, beside a baseline that was saved with a calibration: whether that is in use again."""
        found = saved(self.skin, self.file)
        if found is None or not isinstance(state, dict) or state.get("bundle") != found.bundle.hash:
            return False
        self._use(found)
        return True

    def state(self) -> dict[str, Any]:
        return {} if self.mounted is None else {"calibration": np.frombuffer(self.mounted.packed, np.uint8)}

    def load(self, state: dict[str, Any]) -> bool:
        """Of a recording: whether `bundle` is another one now. One of another bundle is left out."""
        before = self.name
        self._fit.stop()
        self._back, self._ready, self.mounted = False, None, None
        packed = np.asarray(state.get("calibration", ()), np.uint8).tobytes()
        if packed:
            try:
                self._use(MountedSkin(packed, self.file))
            except CalibrationFileError as why:
                log.warning("%s: the state's calibration is not used: %s", self.skin, why)
        return self.name != before

    def _use(self, found: MountedSkin | None) -> None:
        self.mounted = found
        if found is not None:
            _adopted[found.bundle.hash] = found
            while len(_adopted) > REMEMBERED:
                _adopted.pop(next(iter(_adopted)))
