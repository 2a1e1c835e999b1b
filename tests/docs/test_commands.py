"""README followed as a newcomer would: its commands and programs, beside the service."""

import re
import signal
from concurrent.futures import ThreadPoolExecutor
from subprocess import PIPE, STDOUT

import pytest

from tests.docs.snippets import ROOT, snippets
from tests.docs.world import World, world
from tests.waiting import WAIT_S, end, until

pytestmark = pytest.mark.live

SHOWN = {  # what each command of README prints beside the service; typed shorter, or so that it ends
    "./skin press --x 0.02 --y -0.01 --force 3": ("", "pressing at .* with 3 N for 20 s"),
    "./skin top": ("./skin top --once --seconds 1", "contacts (valid|NOT VALID)"),
    "./skin compare": ("./skin compare --seconds 1", "of [0-9]+ true touches seen"),
    "./skin record touch.mcap --seconds 10": ("./skin record touch.mcap --seconds 1", "contact/palm [0-9]+"),
    "./skin info touch.mcap": ("", "contact/palm +[0-9]+"),
}
# `make up` is how the service is started, node.py a program below; the others: tests/bridges, tests/cli
ELSEWHERE = r"make .*|ros2 .*|\./skin (bench .*|doctor|replay .*)|skin reconstruct|.*node\.py"
# programs that read contacts: file, what is in it, and a line that it prints
PROGRAMS = {"README.md": ("msgpack", r"^\d+ True \["), "docs/clients.md": ("ContactSubscriber", r"^\d+$")}


def test_readme_s_commands_and_the_programs_of_clients_work_beside_the_service() -> None:
    commands = [s.text for s in snippets() if s.file == "README.md" and s.kind == "command"]
    assert {c for c in commands if not re.fullmatch(ELSEWHERE, c)} == {*SHOWN}
    with world(copied=False) as place, place.serving("./skin up") as reader, ThreadPoolExecutor() as at_once:
        until(lambda: (frame := reader.recv(0.5)) is not None and frame.valid)
        (place.folder / "wheel").mkdir()
        (place.folder / "wheel" / "eitskin").symlink_to(ROOT / "protocol")
        programs = [at_once.submit(until, lambda of=of: prints(place, *of)) for of in PROGRAMS.items()]
        press, *others, last = SHOWN.items()
        for shown in ([press], others, [last]):
            said = at_once.map(lambda each: place.ends(each[1][0] or each[0]), shown)
            for (command, (_, says)), found in zip(shown, said, strict=True):
                assert re.search(says, found, re.MULTILINE), f"`{command}`: expected {says!r}, found\n{found}"
        assert all(program.result() for program in programs)


def prints(place: World, file: str, shows: tuple[str, str]) -> bool:
    """As an outsider's script, until Ctrl-C. False: it ended since a busy machine lost frames, as it rightly does."""
    marker, says = shows
    (code,) = (s.text for s in snippets() if s.file == file and s.kind == "python" and marker in s.text)
    (place.checkout / f"{marker}_.py").write_text(code.replace("...  #", "print(frame.seq, flush=True)  #"))
    command, pipes = f"env PYTHONPATH=../wheel .venv/bin/python {marker}_.py", {"stdout": PIPE, "stderr": STDOUT}
    process, said = place.started(command, **pipes), ""
    try:
        while not re.search(says, said, re.MULTILINE):
            said += (line := process.stdout.readline())
            assert line or "Stale" in said, said
            if not line:
                return False
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=WAIT_S)
        return True
    finally:
        end(process)


@pytest.mark.release
def test_make_up_from_nothing() -> None:
    """The first command of README, in a copy with no virtual environment; what it did not install says so."""
    with world(installed=False) as place, place.serving("make up") as reader:
        until(lambda: (frame := reader.recv(0.5)) is not None and frame.valid)
        place.ends("./skin press --x 0.02 --y -0.01 --force 3")
        assert "true touches seen" in place.ends("./skin compare --seconds 2")
        with pytest.raises(AssertionError, match="make venv EXTRAS=plots"):
            place.ends(".venv/bin/python -m bench.picture")
