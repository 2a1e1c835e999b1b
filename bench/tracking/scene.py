"""A scripted scene through the stub board and the host's end of its line in simulated time: raw frames, their truth.

Only the operating system is left out: the board's bytes go through the link's decoder, its state machine and the clock
regression of acquisition (bench/tracking/host.py). What comes out is kept in bench/work, by a hash of
the scene and of the code that made it.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import ROOT, WORK
from bench.tracking.host import Felt, Host
from firmware_stub import scene as scenes
from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Script
from firmware_stub.world import World
from protocol.frames import RawFrame
from services.runtime.config import ScanMode, Skin

MADE_BY = (
    *(f"firmware_stub/{n}.py" for n in ("analog", "board", "faults", "field", "rig", "scene", "sheet", "timeline")),
    *(f"models/{n}.py" for n in ("elements", "forward", "geometry", "meshing", "patterns", "shapes")),
    *(
        f"services/board/{n}.py"
        for n in ("boardlink", "clock", "newest_values", "scan_check", "scan_order", "scanning", "source")
    ),
)
LAYOUT = 2  # of what is kept: raised when Recorded or what fills it changes
KEPT = 6  # recorded scenes
CONTACT_CHANGED = 0.05  # of its impedance within a second: a contact that drifts, not one that ages
ELECTRODE_FAULTS = ("electrode_open", "electrodes_shorted", "electrodes_swapped", "mux_stuck", "mux_disabled")
TOUCHES = ("track", "x", "y", "force", "radius", "area")  # of one true touch; x, y: its area's centroid [m], area [m^2]


@dataclass(frozen=True, eq=False)
class Recorded:
    """N scans that reached the host, or N parts of scans: then each with the newest value of every measurement."""

    z: NDArray[np.complex64]  # (N, K) ohm
    status: NDArray[np.uint8]  # (N, K)
    scan: NDArray[np.int64]  # (N,) the board's number
    seconds: NDArray[np.float64]  # (N,) true middle of the scan since the scene began
    sample_ns: NDArray[np.int64]  # (N,) what the clock regression makes of it
    sigma_ns: NDArray[np.int64]
    read_ns: NDArray[np.int64]
    device_us: NDArray[np.int64]
    gap: NDArray[np.bool_]  # scans are missing just before
    part: NDArray[np.int64]  # (N,) the one measured last, from 1 on; 0: whole scans
    parts: NDArray[np.int64]  # (N,) of a scan
    age_us: NDArray[np.float32]  # (N, K), (N, 0) of whole scans: of each value, when the newest part ended
    new: NDArray[np.uint8]  # (N, K), (N, 0) of whole scans: 1: measured in the newest part
    touches: NDArray[np.float64]  # (M, 1 + len(TOUCHES)): index of the frame, then TOUCHES
    faults: NDArray[np.str_]  # (N,) JSON: electrode faults in force, name -> arguments
    sections: NDArray[np.str_]  # (N,) name of the scene's section

    def __len__(self) -> int:
        return len(self.z)

    def frame(self, k: int, board: str = "stub") -> RawFrame:
        return RawFrame(
            skin="palm",
            scan=int(self.scan[k]),
            stamps={"sample": int(self.sample_ns[k]), "read": int(self.read_ns[k])},
            sample_sigma_ns=int(self.sigma_ns[k]),
            source="stub",
            valid=True,
            reasons=["gap"] if self.gap[k] else [],
            valid_for_s=0.13,
            z=self.z[k],
            status=self.status[k],
            device_us=int(self.device_us[k]),
            board=board,
            part=int(self.part[k]),
            parts=int(self.parts[k]),
            age_us=self.age_us[k],
            new=self.new[k],
        )

    def measured_at(self, k: int, sample_ns: int) -> int:
        """The one of the scan's parts, frame k the last of them, that was measured nearest to a time."""
        first = max(0, k - int(self.parts[k]) + 1)
        return first + int(np.abs(self.sample_ns[first : k + 1] - sample_ns).argmin())

    def only(self, frames: Sequence[int]) -> Recorded:
        """These frames."""
        touches = [[n, *row[1:]] for n, k in enumerate(frames) for row in self._of(k)]
        kept = {f.name: getattr(self, f.name)[list(frames)] for f in fields(self) if f.name != "touches"}
        return Recorded(**kept, touches=np.array(touches).reshape(-1, 1 + len(TOUCHES)))

    def beginning(self, seconds: float) -> Recorded:
        n = int(np.searchsorted(self.seconds, seconds))
        m = int(np.searchsorted(self.touches[:, 0], n))
        cut = {f.name: getattr(self, f.name)[: m if f.name == "touches" else n] for f in fields(self)}
        return Recorded(**cut)

    def truth(self, k: int) -> list[dict[str, float]]:
        """The true touches of frame k."""
        return [dict(zip(TOUCHES, row[1:], strict=True)) for row in self._of(k)]

    def _of(self, k: int) -> NDArray[np.float64]:
        low, high = np.searchsorted(self.touches[:, 0], [k, k + 1])
        return self.touches[low:high]


def record(
    name: str, snr_db: float, seed: int, seconds: float | None = None, scan: ScanMode = "full"
) -> tuple[Recorded, float]:
    """The scene's frames, or those of its beginning, from bench/work where they are there; and the seconds that
    simulating them took.
    """
    path = WORK / f"tracking-{_key(name, snr_db, seed, scan)}.npz"
    if path.is_file():
        with np.load(path) as kept:
            found = Recorded(**{f.name: kept[f.name] for f in fields(Recorded)})
        return (found if seconds is None else found.beginning(seconds)), 0.0
    began = time.perf_counter()
    found = simulate(name, snr_db, seed, seconds, scan=scan)
    if seconds is None:
        WORK.mkdir(parents=True, exist_ok=True)
        for old in sorted(WORK.glob("tracking-*.npz"), key=lambda p: p.stat().st_mtime)[:-KEPT]:
            old.unlink()
        np.savez_compressed(path, **{f.name: getattr(found, f.name) for f in fields(Recorded)})
    return found, time.perf_counter() - began


def simulate(
    name: str,
    snr_db: float,
    seed: int,
    seconds: float | None = None,
    sheet: Sheet | None = None,
    scan: ScanMode = "full",
) -> Recorded:
    """Play a scene (name or path) to its end, or for so many seconds."""
    rig = Rig(sheet or "square16", scene=name, snr_db=snr_db, seed=seed)
    script = rig.field.timeline.script
    recorder = _Recorder(rig, seed, scan)
    end = min(seconds or script.duration, script.duration)
    said = 0.0
    while (now := recorder.host.now) < end:
        recorder.step()
        if now > said + 30:
            said = now
            print(f"simulated {said:.0f} of {end:.0f} s, {rig.field.solves} solves", file=sys.stderr)
    rig.close()
    return recorder.recorded(script)


class _Recorder:
    """What came of a host's steps."""

    def __init__(self, rig: Rig, seed: int, scan: ScanMode) -> None:
        self.rig, self.host = rig, Host(rig, seed, Skin(port="stub", bundle="square16", scan=scan))
        self._felt: list[Felt] = []
        self._frames: list[RawFrame] = []

    def step(self) -> None:
        for frame, felt in self.host.step():
            self._frames.append(frame)
            self._felt.append(felt)

    def recorded(self, script: Script) -> Recorded:
        felt = self._felt
        drifting = _drifting(script, [f.start for f in felt])
        faults = [
            {k: v for k, v in f.faults.items() if k in ELECTRODE_FAULTS} | drifts
            for f, drifts in zip(felt, drifting, strict=True)
        ]
        rows = [row for k, f in enumerate(felt) for row in self._touches(script, k, f.middle, f.world)]
        names = [([name for t, name in script.sections if t <= f.middle] or [""])[-1] for f in felt]

        def column(of: Callable[[RawFrame], object]) -> NDArray[Any]:
            return np.array([of(frame) for frame in self._frames])

        return Recorded(
            z=column(lambda f: f.z),
            status=column(lambda f: f.status),
            scan=column(lambda f: f.scan),
            seconds=np.array([f.middle for f in felt]),
            sample_ns=column(lambda f: f.stamps["sample"]),
            sigma_ns=column(lambda f: f.sample_sigma_ns),
            read_ns=column(lambda f: f.stamps["read"]),
            device_us=column(lambda f: f.device_us),
            gap=column(lambda f: "gap" in f.reasons),
            part=column(lambda f: f.part),
            parts=column(lambda f: f.parts),
            age_us=column(lambda f: f.age_us),
            new=column(lambda f: f.new),
            touches=np.array(rows).reshape(-1, 1 + len(TOUCHES)),
            faults=np.array([json.dumps(f, sort_keys=True) for f in faults]),
            sections=np.array(names),
        )

    def _touches(self, script: Script, k: int, middle: float, world: World) -> list[list[float]]:
        """Rows of `Recorded.touches`: the world lists its touches in the order of the script's tracks."""
        there = [n for n, track in enumerate(script.tracks) if track.times[0] <= middle < track.times[-1]]
        rows = []
        for n, touch in zip(there, world.touches, strict=True):
            if touch.drop > 0:
                shape, scale = self.rig.sheet.shape(touch), self.rig.sheet.skin.metres_per_unit
                x, y = shape.centroid * scale
                rows.append([k, n, x, y, touch.force_n, touch.radius, shape.area * scale**2])
        return rows


def _drifting(script: Script, starts: list[float]) -> list[dict[str, object]]:
    """A contact whose impedance changes fast is a fault too, until it is what it was: for each scan."""
    found: list[dict[str, object]] = [{} for _ in starts]
    for electrode, curve in script.contact:
        well, drifts = 0.0, False  # when it was last known to be right
        for fault, t in zip(found, starts, strict=True):
            drifted, drifts = drifts, abs(curve.value(t, t) / curve.value(well, well) - 1) > CONTACT_CHANGED
            if not drifts:
                well = t if drifted else max(well, t - 1)
            elif electrode is not None:
                fault["contact_drifts"] = {"electrode": electrode}
    return found


def _key(name: str, snr_db: float, seed: int, scan: ScanMode) -> str:
    digest = hashlib.sha256(f"{LAYOUT} {snr_db} {seed} {scan}".encode())
    path = Path(name) if name.endswith(".toml") else scenes.FOLDER / f"{name}.toml"
    for file in (path, *(ROOT / name for name in MADE_BY)):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
