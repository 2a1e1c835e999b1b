"""Sheet, board and line in one: what is at the other end of a host's cable. Its caller sets the time, at any speed.

rig = Rig("square16", scene="slide", seed=1)
rig.feed(link.encode(link.Hello()), 0.0)
data = rig.pull(0.1)                                  # what the host has received by then
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from protocol.part_size import BAUD
from protocol.scan_setting import COHERENT

from . import scene as scenes
from .analog import Analog, BoardNoise
from .board import Board, MeasuredScan
from .electrode_volts import ElectrodeVolts
from .faults import FAULTS, Faults, messages_of
from .field import Field
from .port import Line
from .sheet import Sheet
from .timeline import Script, Timeline, TouchPath, press_track
from .world import World
from .worlds import table as worlds
from .worlds.nature import REMEMBERED_S

UNTOUCHED = "demo"  # the scene in which nothing touches
FELT_S = 1.0  # a scan that has felt a press ends within so much of the press's end
SLEPT_S = 1.0  # after a longer pause between two calls the machine slept, not the board


class Rig:
    """A stub board on a sheet. Times are seconds since it was made; nothing in here looks at a clock.

    rate_hz: full scans per second instead of the real board's. threaded: solve ahead in a thread (see Field), and skip
    the scans of a pause instead of making up for them. mismatch: see Sheet. world: what the skin does beside, a name of
    worlds/table.py, drawn from `seed`; it has a sheet of its own, unless `geometry` is one. offset_v, wander_v,
    mains_v: see ElectrodeVolts.
    """

    def __init__(
        self,
        geometry: str | Sheet = "square16",
        *,
        mismatch: str = "none",
        scene: str = "demo",
        snr_db: float = 80.0,
        floor_ohm: float = 0.0,
        rate_hz: float | None = None,
        crystal_ppm: float = 12.0,
        baud: int = BAUD,
        seed: int | None = None,
        unique_id: bytes = b"eitskin-stub",
        threaded: bool = False,
        answers_time: bool = True,
        knows_parts: bool = True,
        world: str = "",
        offset_v: float = 0.0,
        wander_v: float = 0.0,
        mains_v: float = 0.0,
    ) -> None:
        script = scenes.load(scene)  # first, since it fails fast
        drawn = int(np.random.default_rng().integers(2**31)) if seed is None else seed
        if isinstance(geometry, Sheet):
            self.sheet = geometry
        else:
            self.sheet = worlds.sheet(world, drawn, geometry) if world else Sheet(geometry, mismatch)
        self.nature = worlds.nature(world, drawn) if world else None
        self.faults = Faults()
        timeline = self.timeline(script, 0.0)
        self.field = Field(self.sheet.transfer, timeline, threaded=threaded)
        self.scans: deque[tuple[MeasuredScan, World, float]] = deque(maxlen=64)
        self.line = Line(baud)
        self._rng = np.random.default_rng(seed)
        self._realtime = threaded
        noise = BoardNoise(10 ** (-snr_db / 20), floor_ohm)
        volts = ElectrodeVolts(self.sheet.electrodes, drawn, offset_v, wander_v, mains_v)
        full_s = len(self.sheet.skin.pattern) * COHERENT.pair_s
        self.board = Board(
            self.field,
            Analog(
                noise,
                self.faults,
                np.random.default_rng(self._rng.integers(2**63)),
                worlds.disturbances(world, drawn, self.sheet) if world else None,
                volts if offset_v or wander_v or mains_v else None,
            ),
            self.faults,
            electrodes=self.sheet.electrodes,
            speed=rate_hz * full_s if rate_hz else 1.0,
            crystal_ppm=crystal_ppm,
            answers_time=answers_time,
            knows_parts=knows_parts,
            unique_id=unique_id,
            on_scan=self._scanned,
        )
        self._waiting: list[tuple[float, bytes]] = []  # messages that come later
        self._unplugged: dict[str, Any] | None = None
        self._then = 0.0
        self._cued = 0.0
        self.field.play(self.field.timeline, 0.0)

    # --- the cable ---

    def feed(self, data: bytes, now: float) -> None:
        """Bytes from the host."""
        if self._unplugged is None:
            self.board.feed(self._noisy(data, now), now)

    def pull(self, now: float) -> bytes:
        """Bytes that reached the host since the last call."""
        self._cues(now)
        if (jump := self.faults.active("clock_jump", now)) is not None:
            self.faults.clear("clock_jump")
            self.board.jump(jump["by"])
        if self._plugging(now):
            return b""
        if self._realtime and now - self._then > SLEPT_S:
            self.board.skip_to(now)
        self._then = now
        self.field.prepare(now)
        sent = []
        for t, message in sorted(self._held_up(self.board.advance(now), now), key=itemgetter(0)):
            sent.append(self.line.pull(t))
            self.line.push(self._cut(message, t), t)
        sent.append(self.line.pull(now))
        return self._noisy(b"".join(sent), now)

    def wake_s(self, now: float) -> float:
        """Seconds until `pull` has something to do."""
        line = self.line.next_s()
        return max(0.0, min(self.board.next_s() - now, 0.25 if line is None else line))

    @property
    def unplugged(self) -> dict[str, Any] | None:
        """The arguments of the unplug under way, None while the cable is in."""
        return self._unplugged

    # --- what is done to the skin ---

    def press(self, values: Mapping[str, Any], now: float) -> dict[str, Any]:
        """Press from now on: what is measured from now on feels it. Keys as in `scene.touch`, and seconds, to_x, to_y;
        `finger`, a name: the press takes the place of the one of that name.

        Raises ValueError for what no skin could feel.
        """
        touch = scenes.touch(values)
        to = (float(values["to_x"]), float(values["to_y"])) if values.get("to_x") is not None else None
        seconds = float(values.get("seconds", 20.0))
        if not 0 < seconds <= 86400:
            raise ValueError(f"a press of {seconds:g} s: expected above 0, up to 86400 s")
        for point in ((touch.x, touch.y), *([to] if to else [])):
            if not self.sheet.inside(*point):
                raise ValueError(
                    f"({point[0]:g}, {point[1]:g}) m is not on the skin, which is {self.sheet.size_text()}"
                )
        old = self.field.timeline
        finger = str(values.get("finger", ""))
        presses = self._lifted(old.presses, finger, now)
        track = press_track(now, seconds, touch, to, finger)
        self.field.play(replace(old, presses=(*presses, track)), now)
        return {
            "x": touch.x,
            "y": touch.y,
            "radius": touch.radius,
            "drop": touch.drop,
            "seconds": seconds,
            "presses": sum(p.times[-1] > now for p in presses) + 1,
        }

    def release(self, now: float, finger: str = "") -> dict[str, Any]:
        """Take every press off and end the scene: nothing touches any more. With `finger`, take off the press of that
        name alone, and go on with the scene. Faults go on.
        """
        old = self.field.timeline
        gone = sum(p.times[-1] > now for p in old.presses if finger in ("", p.finger))
        if finger:
            self.field.play(replace(old, presses=self._lifted(old.presses, finger, now)), now)
            return {"released": gone, "scene_ended": None, "faults": self.faults.listing(now)}
        self.play(UNTOUCHED, now)
        return {
            "released": gone,
            "scene_ended": None if old.script.name == UNTOUCHED else old.script.name,
            "faults": self.faults.listing(now),
        }

    def solve(self, name: str) -> int:
        """Solve every pose of a scene before it is played; returns how many. Raises SceneError, ValueError."""
        return self.field.solve_all(self.timeline(scenes.load(name), 0.0))

    def play(self, name: str, now: float, wait_s: float = 0.0) -> dict[str, Any]:
        """Begin a scene now, or after wait_s seconds. Raises SceneError."""
        timeline = self.timeline(scenes.load(name), now + wait_s)
        self.field.play(timeline, now + wait_s)
        self._cued = now
        script = timeline.script
        return {"scene": script.name, "about": script.about, "seconds": script.duration, "loop": script.loop}

    def fault(self, name: str, args: Mapping[str, Any], now: float, seconds: float = 5.0) -> dict[str, Any]:
        """Let something go wrong, see FAULTS. Raises ValueError."""
        for key, least in (("electrode", 0), ("electrodes", 0), ("second", -1)):  # -1: there is no second one
            given = args.get(key, 0)
            for electrode in given if isinstance(given, list) else [given]:
                if electrode not in range(least, self.sheet.electrodes):
                    raise ValueError(
                        f"fault {name}: electrode {electrode!r}, expected {least} to {self.sheet.electrodes - 1}"
                    )
            if isinstance(given, list) and len(set(given)) < len(given):
                raise ValueError(f"fault {name}: {key} = {given!r}: expected different ones")
        full, row = self.faults.inject(name, args, now, seconds), FAULTS[name]
        return {"fault": name, "args": full, "what": row.what, "sticky": row.sticky, "seconds": seconds}

    def status(self, now: float) -> dict[str, Any]:
        world, faults = self.field.at(now), self.faults.listing(now)
        return {
            "level": "WARN" if faults else "OK",
            "messages": messages_of(faults),
            "scene": self.field.timeline.script.name,
            "touches": len(world.touches),
            "scanning": self.board.scanning,
            "plugged": self._unplugged is None,
            "faults": faults,
            "received": self.board.received,
            "solves": self.field.solves,
            "late_poses": self.field.late,
            "messages_dropped": self.line.dropped,
        }

    def close(self) -> None:
        self.field.close()

    # --- inside ---

    def timeline(self, script: Script, start: float) -> Timeline:
        """A script on this skin."""
        return Timeline(script, start, (), self.sheet.electrodes, self.nature)

    def _lifted(self, presses: tuple[TouchPath, ...], finger: str, now: float) -> tuple[TouchPath, ...]:
        """The presses without what is over, and forgotten. Those of `finger` end now: the scan that goes on has begun
        under them.
        """
        cut = (p.until(now) if finger and p.finger == finger else p for p in presses)
        kept_s = FELT_S if self.nature is None else REMEMBERED_S
        return tuple(p for p in cut if p is not None and p.times[-1] > now - kept_s)

    def _scanned(self, scan: MeasuredScan) -> None:
        """Note what the scan felt: the world at its middle."""
        middle = (scan.start + scan.end) / 2
        self.scans.append((scan, self.field.at(middle), middle))

    def _cues(self, now: float) -> None:
        """Faults that the scene asks for at a time between the last call and this one."""
        timeline = self.field.timeline
        script, before, self._cued = timeline.script, self._cued, now
        for cue in script.cues:
            rounds = math.floor((now - timeline.start - cue.t) / script.duration) if script.loop else 0
            due = timeline.start + cue.t + max(0, rounds) * script.duration
            if before < due <= now:
                self.faults.inject(cue.name, cue.args, now, cue.seconds)

    def _plugging(self, now: float) -> bool:
        """Unplug, plug and power-cycle; True while there is no cable."""
        gone = self.faults.active("unplug", now)
        if gone is not None or self._unplugged is not None:
            if gone is None:
                self.board.power_cycle(now)
            self.line.clear()
            self._waiting.clear()
            self._unplugged = gone
        if self.faults.active("power_cycle", now) is not None:
            self.faults.clear("power_cycle")
            self.line.clear()
            self._waiting.clear()
            self.board.power_cycle(now)
        return self._unplugged is not None

    def _held_up(self, messages: list[tuple[float, bytes]], now: float) -> list[tuple[float, bytes]]:
        """Messages that are due by now: those that come late later, some twice."""
        for t, message in messages:
            late, twice = self.faults.active("late_frames", t), self.faults.active("repeated_frames", t)
            waits = late is not None and self._rng.random() < late["fraction"]
            self._waiting.append((t + late["by"] if late is not None and waits else t, message))
            if twice is not None and self._rng.random() < twice["fraction"]:
                self._waiting.append((t, message))
        due = [each for each in self._waiting if each[0] <= now]
        self._waiting = [each for each in self._waiting if each[0] > now]
        return due

    def _cut(self, message: bytes, now: float) -> bytes:
        fault = self.faults.active("partial_frames", now)
        if fault is not None and self._rng.random() < fault["fraction"]:
            return message[: int(self._rng.integers(1, len(message)))]
        return message

    def _noisy(self, data: bytes, now: float) -> bytes:
        noise = self.faults.active("line_noise", now)
        if noise is None or not data:
            return data
        flipped = np.frombuffer(data, np.uint8).copy()
        bits = self._rng.random((len(data), 8)) < noise["flips"]
        flipped ^= np.packbits(bits, axis=1)[:, 0]
        at = np.sort(self._rng.integers(0, len(data) + 1, self._rng.poisson(noise["garbage"] * len(data))))
        return np.insert(flipped, at, self._rng.integers(0, 256, len(at), np.uint8)).tobytes()
