"""Every command that a process takes, with the type of each of its arguments.

`protocol/control.py:ControlServer` checks a request against this table before anything is carried out: the command
line, the page, ROS, Foxglove and clients all come through there. No text is taken for true, and no bool for a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from .fields import Bool, Check, FieldError, Float, Int, Text


@dataclass(frozen=True)
class Content(Check):
    """A map from text to anything, which whoever carries the command out reads."""

    def decode(self, value: Any) -> dict[str, Any]:
        if type(value) is dict and all(type(key) is str for key in value):
            return value
        raise self.refuse(value)

    def describe(self) -> str:
        return "map"


@dataclass(frozen=True)
class Argument:
    """One argument. nil (None) stands for an argument that is not given."""

    check: Check
    doc: str
    needed: bool = False


@dataclass(frozen=True)
class Command:
    """What a command is for, and its arguments by name. by: the processes that take it."""

    by: str
    doc: str
    arguments: Mapping[str, Argument] = field(default_factory=dict)


_SKIN = {"skin": Argument(Text(64), "which skin; not given: the first that is configured")}
_FAULT = Command(
    "stub",
    "let something go wrong as on a real board; without `name`, say what can",
    {
        **_SKIN,
        "name": Argument(Text(), "which fault"),
        "args": Argument(Content(), "its own arguments"),
        "seconds": Argument(Float(unit="s"), "how long it lasts; not given: 5"),
        "clear": Argument(Bool(), "end this fault; without `name`, all"),
    },
)

COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "clock": Command("every process", "the process's monotonic clock, and its host"),
        "status": Command("every process", "how it does", _SKIN),
        "state": Command("stages", "the temporal state of a stage, for a recording", _SKIN),
        "load": Command(
            "stages",
            "take over a state",
            {**_SKIN, "state": Argument(Content(), "as the command `state` gives it", needed=True)},
        ),
        "reset": Command(
            "stages",
            "forget all temporal state",
            {**_SKIN, "new_session": Argument(Bool(), "also begin a session, whose frames count from 0")},
        ),
        "tare": Command(
            "preprocessing",
            "take a new baseline from the last seconds, in which nothing touched the skin",
            {
                **_SKIN,
                "force": Argument(Bool(), "also where it looks touched"),
                "calibrate": Argument(Bool(), "also fit how the skin is mounted; not given: true"),
            },
        ),
        "part": Command(
            "preprocessing",
            "whether a part of a scan was handed on; a replay asks",
            {**_SKIN, "scan": Argument(Int(-1), "the part's number", needed=True)},
        ),
        "record": Command(
            "recorder",
            "begin or end a recording",
            {"on": Argument(Bool(), "true begins one, false ends it", needed=True)},
        ),
        "snapshot": Command(
            "recorder",
            "write the last seconds and the next ones to a file",
            {
                "before_s": Argument(Float(unit="s"), "so many of the last; not given: all that are kept"),
                "after_s": Argument(Float(unit="s"), "and so many from now on; not given: as configured"),
                "why": Argument(Text(4096), "a word on it, kept in the file"),
            },
        ),
        "press": Command(
            "stub",
            "press the stub's skin",
            {
                **_SKIN,
                "x": Argument(Float(unit="m"), "place, from the skin's centre", needed=True),
                "y": Argument(Float(unit="m"), "place, from the skin's centre", needed=True),
                "force": Argument(Float(unit="N"), "this, or `drop`, is needed"),
                "drop": Argument(Float(unit="S/m"), "conductivity drop instead of a force"),
                "radius": Argument(Float(unit="m"), "of the circumscribed circle; not given: 0.01"),
                "aspect": Argument(Float(), "of a rectangle, its length to its width; not given: 1"),
                "rotation": Argument(Float(unit="rad"), "of the shape"),
                "shape": Argument(Text(), "circle, triangle, rectangle, square, L or hertz"),
                "to_x": Argument(Float(unit="m"), "with `to_y`: slide there"),
                "to_y": Argument(Float(unit="m"), "with `to_x`: slide there"),
                "seconds": Argument(Float(unit="s"), "how long it lasts; not given: 20"),
                "finger": Argument(Text(), "a name: the press takes the place of the one of that name"),
            },
        ),
        "release": Command(
            "stub",
            "take every press off and end the scene",
            {**_SKIN, "finger": Argument(Text(), "take off the press of that name alone")},
        ),
        "scene": Command(
            "stub",
            "play a scene; without `name`, list them",
            {
                **_SKIN,
                "name": Argument(Text(4096), "a scene's name, or a .toml file"),
                "solved": Argument(Bool(), "solve all its poses first"),
            },
        ),
        "fault": _FAULT,
        "faults": _FAULT,
    }
)


class BadArgument(FieldError):
    """An argument is missing, unknown, or not of its type; the text says what was found and what is expected."""

    def __init__(self, command: str, found: str, expected: str, argument: str = "") -> None:
        super().__init__(found, expected, argument)
        what = f"{command}, argument {argument}" if argument else command
        self.message = f"{what}: found {found}, expected {expected}"

    def __str__(self) -> str:
        return self.message


def checked(name: str, command: Command, given: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a command as they may be used, those that are nil left out. Raises BadArgument."""
    known = command.arguments
    if unknown := sorted(str(key)[:40] for key in given.keys() - known.keys()):
        raise BadArgument(name, f"the argument {', '.join(unknown[:4])}", _some_of(known))
    found: dict[str, Any] = {}
    for key, argument in known.items():
        if (value := given.get(key)) is not None:
            found[key] = _value(name, key, argument, value)
        elif argument.needed:
            raise BadArgument(name, "none", f"{_words(argument)}: {argument.doc}", key)
    return found


def _value(name: str, key: str, argument: Argument, value: Any) -> Any:
    try:
        decoded = argument.check.decode(value)
    except (FieldError, OverflowError):  # an int may be larger than any float
        decoded = None
    if decoded is None or not argument.check.finite(decoded):
        bad = argument.check.refuse(value)
        raise BadArgument(name, bad.found, f"{_words(argument)}: {argument.doc}", key)
    return decoded


def _some_of(known: Mapping[str, Argument]) -> str:
    return f"only {', '.join(known)}" if known else "no argument"


def _words(argument: Argument) -> str:
    """The type as a person says it."""
    check = argument.check
    words = {Bool: "true or false", Float: "a finite number", Int: "a whole number"}.get(type(check), check.describe())
    return f"{words} ({check.unit})" if check.unit else words
