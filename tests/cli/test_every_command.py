"""Every option of every command, as the app itself lists them, with values that nobody can mean."""

import inspect
import io
from types import UnionType
from typing import get_args, get_origin

import numpy as np
import pytest
import typer

from services.cli.app import app

USUAL = {  # what each command needs to run at all, where no service does; a file `none` is not there
    "up": "--config none.toml",  # one that starts: test_many_skins.py
    "doctor": "",
    "keys new": "robot --folder keys",
    "top": "--once --seconds 0.02",
    "echo": "contact --timeout 0.02",
    "compare": "--seconds 0.02",
    "press": "--x 0 --y 0 --force 1",
    "release": "",
    "scene": "slide",
    "fault": "hang",
    "tare": "--wait 0",
    "record": "made.mcap --seconds 0.02 --overwrite",
    "snapshot": "",
    "replay": "none.mcap",
    "import": "rows.npz imported.mcap --skin square16 --overwrite",
    "info": "none.mcap",
    "golden": "none.mcap",
    "dev same": "--against none",
    "dev numbers": "",
    "dev size": "",
    "export": "none.mcap --csv",
    "calibrate force": "--csv none.csv",
    "bridge": "pge",
    "collect": "presses.npz",
    "new": "q1 --disc 0.1 --out . --overwrite",
    "reconstruct": "none.npz out.npz --skin square16",
    "register": "none.npz --out registered",
}
HANDED_ON = {"limits", "bench"}  # their options are argparse's
BELOW_ZERO = {"--x", "--y", "--to-x", "--to-y", "--first", "--first-electrode"}  # places and angles
NO_NUMBER = ("nan", "-inf", "x", "", "\u0661e")


def parameters(command):
    """(option as it is typed or "", kind of value, place of an argument) of a command, from its signature."""
    place = 0
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        if parameter.annotation is typer.Context:
            continue
        kind, said, *_ = get_args(parameter.annotation)
        if isinstance(kind, UnionType):
            kind = next(each for each in get_args(kind) if each is not type(None))
        kind = get_args(kind)[0] if get_origin(kind) is list else kind
        if isinstance(said, typer.models.ArgumentInfo):
            yield "", kind, place
            place += 1
        else:
            names = [n for n in (said.default, *(said.param_decls or ())) if str(n).startswith("--")]
            yield names[0] if names else "--" + parameter.name.replace("_", "-"), kind, -1


def commands(of, before=""):
    for info in of.registered_commands:
        yield before + (info.name or info.callback.__name__), info.callback
    for group in of.registered_groups:
        yield from commands(group.typer_instance, f"{group.name} ")


COMMANDS = dict(commands(app))
assert COMMANDS.keys() == USUAL.keys() | HANDED_ON, "each command has a usual line"


@pytest.fixture
def answer(skin, tmp_path, monkeypatch):
    """What is not as it should be of the answer to a command line, in ASCII; "" where all is."""
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "rows.npz", measurements=np.ones((2, 120)), untouched=np.ones((8, 120)))

    def complaint(name: str, more: list, named: str) -> str:
        """more: what is added to the usual line, or a value and its place. It must be refused, and name this."""
        usual = USUAL[name].split()
        if isinstance(place := more[0], int):
            rest = usual[place + 1 :] if place < len(usual) and not usual[place].startswith("--") else usual[place:]
            more, usual = [*usual[:place], more[1], *rest], []
        line = [*name.split(), *usual, *more]
        monkeypatch.setattr("sys.stdin", io.StringIO(""))  # commands that go on asking find the end of what is typed
        try:
            ran = skin(*line)
        except AssertionError as why:  # a traceback, or a fault of the program: the fixture looks for them
            return ascii(f"{line}: {why}")
        wrong = ran.code != 2 or named not in ran.err or "found" not in ran.err and line[-1] not in ran.err
        return ascii(f"{line}: {ran.code}: {ran.err[-200:]}") if wrong else ""

    return complaint


@pytest.mark.parametrize("name", USUAL)
def test_what_nobody_can_mean_is_refused(answer, name: str) -> None:
    answers = [answer(name, ["--no-such-option"], "--no-such-option")]
    for option, kind, place in parameters(COMMANDS[name]):
        wrong = NO_NUMBER if kind in (float, int) else ()
        wrong += ("1.5",) if kind is int else ()
        wrong += ("-1",) if wrong and option not in BELOW_ZERO else ()
        answers += [answer(name, [option or place, value], option) for value in wrong]
    assert not (found := [each for each in answers if each]), "\n".join(found)
