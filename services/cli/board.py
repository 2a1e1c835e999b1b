"""Commands to a running service that return as soon as they are taken: press, scene, fault, release, tare."""

from __future__ import annotations

import json
import time
from typing import Annotated, Any

import typer

from protocol.pause import pause
from services.cli.common import (
    LONGEST_S,
    USAGE,
    CliError,
    JsonOption,
    SkinOption,
    control,
    emit,
    fail,
    of_service,
    skin_name,
)

EARLY = ": wait"  # in a tare's refusal: too few frames came since the start or the last touch, and more will

Metre = Annotated[float, typer.Option(help="Metres in the skin's frame, origin at its centre.")]


def register(app: typer.Typer) -> None:
    for command in (press, release, scene, fault, tare):
        app.command()(of_service(command))


def press(
    x: Metre,
    y: Metre,
    force: Annotated[float, typer.Option(min=0, help="Newtons.")],
    radius: Annotated[float, typer.Option(min=1e-4, help="Metres, of the circumscribed circle.")] = 0.01,
    shape: Annotated[str, typer.Option(help="circle, triangle, rectangle, square, L or hertz.")] = "circle",
    to_x: Annotated[float | None, typer.Option(help="Slide to this x.")] = None,
    to_y: Annotated[float | None, typer.Option(help="Slide to this y.")] = None,
    seconds: Annotated[float, typer.Option(min=0.001, max=LONGEST_S, help="How long the press goes on.")] = 20.0,
    skin: SkinOption = "",
    as_json: JsonOption = False,
) -> None:
    """Press the stub's skin. Returns as soon as the board has accepted it; the press lasts for its seconds."""
    args: dict[str, Any] = {"x": x, "y": y, "force": force, "radius": radius, "shape": shape, "seconds": seconds}
    if (to_x is None) != (to_y is None):
        fail("a slide needs both --to-x and --to-y: found only one of them", USAGE)
    if to_x is not None:
        args |= {"to_x": to_x, "to_y": to_y}
    answer = _stub("press", skin, **args)
    if as_json:
        emit(answer)
    else:
        slide = f" sliding to ({to_x:+.4f}, {to_y:+.4f})" if to_x is not None else ""
        print(f"pressing at ({x:+.4f}, {y:+.4f}) m with {force:g} N{slide} for {seconds:g} s")


def release(skin: SkinOption = "", as_json: JsonOption = False) -> None:
    """Take every press off the stub's skin and end its scene: nothing touches any more. Faults go on."""
    answer = _stub("release", skin)
    if as_json:
        emit(answer)
        return
    ended = f", scene {answer['scene_ended']} ended" if answer["scene_ended"] else ""
    print(f"nothing touches: {answer['released']} of your presses released{ended}")
    if answer["faults"]:
        print(f"faults that go on: {', '.join(answer['faults'])} (`skin fault --clear` ends them)")


def scene(
    name: Annotated[str, typer.Argument(help="A scene of firmware_stub/scenes, or a .toml file.")] = "",
    skin: SkinOption = "",
    as_json: JsonOption = False,
) -> None:
    """Play a scene on the stub's skin; without a name, list the scenes."""
    if not name:
        from services.cli.common import ROOT

        names = sorted(path.stem for path in (ROOT / "firmware_stub" / "scenes").glob("*.toml"))
        emit(names) if as_json else print("\n".join(names))
        return
    if name.endswith(".toml"):
        from pathlib import Path

        name = str(Path(name).resolve())
    answer = _stub("scene", skin, name=name)
    if as_json:
        emit(answer)
        return
    length = f", {answer['seconds']:g} s" if answer["seconds"] else ""
    again = ", again and again" if answer["loop"] else ""
    print(f"playing {answer['scene']}{length}{again}: {answer['about']}; `skin release` ends it")


def fault(
    name: Annotated[str, typer.Argument(help="Which fault; without one, list them.")] = "",
    arguments: Annotated[list[str] | None, typer.Argument(help="key=value, as the list shows them.")] = None,
    seconds: Annotated[float, typer.Option(min=0.001, max=LONGEST_S, help="How long it lasts.")] = 5.0,
    clear: Annotated[bool, typer.Option("--clear", help="End this fault, or all.")] = False,
    skin: SkinOption = "",
    as_json: JsonOption = False,
) -> None:
    """Let something go wrong with the stub board, as on a real one."""
    args: dict[str, Any] = {"name": name, "args": dict(_pair(a) for a in arguments or [])}
    args |= {"seconds": seconds, "clear": clear}
    answer = _stub("faults", skin, **(args if name or clear else {}))
    if as_json:
        emit(answer)
    elif clear:
        left = ", ".join(answer["faults"])
        print(f"faults that go on: {left}" if left else "no fault is in force")
    elif name:
        given = " ".join(f"{key}={value}" for key, value in answer["args"].items() if value != "")
        print(f"{name} {given}".rstrip() + f": {answer['what']}")
        if name != "power_cycle":  # which happens at once
            print(f"{_lasts(answer)}, or until `skin fault {name} --clear`")
    else:
        _print_known(answer)


def _print_known(answer: dict[str, Any]) -> None:
    for name, row in answer["known"].items():
        listed = ", ".join(f"{key}={value}" for key, value in row["args"].items())
        sticky = " (sticky)" if row["sticky"] else ""
        print(f"{name:20s} {row['what']}{sticky}" + (f"  [{listed}]" if listed else ""))
    print("A sticky fault lasts until `skin fault power_cycle`; every other one for --seconds.")
    if answer["faults"]:
        print(f"in force now: {', '.join(answer['faults'])}")


def _lasts(answer: dict[str, Any]) -> str:
    if answer["sticky"]:
        return "sticky, it does not end by itself: it lasts until `skin fault power_cycle`"
    return f"it lasts {answer['seconds']:g} s"


def _pair(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals:
        fail(f"found {text!r}, expected key=value (for example electrode=3)", USAGE)
    try:
        return key, json.loads(value)
    except ValueError:
        return key, value


def _stub(command: str, skin: str, **args: Any) -> dict[str, Any]:
    if skin:
        args["skin"] = skin
    return control("stub", command, **args)


def tare(
    force: Annotated[bool, typer.Option("--force", help="Also where it looks touched: nothing touches it.")] = False,
    calibrate: Annotated[
        bool, typer.Option(help="Also fit how the skin is mounted, and use matrices that fit it; takes some seconds.")
    ] = True,
    wait: Annotated[
        float, typer.Option(min=0.0, max=LONGEST_S, help="Seconds to try again for, where too few frames came.")
    ] = 10.0,
    skin: SkinOption = "",
    as_json: JsonOption = False,
) -> None:
    """Take a new baseline from the last seconds, in which nothing touched the skin."""
    name, until = skin_name(skin), time.monotonic() + wait
    while True:
        try:
            answer = control("preprocessing", "tare", skin=name, force=force, calibrate=calibrate, timeout_s=10.0)
            break
        except CliError as why:
            if EARLY not in str(why) or time.monotonic() >= until:
                raise
        pause(0.25)
    if as_json:
        emit(answer)
    else:
        print(f"new baseline from {answer['frames']} frames, {answer['snr_db']:.1f} dB")
        if answer.get("calibrating"):
            print("fitting how the skin is mounted: used once it is found and nothing touches; `skin doctor` says what")
        elif answer.get("problem"):
            print(answer["problem"])
