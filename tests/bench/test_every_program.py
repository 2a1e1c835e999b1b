"""Every benchmark as its own parser describes it: numbers that nobody can mean are refused, and --quick is taken."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

import bench
from bench.all import BENCHMARKS
from bench.json_file import write_json  # noqa: F401  (numerical libraries get one thread before they are loaded)
from tests import needs

MODULES = {**bench.commands(), "limits": "models.limits"}
NEEDED = {
    "registered_network": ["presses.npz", "folder"],
    "estimation": ["start"],
    "shadow": ["--candidate", "without-memory"],
}
NUMBERS = ("x", "", "nan", "-1", "-inf", "1.5.2")


class Parsed(BaseException):
    """The command line was accepted; nothing is run."""


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, list[str]], argparse.ArgumentParser]:
    """Has a benchmark read its command line, and returns its parser. SystemExit where it is refused."""
    read = argparse.ArgumentParser.parse_args

    def only(self: argparse.ArgumentParser, argv: Any = None, namespace: Any = None) -> NoReturn:
        read(self, argv, namespace)
        raise Parsed(self)

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", only)

    def call(name: str, arguments: list[str]) -> argparse.ArgumentParser:
        from services.cli import offline

        monkeypatch.setattr(offline, "_dispatch", lambda module, args: importlib.import_module(module).main(args))
        context = argparse.Namespace(args=arguments)
        with pytest.raises(Parsed) as accepted:
            offline.limits(context) if name == "limits" else offline.bench(context, name)  # type: ignore[arg-type]
        parser = accepted.value.args[0]
        assert isinstance(parser, argparse.ArgumentParser)
        return parser

    return call


@pytest.mark.parametrize("name", sorted(MODULES))
def test_numbers_that_nobody_can_mean_are_refused(parse: Any, capsys: pytest.CaptureFixture[str], name: str) -> None:
    if name == "picture":
        needs.PLOTS.here()
    needed = NEEDED.get(name, [])
    parser = parse(name, needed)
    for action in parser._actions:
        if not action.option_strings or not callable(action.type) or isinstance(action.type, type):
            continue  # argparse's own types of numbers let nan and -1 through: none is used
        for value in NUMBERS:
            with pytest.raises(SystemExit) as refused:
                parse(name, [*needed, f"{action.option_strings[-1]}={value}"])
            said = capsys.readouterr().err
            assert refused.value.code == 2 and action.option_strings[-1] in said and "found" in said, (action, value)
    kinds = {action.type for action in parser._actions}
    assert not kinds & {int, float}, "use whole() and real() of models/command.py"


@pytest.mark.parametrize("name", sorted({b.command for b in BENCHMARKS if b.quick is not None}))
def test_each_benchmark_of_the_page_takes_quick(parse: Any, name: str) -> None:
    parse(name, ["--quick"])
