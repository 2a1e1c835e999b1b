"""Every command and snippet of the documents, run as a newcomer would: empty home, XDG_RUNTIME_DIR set, 80 x 24.

One service for all, started in a copy of the checkout. `-m slow` is what .ci/run adds.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.frames import ContactFrame
from protocol.sockets import ControlClient, NewestReader
from services.runtime.config import load
from tests import needs
from tests.docs.runners import CONFIGS, NOT_RUN, PROGRAMS, SCENES, TRIED_ELSEWHERE, Row, row_for
from tests.docs.snippets import ROOT, Snippet, in_text, snippets
from tests.docs.world import START_S, World, world

pytestmark = pytest.mark.live

CTRL_C = (130, -2)  # exit status, or ended by the signal, which a shell calls 130 too
ALL = snippets()
COMMANDS_SHOWN = [snippet for snippet in ALL if snippet.kind == "command"]


def shown(how: str) -> list[Snippet]:
    """The commands that are run so, each once: `./skin top` in a block is `skin top` in a table."""
    found: dict[str, Snippet] = {}
    for snippet in COMMANDS_SHOWN:
        row = row_for(snippet.text)
        if row is not None and row.how == how:
            found.setdefault(row.instead.replace("{line}", snippet.text) or snippet.text.removeprefix("./"), snippet)
    return list(found.values())


def blocks(kind: str) -> list[Snippet]:
    return [s for s in ALL if s.kind == kind and s.file not in TRIED_ELSEWHERE]


def the_row(snippet: Snippet) -> Row:
    row = row_for(snippet.text)
    assert row is not None
    return row


@contextlib.contextmanager
def serving(place: World, command: str, start_s: float = START_S) -> Iterator[None]:
    """The service, once valid frames come."""
    with place.started(command) as process:
        assert process.stdout is not None
        reader = NewestReader("contact", "palm", f"ipc://{place.folder}/xdg/eitskin/publisher.ipc")
        end = time.monotonic() + start_s
        while (frame := reader.recv(0.5)) is None or not frame.valid:
            assert time.monotonic() < end and process.poll() is None, f"`{command}` gave no valid frames"
        reader.close()
        yield
        process.terminate()
        said, _ = process.communicate(timeout=20)
        assert "Traceback" not in said, said


@pytest.fixture(scope="module")
def place() -> Iterator[World]:
    with world() as made, serving(made, "./skin up"):
        yield made


@pytest.fixture
def untouched(place: World) -> None:
    """Nothing touches, no fault is in force, and the skin says so."""
    client = ControlClient("stub", 10.0, address=f"ipc://{place.folder}/xdg/eitskin/stub.ctl")
    client.call("release")
    client.call("faults", clear=True)
    reader = NewestReader("contact", "palm", f"ipc://{place.folder}/xdg/eitskin/publisher.ipc")
    end = time.monotonic() + 60
    while not (isinstance(frame := reader.recv(1.0), ContactFrame) and frame.valid and not frame.contacts):
        assert time.monotonic() < end, f"the skin did not become untouched: {frame}"
    reader.close()


@pytest.mark.parametrize("snippet", COMMANDS_SHOWN, ids=str)
def test_somebody_thought_of_how_it_is_run(snippet: Snippet) -> None:
    assert row_for(snippet.text), f"{snippet}: nothing says how it is run: add a row to tests/docs/runners.py"


def test_a_new_snippet_is_found_and_missed() -> None:
    text = "Type `skin dance --fast`, or\n```sh\nskin sing   # loudly\n```\nand\n```python\nprint(1)\n```\n"
    found = list(in_text(text))
    assert [(s.kind, s.text, s.line) for s in found] == [
        ("command", "skin sing", 3),
        ("python", "print(1)\n", 7),
        ("command", "skin dance --fast", 1),
    ]
    assert not any(row_for(s.text) for s in found if s.kind == "command")


@pytest.mark.parametrize("snippet", shown("ends"), ids=str)
def test_it_ends_well(place: World, untouched: None, snippet: Snippet) -> None:
    check_end(place, snippet)


def has_what_it_needs(snippet: Snippet) -> None:
    if (need := the_row(snippet).needs) is not None:
        need.here()


def check_end(place: World, snippet: Snippet) -> None:
    row = the_row(snippet)
    has_what_it_needs(snippet)
    command = place.typed(snippet.text, row.instead)
    ran = place.ends(command)
    assert ran.code == row.code and "Traceback" not in ran.out, f"`{command}` exit {ran.code}:\n{ran.out}"
    assert re.search(row.says, ran.out, re.MULTILINE), f"`{command}`: expected {row.says!r}, found\n{ran.out}"


@pytest.mark.parametrize("snippet", shown("runs"), ids=str)
def test_it_runs_until_ctrl_c(place: World, untouched: None, snippet: Snippet) -> None:
    row = the_row(snippet)
    command = place.typed(snippet.text, row.instead)
    for _ in range(3):  # a robot rightly stops where a busy machine loses frames
        ran = place.runs(command, row.says)
        if re.search(row.says, ran.out, re.MULTILINE) and ran.code in (0, *CTRL_C):
            break
    assert re.search(row.says, ran.out, re.MULTILINE), f"`{command}`: expected {row.says!r}, found\n{ran.out}"
    assert ran.code in CTRL_C or "firmware_stub" in command, f"`{command}` exit {ran.code}:\n{ran.out}"
    assert "Traceback" not in ran.out, ran.out


@pytest.mark.release
@pytest.mark.parametrize("snippet", shown("help"), ids=str)
def test_its_program_knows_the_options(place: World, snippet: Snippet) -> None:
    """Benchmarks and training take minutes to hours: .ci/run has them in short form."""
    has_what_it_needs(snippet)
    command = place.typed(snippet.text, "")
    words = command.split()
    options = [word for word in words if word.startswith("--")]
    ran = place.ends(" ".join([*words[: words.index(options[0]) if options else None], "--help"]))
    assert ran.code == 0 and all(option in ran.out for option in options), ran.out


@pytest.mark.parametrize("snippet", shown("ci"), ids=str)
def test_ci_has_the_step(snippet: Snippet) -> None:
    assert re.search(the_row(snippet).says, (ROOT / ".ci" / "run").read_text(encoding="utf-8"))


@pytest.mark.parametrize("snippet", shown("elsewhere"), ids=str)
def test_another_file_tries_it(snippet: Snippet) -> None:
    assert (ROOT / the_row(snippet).says).is_file()


@pytest.mark.parametrize("snippet", blocks("python"), ids=str)
def test_a_program_reads_contacts(place: World, untouched: None, snippet: Snippet) -> None:
    """As an outsider's script: without the checkout on its path, but for the wheel's `eitskin`."""
    known = [p for p in PROGRAMS if p.file == snippet.file and p.marker in snippet.text]
    assert known, f"{snippet}: nothing says how it is run: add a row to tests/docs/runners.py"
    outside, wheel = place.folder / "outside", place.folder / "wheel"
    outside.mkdir(exist_ok=True)
    (outside / "program.py").write_text(snippet.text)
    wheel.mkdir(exist_ok=True)
    if not (wheel / "eitskin").is_symlink():
        (wheel / "eitskin").symlink_to(place.checkout / "protocol")
    python = place.checkout / ".venv" / "bin" / "python"
    with place.started(f"cd {outside} && PYTHONPATH={wheel} exec {python} program.py") as process:
        time.sleep(known[0].seconds)
        alive = process.poll() is None
        process.kill()
        out, _ = process.communicate()
    assert alive and "Traceback" not in out, f"ended within {known[0].seconds:g} s:\n{out}"
    assert len(out.splitlines()) >= known[0].lines, f"printed only, in {known[0].seconds:g} s:\n{out}"


def is_config(snippet: Snippet) -> bool:
    return any(snippet.file == file and marker in snippet.text for file, marker in CONFIGS)


@pytest.mark.parametrize("snippet", [s for s in blocks("toml") if is_config(s)], ids=str)
def test_a_configuration_is_one(tmp_path: Path, snippet: Snippet) -> None:
    (tmp_path / "skin.toml").write_text(snippet.text)
    assert set(load(tmp_path / "skin.toml").skins) == set(re.findall(r"\[skins\.(\S+)\]", snippet.text))


@pytest.mark.parametrize("snippet", [s for s in blocks("toml") if not is_config(s)], ids=str)
def test_a_scene_plays(place: World, untouched: None, snippet: Snippet) -> None:
    assert any(snippet.file == file and marker in snippet.text for file, marker in SCENES), snippet
    file = place.folder / "scene.toml"
    file.write_text(snippet.text)
    ran = place.ends(f"./skin scene {file}")
    assert ran.code == 0 and "playing scene" in ran.out, ran.out


def test_other_blocks_are_nothing_to_run() -> None:
    for snippet in blocks("text"):
        known = any(snippet.file == file and snippet.text.startswith(start) for file, start in NOT_RUN)
        assert known, f"{snippet}: add it to NOT_RUN, or say in its fence what it is"


def test_what_is_tried_elsewhere_is() -> None:
    for document, test in TRIED_ELSEWHERE.items():
        if (ROOT / document).is_file():
            assert document.split("/")[-1] in (ROOT / test).read_text(encoding="utf-8")


@pytest.mark.release
def test_make_up_from_nothing() -> None:
    """The first command of README, in a copy with no virtual environment; what it did not install says so."""
    with world(installed=False) as place, serving(place, "make up", start_s=900):
        assert (place.checkout / ".venv" / ".service").is_file()
        for command in ("./skin press --x 0.02 --y -0.01 --force 3", "./skin compare --seconds 2"):
            ran = place.ends(command)
            assert ran.code == 0, ran.out
        for command, extra in ((".venv/bin/python -m bench.picture", "plots"), ("./skin bench accuracy", "peers")):
            ran = place.ends(command)
            assert ran.code != 0 and f"make venv EXTRAS={extra}" in ran.out and "Traceback" not in ran.out, ran.out


@pytest.mark.release
@pytest.mark.parametrize("snippet", [s for s in shown("slow") if s.text.startswith("g++")], ids=str)
def test_the_cpp_line(place: World, untouched: None, snippet: Snippet) -> None:
    needs.CPP.here()
    row = the_row(snippet)
    ran = place.runs(place.typed(snippet.text, row.instead), row.says)
    assert re.search(row.says, ran.out, re.MULTILINE), ran.out


@pytest.mark.release
def test_what_takes_longer_ends_well() -> None:
    """In the documents' order: one command reads what the one before it wrote."""
    those = [snippet for snippet in shown("slow") if not snippet.text.startswith(("g++", "make up"))]
    for snippet in those:
        has_what_it_needs(snippet)
    with world() as place:
        for snippet in those:
            check_end(place, snippet)
