"""How this very skin is mounted, found from its untouched baseline. The fit runs beside the service, in a process of
its own; what it finds is kept in the runtime folder and adopted between two frames.

    person: skin tare --> preprocessing --> python -m models.fit_calibration   (niced, seconds)
                               |<--------------------- packed calibration
    delta frames name it  --> inference takes the same piece, so that image and data agree
"""

from __future__ import annotations

import importlib.util
import logging
import subprocess
import sys
import tempfile
from pathlib import Path
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.calibration_file import CalibrationFileError, unpack
from models.files import FileError, read_bytes
from models.measurement.tables import SkinTables, skin_tables
from protocol.errors import in_words
from services.estimation.initialisation.baseline import Baseline, implausibility
from services.runtime import persistence
from services.runtime.config import ROOT

Array = NDArray[np.float64]

KEPT_AS = "calibration"  # name of the kept state, beside preprocessing's
MOST_BYTES = 16 * 1024 * 1024
LONGEST_S = 600.0  # a fit that somebody waits for, and that takes longer on however busy a machine, has failed
FITS = 3e-4  # rms relative: a bundle that predicts |Z0| so well, up to gain and contacts, is that skin's already

log = logging.getLogger(__name__)


class MountedSkin:
    """A bundle calibrated to one skin, with the packed piece that it was read from."""

    def __init__(self, packed: bytes, bundle: Bundle) -> None:
        """Raises CalibrationFileError."""
        self.packed = packed
        self.bundle = unpack(packed, bundle)
        self.tables: SkinTables | None = None  # held, so that stages need not make them at their first frame


def needs_fit(baseline: Baseline, bundle: Bundle) -> bool:
    """Whether there is anything to find: a measured bundle predicts no |Z0|, a good one predicts this one, and one that
    was registered was measured on this very skin.
    """
    return (
        bundle.locator is None
        and bundle.matrices.normalisation == "model"
        and implausibility(baseline.z0, bundle.prereconstructor()) > FITS
    )


def missing_package() -> str:
    """ "" or why no fit can be made here: the meshes' package comes with the extra `stub`, which a service that only
    measures may lack.
    """
    if importlib.util.find_spec("skfem") is not None:
        return ""
    return (
        "the skin could not be calibrated: scikit-fem is not installed; install requirements/service.lock and run "
        "`skin tare` again"
    )


class MountingFit:
    """One fit at a time, in a process of its own. `poll` never waits."""

    def __init__(self, bundle: Bundle, save_as: str = "") -> None:
        """bundle: as it was loaded, not calibrated. save_as: the skin under whose name what is found is kept."""
        self.bundle, self._save_as = bundle, save_as
        self.problem = ""  # why the last fit gave nothing, for a person
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: Thread | None = None  # of what the process found
        self._found: MountedSkin | None = None

    @property
    def busy(self) -> bool:
        return self._reader is not None

    def start(self, baseline: Baseline) -> None:
        """Begin with the mean of an untouched skin's frames; a fit that is under way is dropped."""
        self.stop()
        self.problem = missing_package()
        if self.problem:
            return
        try:
            folder = tempfile.TemporaryDirectory(prefix="eitskin-fit-", ignore_cleanup_errors=True)
            self._process = self._program(Path(folder.name), baseline)
        except OSError as why:  # no room, no process: the bundle is used as it is
            self.problem = f"the skin could not be calibrated: {in_words(why)}"
            return
        self._reader = Thread(target=self._read, args=(self._process, folder), name="mounting", daemon=True)
        self._reader.start()

    def _program(self, folder: Path, baseline: Baseline) -> subprocess.Popen[bytes]:
        request, out = folder / "request.npz", folder / "out"
        sigma = baseline.sigma / np.sqrt(max(baseline.frames, 1))
        np.savez(request, z0=baseline.z0, sigma=sigma, baseline_hash=np.str_(baseline.hash))
        words = [
            sys.executable,
            "-m",
            "models.fit_calibration",
            str(self.bundle.path.resolve()),
            str(request),
            str(out),
        ]
        with (folder / "output").open("wb") as output:
            return subprocess.Popen(words, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=output)

    def wait(self) -> MountedSkin | None:
        """The same for who has the time: what was found, or None and `problem`."""
        if self._reader is not None:
            self._reader.join(LONGEST_S)
            if self._reader.is_alive():
                self.stop()
                self.problem = f"the skin could not be calibrated: the fit took more than {LONGEST_S:.0f} s"
        return self.poll()

    def poll(self) -> MountedSkin | None:
        """What was found, once, when it is ready to be used."""
        if self._reader is None or self._reader.is_alive():
            return None
        self._process, self._reader = None, None
        found, self._found = self._found, None
        return found

    def stop(self) -> None:
        if self._process is not None and self._reader is not None:
            self._process.kill()
            self._reader.join()
        self._process, self._reader, self._found = None, None, None
        self.problem = ""  # of an earlier tare

    def _read(self, process: subprocess.Popen[bytes], made: tempfile.TemporaryDirectory[str]) -> None:
        """In a thread: what takes a frame's time and more, so that adopting it takes none."""
        folder = Path(made.name)
        try:
            if code := process.wait():
                lines = (folder / "output").read_text(errors="replace").strip().splitlines()
                raise CalibrationFileError(lines[-1] if lines else f"the fit ended with exit code {code}")
            found = MountedSkin(read_bytes(folder / "out", MOST_BYTES), self.bundle)
            if self._save_as:
                save(self._save_as, found)
                read = saved(self._save_as, self.bundle)
                if read is None or read.bundle.hash != found.bundle.hash:  # inference could not follow
                    raise CalibrationFileError("what was found could not be kept in the runtime folder: is it full?")
            found.tables = skin_tables(found.bundle)
            self._found = found
        except (CalibrationFileError, FileError, OSError) as why:
            self.problem = f"the skin could not be calibrated: {in_words(why)}"
        finally:
            made.cleanup()


def save(skin: str, found: MountedSkin | None) -> None:
    """Keep a calibration for the next start; None: that there is none."""
    packed = np.frombuffer(found.packed if found is not None else b"", np.uint8)
    persistence.save(KEPT_AS, skin, {"packed": packed})


def saved(skin: str, bundle: Bundle) -> MountedSkin | None:
    """What `save` saved, where it is this bundle's."""
    found = persistence.restore(KEPT_AS, skin)
    if found is None:
        return None
    try:
        packed = np.asarray(found[0]["packed"], np.uint8).tobytes()
        return MountedSkin(packed, bundle) if packed else None
    except (CalibrationFileError, KeyError, TypeError, ValueError) as why:
        log.warning("%s: the kept calibration is not used: %s", skin, why)
        return None
