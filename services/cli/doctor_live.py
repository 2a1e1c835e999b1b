"""What `skin doctor` asks a service that runs: whether frames flow, and whether it runs what the files say now."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.advice import ADVICE
from protocol.frame_types import REASONS
from protocol.frames import ContactFrame, InfoFrame, RawFrame
from protocol.runtime import CONFIG_LINK, AlreadyRunning, lock, runtime_dir
from protocol.sockets import AllReader, ControlClient, ControlError, NewestReader
from services.cli.judged import judgements, turned
from services.estimation.initialisation.baseline import TAKING
from services.runtime.config import Skin
from services.runtime.stage import HARMLESS, PROCESSES

ANSWER_S = 1.0
FRAME_S = 1.5
BASELINE_S = 4.0  # at most: the first baseline takes three, in which every frame says stale_baseline
JUDGED_S = 1.0  # to judgements, where contact frames have reasons
LISTEN_S = 3.0  # to contact frames: what is judged is the skin as it is, not a moment of it
WELL, BADLY = 0.95, 0.5
"""Share of valid frames: less than the first is warned of, less than the second stops whoever acts on contacts."""


@dataclass(frozen=True)
class Finding:
    """One line: `level` OK, WARN, FAIL or SKIP (not looked at); what was looked at; what was found and what to do."""

    level: str
    what: str
    text: str

    def __str__(self) -> str:
        return f"{self.level:4s}  {self.what:21s} {self.text}"

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def running() -> bool:
    """Whether `skin up` holds the runtime folder, or a process answers there without it (containers)."""
    try:
        with lock():
            pass
    except AlreadyRunning:
        return True
    if not (runtime_dir() / "acquisition.ctl").exists():
        return False
    with contextlib.suppress(ControlError):
        ControlClient("acquisition", ANSWER_S).call("clock")
        return True
    return False


def another(path: Path) -> Path | None:
    """The configuration that the service runs, where that is not this one."""
    link = runtime_dir() / CONFIG_LINK
    theirs = link.readlink() if link.is_symlink() else None
    return None if theirs == path.resolve() else theirs


def configuration(path: Path) -> Iterator[Finding]:
    """Whether the service runs this configuration, as it stands now."""
    link = runtime_dir() / CONFIG_LINK
    if (theirs := another(path)) is not None:
        text = f"the service runs {theirs}, this is {path}: leave --config away, or restart the service with it"
        yield Finding("WARN", "configuration", text)
    elif link.is_symlink() and path.stat().st_mtime > link.lstat().st_mtime:
        yield Finding("WARN", "configuration", f"{path} was changed since the service started: restart the service")


def port(name: str, skin: Skin) -> Iterator[Finding]:
    """The port, as acquisition finds it; of the stub, first what somebody has let go wrong with it."""
    what = "the stub board" if skin.port == "stub" else skin.port
    problem = _status("acquisition", name)
    if skin.port == "stub" and (stub := _status("stub", name)).level == "WARN":
        level = "FAIL" if problem.level == "FAIL" else "WARN"
        yield Finding(level, f"{name}: port", f"{what}: {stub.text}; `skin fault --clear` ends it")
    elif problem.level == "FAIL":
        yield Finding("FAIL", f"{name}: port", problem.text if what in problem.text else f"{what}: {problem.text}")
    else:
        yield Finding("OK", f"{name}: port", f"{what}, in use by the service")


def processes(name: str) -> Iterator[Finding]:
    """How each process does with this skin. They are asked at the same time: four that are dead cost one wait."""
    with ThreadPoolExecutor(len(PROCESSES)) as pool:
        yield from pool.map(lambda process: _status(process, name), PROCESSES)
    reader = NewestReader("raw", name)
    frame = reader.recv(FRAME_S)
    reader.close()
    if isinstance(frame, RawFrame):
        known = f"sample times known to {frame.sample_sigma_ns / 1e6:.2f} ms"
        level = "WARN" if "clock" in frame.reasons else "OK"
        text = f"{len(frame.z)} measurements from board {frame.board or frame.source}, {known}"
        yield Finding(level, f"{name}: frames", text)
    else:
        yield Finding("FAIL", f"{name}: frames", f"no raw frame came within {FRAME_S:g} s: see the lines above")


def wait_for_baseline(name: str) -> None:
    """While the first baseline is being taken, wait: until then no frame is valid, and nothing is the matter."""
    end, before = time.monotonic() + BASELINE_S, ""
    while time.monotonic() < end:
        said = _status("preprocessing", name).text
        if TAKING not in said or said == before:  # taken, or it does not come on: no board, a touch
            return
        before = said
        time.sleep(1.0)  # twenty frames


def contacts(name: str) -> Iterator[Finding]:
    """Whether contact frames may be acted on, and which judgements turned where frames have reasons."""
    reader, frames = AllReader(["contact"], name), list[ContactFrame]()
    end = time.monotonic() + LISTEN_S
    try:
        while (left := end - time.monotonic()) > 0:
            frame = reader.recv(left)
            if isinstance(frame, ContactFrame):
                frames.append(frame)
    finally:
        reader.close()
    yield from validity(name, frames)
    if any(not frame.valid or not HARMLESS.issuperset(frame.reasons) for frame in frames):
        level = validity_level(frames)
        for check, numbers in turned(judgements(name, JUDGED_S)).items():
            yield Finding(level, f"{name}: judged", f"{check}: {numbers}")


def validity_level(frames: Sequence[ContactFrame]) -> str:
    """By the share of valid frames."""
    share = sum(frame.valid for frame in frames) / len(frames)
    return "OK" if share >= WELL else "WARN" if share >= BADLY else "FAIL"


def validity(name: str, frames: Sequence[ContactFrame]) -> Iterator[Finding]:
    """The share of frames that is valid, and why the others are not, the most frequent reason first."""
    what, total = f"{name}: contacts", len(frames)
    if not total:
        yield Finding("FAIL", what, f"no contact frame came within {LISTEN_S:g} s: see the lines above")
        return
    level, valid = validity_level(frames), sum(frame.valid for frame in frames)
    text = f"{valid} of {total} frames of {LISTEN_S:g} s are valid ({100 * valid / total:.0f} %)"
    yield Finding(level, what, text)
    if level == "OK":
        return
    unwell = (set(frame.reasons) or {"no reason"} for frame in frames if not frame.valid)
    for reason, times in Counter(itertools.chain.from_iterable(unwell)).most_common():
        meaning, todo = REASONS.get(reason, ""), ADVICE.get(reason, "")
        yield Finding(level, f"{name}: not valid", f"{reason} in {times} of {total}: {meaning}. {todo}".rstrip(": ."))


def _status(process: str, name: str) -> Finding:
    what = f"{name}: {process}"
    try:
        status = ControlClient(process, ANSWER_S).call("status", skin=name)
    except ControlError as why:
        return Finding("FAIL", what, str(why))
    level = {"OK": "OK", "WARN": "WARN"}.get(str(status.get("level")), "FAIL")
    return Finding(level, what, "; ".join(status.get("messages", [])) or "frames flow")


def info(name: str) -> dict[str, Any]:
    """What info/<skin> says, with a baseline where one comes in time; empty where it says nothing."""
    reader = AllReader(["info"], name)
    end, found = time.monotonic() + FRAME_S, dict[str, Any]()
    try:
        while (left := end - time.monotonic()) > 0 and "baseline" not in found:
            frame = reader.recv(left)
            if isinstance(frame, InfoFrame):
                found = frame.info
    finally:
        reader.close()
    return found


def baseline(info: dict[str, Any]) -> NDArray[np.float64] | None:
    return np.array(info["baseline"], dtype=float) if "baseline" in info else None


def compared(name: str, skin: Skin, bundle: Bundle, info: dict[str, Any]) -> Iterator[Finding]:
    """What the service runs (info/<skin>) against the files as they are now."""
    what = f"{name}: runs"
    if not info:
        yield Finding("FAIL", what, f"no info/{name} came within {FRAME_S:g} s: does preprocessing run?")
        return
    # A bundle that was calibrated to the skin has a hash of its own, and says which it was made of.
    loaded = info.get("mounting", info).get("bundle_hash")
    if loaded != bundle.hash:
        theirs = f"{info.get('bundle')} ({str(loaded)[:12]})"
        yield Finding("FAIL", what, f"bundle {theirs}, not {bundle.name} ({bundle.hash[:12]}): restart the service")
    file = skin.calibration
    ours = hashlib.sha256(file.read_bytes()).hexdigest() if file is not None and file.is_file() else None
    if info.get("calibration_hash") != ours:
        found = str(info.get("calibration_hash") or "no calibration")[:14]
        expected = f"{file} ({ours[:12]})" if ours else "none, as configured now"
        yield Finding("FAIL", what, f"calibration {found}, expected {expected}: restart the service")
    if "baseline" not in info:
        yield Finding("WARN", f"{name}: baseline", "none yet: nothing may touch the skin for some seconds")
        return
    tare = info.get("tare", {})
    said = f"{str(info.get('baseline_hash'))[:12]}, {tare.get('frames')} frames, by {tare.get('taken_by')}"
    if tare.get("bundle_hash") not in (None, info.get("bundle_hash")):
        yield Finding("FAIL", f"{name}: baseline", f"{said}: of another bundle; free the skin and run `skin tare`")
    elif tare.get("doubt"):
        yield Finding("WARN", f"{name}: baseline", f"{said}; in doubt: {tare['doubt']}")
    else:
        yield Finding("OK", f"{name}: baseline", said)
