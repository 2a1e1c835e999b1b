"""Every command and option of `skin`, as the app itself lists them, with what nobody can mean and with what is only
odd: an answer in time, an exit status, no traceback, and a text that says what was found or expected.
"""

from __future__ import annotations

import inspect
import io
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, UnionType
from typing import Any, NoReturn, get_args, get_origin

import numpy as np
import pytest
import typer

from services.cli.app import app

ANSWER_S = 10.0
K = 120

USUAL: dict[str, tuple[str, ...]] = {
    "up": ("--config", "{folder}/none.toml"),  # one that starts: test_end_to_end.py
    "doctor": (),
    "keys new": ("robot", "--folder", "{folder}/keys"),
    "top": ("--once", "--seconds", "0.02"),
    "echo": ("contact", "--timeout", "0.02"),
    "compare": ("--seconds", "0.02"),
    "press": ("--x", "0", "--y", "0", "--force", "1"),
    "release": (),
    "scene": ("slide",),
    "fault": ("hang",),
    "tare": ("--wait", "0"),
    "record": ("{folder}/made.mcap", "--seconds", "0.02", "--overwrite"),
    "snapshot": (),
    "replay": ("{folder}/none.mcap",),  # one that plays: tests/recording
    "import": ("{folder}/rows.npz", "{folder}/imported.mcap", "--skin", "square16", "--overwrite"),
    "info": ("{folder}/none.mcap",),
    "golden": ("{folder}/none.mcap",),
    "export": ("{folder}/none.mcap", "--csv"),
    "calibrate force": ("--csv", "{folder}/none.csv"),
    "bridge": ("pge",),  # one that runs: tests/bridges
    "collect": ("{folder}/presses.npz",),
    "new": ("q1", "--disc", "0.1", "--out", "{folder}", "--overwrite"),
    "reconstruct": ("{folder}/none.npz", "{folder}/out.npz", "--skin", "square16"),
    "register": ("{folder}/none.npz", "--out", "{folder}/registered"),
}
"""What each command needs to run at all, where no service does. A file `none` is not there: what the command does with
one is tried in test_files_of_every_kind.py.
"""
SLOW = {"new", "record", "import", "doctor", "calibrate force", "collect"}  # each loads, meshes or writes something
FOR_EVER = {("echo", "--timeout", "0"), ("record", "--seconds", "0")}  # as their help says
HANDED_ON = {"limits", "bench"}  # their options are argparse's: test_every_program.py
BELOW_ZERO = {"--x", "--y", "--to-x", "--to-y", "--first", "--first-electrode"}  # places and angles
NO_NUMBER = ("nan", "inf", "-inf", "x", "", "1e999", "\u0661e")
ODD_TEXT = ("", "x" * 300, "\udcff", "\n", "/", "/dev/null", "/no/such/place")


@dataclass(frozen=True)
class Parameter:
    """One of a command. option: how it is typed, "" for an argument; kind: of a value; place: of an argument."""

    option: str
    kind: type
    place: int = -1


def parameters(command: Any) -> Iterator[Parameter]:
    """Those of a command, from its signature."""
    place = 0
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        annotation = parameter.annotation
        if annotation is typer.Context:
            continue
        kind, *said = get_args(annotation)
        if isinstance(kind, UnionType):
            kind = next(each for each in get_args(kind) if each is not type(None))
        if get_origin(kind) is list:
            (kind,) = get_args(kind)
        if isinstance(said[0], typer.models.ArgumentInfo):
            yield Parameter("", kind, place)
            place += 1
        else:
            names = [n for n in (said[0].default, *(said[0].param_decls or ())) if str(n).startswith("--")]
            yield Parameter(names[0] if names else "--" + parameter.name.replace("_", "-"), kind)


def commands(of: typer.Typer, before: str = "") -> Iterator[tuple[str, Any]]:
    """(name, function) of every command of the app, of those in groups too."""
    for info in of.registered_commands:
        assert info.callback is not None
        yield before + (info.name or info.callback.__name__), info.callback
    for group in of.registered_groups:
        if group.typer_instance is not None:
            yield from commands(group.typer_instance, f"{group.name} ")


COMMANDS = dict(commands(app))


def wrong(parameter: Parameter) -> Iterator[str]:
    """Values that nobody can mean: refused, whatever runs or does not."""
    if parameter.kind in (float, int):
        yield from NO_NUMBER
        if parameter.option not in BELOW_ZERO:
            yield "-1"
    if parameter.kind is int:
        yield "1.5"


def odd(parameter: Parameter) -> Iterator[str]:
    """Values that may be meant, or not be there."""
    if parameter.kind in (str, Path):
        yield from ODD_TEXT
    elif parameter.kind in (float, int):
        yield from ("0", "1" + "0" * 30)


def with_value(usual: tuple[str, ...], parameter: Parameter, value: str) -> list[str]:
    """The command line with this value in its place."""
    line = list(usual)
    if parameter.option:
        return [*line, parameter.option, value]
    if parameter.place < len(line) and not line[parameter.place].startswith("--"):
        line[parameter.place] = value
    else:
        line.insert(parameter.place, value)
    return line


def too_long(number: int, frame: FrameType | None) -> NoReturn:
    raise TimeoutError(f"no answer within {ANSWER_S:g} s")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A place to write to; commands that go on asking find the end of what is typed, and none takes for ever."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    np.savez(tmp_path / "rows.npz", measurements=np.ones((2, K)), untouched=np.ones((8, K)))
    before = signal.signal(signal.SIGALRM, too_long)
    others = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield tmp_path
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)
    for number, handler in others:
        signal.signal(number, handler)


def complaint(skin: Any, line: list[str], refused: bool, names: str) -> str:
    """What is not as it should be of the answer to this command line, in ASCII; "" where all is. refused: it must be,
    and name the option.
    """
    return ascii(_complaint(skin, line, refused, names))[1:-1]


def _complaint(skin: Any, line: list[str], refused: bool, names: str) -> str:
    signal.setitimer(signal.ITIMER_REAL, ANSWER_S)
    try:
        ran = skin(*line)
    except AssertionError as why:  # a traceback, or a fault of the program: the fixture looks for them
        return f"{line}: {why}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    said = ran.err.strip()
    if ran.code not in ((2,) if refused else (0, 1, 2, 3)):
        return f"{line}: exit status {ran.code}: {said[-200:]}"
    if ran.code and not said and not ran.out.strip():
        return f"{line}: exit status {ran.code} without a word"
    if refused and names and names not in said:
        return f"{line}: does not name {names}: {said[-200:]}"
    if refused and names and "found" not in said and line[-1] not in said:
        return f"{line}: does not say what was found: {said[-200:]}"
    if ran.code and len(said) > 1000:
        return f"{line}: {len(said)} characters: {said[:200]}"
    return ""


def _none(found: list[str]) -> None:
    if complaints := [each for each in found if each]:
        pytest.fail("\n".join(complaints), pytrace=False)


def test_each_command_is_tried() -> None:
    assert COMMANDS.keys() == USUAL.keys() | HANDED_ON and len(COMMANDS) > 20


@pytest.mark.parametrize("name", USUAL)
def test_what_nobody_can_mean_is_refused(skin, folder, name) -> None:  # type: ignore[no-untyped-def]
    usual = tuple(word.format(folder=folder) for word in USUAL[name])
    found = [
        complaint(skin, [*name.split(), *with_value(usual, parameter, value)], True, parameter.option)
        for parameter in parameters(COMMANDS[name])
        for value in wrong(parameter)
    ]
    found.append(complaint(skin, [*name.split(), *usual, "--no-such-option"], True, "--no-such-option"))
    _none(found)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.release) if n in SLOW else n for n in USUAL])
def test_what_is_odd_is_answered(skin, folder, name) -> None:  # type: ignore[no-untyped-def]
    usual = tuple(word.format(folder=folder) for word in USUAL[name])
    found = [complaint(skin, [*name.split(), *usual], False, "")]
    for parameter in parameters(COMMANDS[name]):
        for value in set(odd(parameter)) - {v for n, option, v in FOR_EVER if (n, option) == (name, parameter.option)}:
            line = [*name.split(), *with_value(usual, parameter, value.format(folder=folder))]
            found.append(complaint(skin, line, False, ""))
        if parameter.kind is bool and parameter.option:
            found.append(complaint(skin, [*name.split(), *usual, parameter.option], False, ""))
    _none(found)
