"""Scenes as TOML files: read, checked, turned into scripts. README.md documents the keys."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from models.pressure import MOST_DROP
from models.shapes import SIMULATED
from protocol.errors import EitskinError

from .timeline import Cue, PiecewiseLinear, Script, TouchPath
from .world import Touch, pressed

FOLDER = Path(__file__).with_name("scenes")
POSE = {f.name for f in fields(Touch)} - {"kind", "drop", "crept"}


class SceneError(EitskinError, ValueError):
    """A scene that cannot be played: says which file, which key, what was found and what is allowed."""


def names() -> list[str]:
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(name: str | Path) -> Script:
    """A shipped scene by name, or any TOML file by its path. Raises SceneError."""
    path = Path(name) if str(name).endswith(".toml") else FOLDER / f"{name}.toml"
    try:
        data = tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise SceneError(f"no scene {str(name)!r}: expected one of {', '.join(names())}, or a .toml file") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: {error}") from None
    try:
        return parse(data, path.stem)
    except (KeyError, TypeError, ValueError) as error:
        what = f"the key {error} is missing" if isinstance(error, KeyError) else error
        raise SceneError(f"{path}: {what}") from None


def parse(data: Mapping[str, Any], name: str = "scene") -> Script:
    known = {"about", "duration", "loop", "touch", "press", "grid", "drift", "fault", "section"}
    if unknown := set(data) - known:
        raise ValueError(f"unknown key {', '.join(sorted(unknown))}: allowed are {', '.join(sorted(known))}")
    tracks = [_track(touch) for touch in data.get("touch", [])]
    tracks += [_press(**press) for press in data.get("press", [])]
    tracks += [track for grid in data.get("grid", []) for track in _grid(**grid)]
    drift = data.get("drift", {})
    loop = bool(data.get("loop", False))
    ends = [track.times[-1] for track in tracks]
    duration = float(data.get("duration", max(ends, default=0.0)))
    if loop and not duration > 0:
        raise ValueError("a loop needs a duration in seconds above 0")
    if loop and max(ends, default=0.0) > duration:
        raise ValueError(f"a touch ends at {max(ends)} s, after the loop's duration of {duration} s")
    return Script(
        name=name,
        about=str(data.get("about", "")),
        tracks=tuple(tracks),
        background=_curve(drift["background"]) if "background" in drift else None,
        contact=tuple((c.get("electrode"), _curve(c["keys"])) for c in drift.get("contact", [])),
        cues=tuple(
            Cue(f["t"], f["name"], dict(f.get("args", {})), f.get("seconds", 5.0)) for f in data.get("fault", [])
        ),
        duration=duration,
        loop=loop,
        sections=tuple((float(s["t"]), str(s["name"])) for s in data.get("section", [])),
    )


def touch(values: Mapping[str, Any]) -> Touch:
    """A touch from keys as in a scene or a `press`: metres and newtons, or `drop` in S/m instead of `force`.

    Raises ValueError for what no skin could feel.
    """
    kind = str(values.get("shape", "circle"))
    if kind not in SIMULATED:
        raise ValueError(f"shape {kind!r}: expected one of {', '.join(SIMULATED)}")
    pose = {key: float(values[key]) for key in POSE if values.get(key) is not None}
    if lacks := sorted({"x", "y"} - pose.keys()):
        raise ValueError(f"position: found no {' and no '.join(lacks)}, expected x and y, in metres")
    if values.get("force") is None and values.get("drop") is None:
        raise ValueError("press needs force (N) or drop (S/m)")
    pose.setdefault("radius", 0.01)
    if not 0 < pose["radius"] <= 0.1:
        raise ValueError(f"radius {pose['radius']:g} m: expected above 0, up to 0.1 m")
    if not pose.get("aspect", 1.0) > 0:
        raise ValueError(f"aspect {pose['aspect']:g}: expected above 0")
    if not all(abs(pose[key]) <= 1 for key in ("x", "y")):
        raise ValueError(f"position ({pose['x']:g}, {pose['y']:g}) m: not on any skin; positions are metres")
    if values.get("drop") is None:
        return _under_force(kind, float(values["force"]), pose)
    drop = float(values["drop"])
    if not 0 <= drop < 1:
        raise ValueError(f"a conductivity drop of {drop:g} S/m: expected 0 to below 1 S/m")
    return Touch(kind=kind, drop=drop, **pose)


def _under_force(kind: str, force_n: float, pose: Mapping[str, float]) -> Touch:
    """Raises ValueError for a force that no foam answers to."""
    made = pressed(kind, force_n=force_n, **pose) if 0 <= force_n < math.inf else None
    if made is None or made.drop >= MOST_DROP:
        most = Touch(kind=kind, drop=MOST_DROP, **pose).force_n
        raise ValueError(
            f"a force of {force_n:g} N: expected 0 to {most:.3g} N on this patch, where the foam conducts no more"
        )
    return made


def _track(values: Mapping[str, Any]) -> TouchPath:
    """Keys inherit what the touch, or the key before them, says."""
    state = {key: value for key, value in values.items() if key != "keys"}
    times, poses = [], []
    for key in values["keys"]:
        state.update(key)
        times.append(float(state["t"]))
        poses.append(touch(state))
    if len(times) < 2 or times[0] < 0 or sorted(times) != times or times[0] == times[-1]:
        raise ValueError(f"a touch's keys at {times}: expected at least two times, from 0 on, not decreasing")
    return TouchPath(tuple(times), tuple(poses))


def _press(*, t: float, seconds: float, force: float, ramp: float = 0.15, **pose: Any) -> TouchPath:
    """The short form of a touch: there for `seconds` from `t` on, its two ramps included; may slide to to_x, to_y."""
    to = {key.removeprefix("to_"): pose.pop(key) for key in ("to_x", "to_y") if key in pose}
    end = round(t + seconds, 6)
    keys = [{"t": t, "force": 0.0}, {"t": t + ramp, "force": force}, {"t": end - ramp, **to}, {"t": end, "force": 0.0}]
    return _track({**pose, "keys": keys})


def _curve(keys: list[Mapping[str, float]]) -> PiecewiseLinear:
    times = tuple(float(key["t"]) for key in keys)
    if not keys or list(times) != sorted(times):
        raise ValueError(f"drift keys at {times}: expected times that do not decrease")
    return PiecewiseLinear(times, tuple(float(key["value"]) for key in keys))


def _grid(
    *, count: int, spacing: float, forces: list[float], seconds: float, pause: float, ramp: float = 0.1, **pose: Any
) -> Iterator[TouchPath]:
    """An indenter on count x count positions, from the top left row by row, every force at each before the next."""
    t = pause
    half = (count - 1) / 2
    for k in range(count * count):
        x, y = (k % count - half) * spacing, (half - k // count) * spacing
        for force in forces:
            common = {**pose, "x": x, "y": y}
            level = [(0.0, 0.0), (ramp, force), (seconds - ramp, force), (seconds, 0.0)]
            keys = [{"t": round(t + dt, 6), "force": f} for dt, f in level]
            yield _track({**common, "keys": keys})
            t += seconds + pause
