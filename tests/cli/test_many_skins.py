"""`skin up` as a user has it: real processes, two stub skins. $EITSKIN_TRAINED names a bundle for the second."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from protocol.sockets import NewestReader
from services.runtime.config import ConfigError, load
from services.runtime.supervision import programs, stub_arguments
from tests.needs import ROOT
from tests.waiting import WAIT_S, end, until


def two_skins() -> str:
    """skin.toml with the second skin of its comments."""
    text = (ROOT / "skin.toml").read_text(encoding="utf-8")
    (example,) = re.findall(r"^# \[skins\.sole\]\n(?:# \S+ = .*\n)+", text, re.MULTILINE)
    text = text.replace(example, example.replace("# ", ""))
    trained = os.environ.get("EITSKIN_TRAINED")
    return text.replace('"disc16"', f'"{Path(trained).resolve()}"') if trained else text


class Service:
    """The commands of a user who says where the service runs: `call` runs them in this process."""

    def __init__(self, folder: Path, call=None) -> None:
        self.folder, self.call, self.pid = folder, call, 0
        self.readers = {s: NewestReader("contact", s, f"ipc://{folder}/publisher.ipc") for s in ("palm", "sole")}

    def start(self, *words: object, **more) -> subprocess.Popen:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("EITSKIN_RUN")}
        command = [sys.executable, ROOT / "skin", *map(str, words), "--runtime", self.folder]
        return subprocess.Popen(command, cwd="/", env=environment, text=True, **more)

    def skin(self, words: str, code: int | None = 0) -> str:
        """What a command prints: on both streams, where it is to fail."""
        ran = self.call(*shlex.split(words), "--runtime", self.folder)
        assert code in (None, ran.code), (words, ran)
        return ran.out + (ran.err if code else "")

    def json(self, words: str, code: int | None = 0) -> list:
        return [json.loads(line) for line in self.skin(f"{words} --json", code).splitlines()]

    def doctor(self) -> dict[str, tuple[str, str]]:
        return {each["what"]: (each["level"], each["text"]) for each in self.json("doctor", code=None)[0]}


@pytest.fixture(scope="module")
def running():
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as name:
        made = Service(Path(name))
        (made.folder / "two.toml").write_text(two_skins())
        with open(made.folder / "log.txt", "wb") as log:
            process = made.start("up", "--config", made.folder / "two.toml", stdout=log, stderr=log)
            made.pid = process.pid
            try:
                until(lambda: made.readers["sole"].recv(0.5), process)
                # a bundle that cannot tell a touch at the start wants one: docs/operations.md
                assert made.start("tare", "--skin", "sole", "--wait", WAIT_S).wait(2 * WAIT_S) == 0
                for reader in made.readers.values():
                    until(lambda reader=reader: (frame := reader.recv(0.5)) is not None and frame.valid, process)
                yield made
                process.send_signal(signal.SIGINT)  # Ctrl-C is how the service ends
                assert process.wait(WAIT_S) in (0, 130, -signal.SIGINT)
                assert "Traceback" not in (made.folder / "log.txt").read_text()
            finally:
                end(process)
                for reader in made.readers.values():
                    reader.close()


@pytest.fixture
def service(running: Service, skin) -> Service:
    running.call = skin
    return running


@pytest.mark.live
def test_two_skins_feel_their_own_presses_and_doctor_says_what_is_wrong(service: Service) -> None:
    assert "is in use by process" in service.skin("up", 1)
    for name, x in (("palm", 0.02), ("sole", -0.01)):
        service.skin(f"press --x {x} --y 0.01 --force 4 --seconds 600 --skin {name}")
    for name, x in (("palm", 0.02), ("sole", -0.01)):
        *rows, last = service.json(f"compare --skin {name} -n 8 --seconds 60")
        assert last["summary"]["frames"] == 8 and last["summary"]["seen"] >= 4, last
        assert {row["x"] for row in rows} == {x} and last["summary"]["position_error_mm"]["median"] < 20
    (top,) = service.json("top --once --seconds 1.5")
    assert {*top["processes"]} >= {"acquisition", "preprocessing", "inference", "publisher", "stub"}
    assert top["contacts"] and top["topics"]["raw"]["latency_ms"]["p50"] > 0 and top["topics"]["contact"]["rate_hz"] > 5
    assert "1 of your presses released" in service.skin("release --skin sole")
    assert service.json("release")[0]["released"] == 1  # palm, the first, kept its own
    service.skin("fault unplug --seconds 600")
    try:
        until(lambda: (frame := service.readers["palm"].recv(0.5)) is None or not frame.valid)
        found = until(lambda: (found := service.doctor())["palm: acquisition"][0] == "FAIL" and found)
        assert found["palm: port"][0] == "FAIL"  # never both well and ill
        assert "on request, the cable is out; `skin fault --clear` ends it" in found["palm: port"][1]
        assert {found[f"sole: {of}"][0] for of in ("port", "acquisition", "baseline")} == {"OK"}
    finally:
        service.skin("fault --clear")


@pytest.mark.live
@pytest.mark.parametrize("process", ["acquisition", "preprocessing", "inference", "publisher"])
def test_a_process_that_was_stopped_shows_nothing_old_as_fresh(service: Service, process: str) -> None:
    """What pressed goes while it stands: none of its frames of later shows it."""
    reader, seen = service.readers["palm"], []
    children = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
    (pid,) = (int(c) for c in children if f"services.{process}\0" in Path(f"/proc/{c}/cmdline").read_text())
    service.skin("press --x 0.02 --y 0.01 --force 4 --seconds 600 --skin palm")
    until(lambda: (frame := reader.recv(0.5)) is not None and frame.valid and frame.contacts)
    os.kill(pid, signal.SIGSTOP)
    try:
        service.skin("release --skin palm")
        gone_ns = time.monotonic_ns()
        until(lambda: seen.append(reader.recv(0.1)) or time.monotonic_ns() > gone_ns + 15e8)
    finally:
        os.kill(pid, signal.SIGCONT)
    until(lambda: seen.append(reader.recv(0.1)) or sum(f is not None and f.valid for f in seen[-30:]) > 20)
    late = [f for f in seen if f is not None and f.valid and f.stamps["sample"] > gone_ns + 3e8]
    assert late and not [f for f in late if any(contact.state != "end" for contact in f.contacts)]


@pytest.mark.live
@pytest.mark.release
def test_scenes_faults_and_what_the_service_refuses_are_one_skins(service: Service) -> None:
    said = service.skin("scene two --skin sole")
    assert said.startswith("playing two") and "skin release" in said
    assert "sticky, it does not end by itself" in service.skin("fault wrong_chip_id --skin sole")
    assert service.json("fault")[0]["faults"] == {}
    said = service.skin("release --skin sole")
    assert "scene two ended" in said and "faults that go on: wrong_chip_id" in said
    service.skin("fault power_cycle --skin sole")
    until(lambda: not service.json("fault --skin sole")[0]["faults"])
    assert re.search(r"judgements/palm scan +\d+", service.skin("echo judgements -n 1"))
    assert "no skin 'plam'" in service.skin("echo contact --skin plam", 2)
    assert "expected one of palm, sole" in service.skin("scene two --skin plam", 1)
    assert "metres" in service.skin("press --x 5 --y 0 --force 3", 1)


@pytest.mark.live
@pytest.mark.release
def test_the_doctor_names_what_differs_from_what_runs(service: Service) -> None:
    config, changed = service.folder / "two.toml", service.folder / "changed.toml"
    before = config.read_text()
    (service.folder / "palm.json").write_text('{"newtons_per_siemens": 8.5}')
    changed.write_text(before.replace('bundle = "square16"', 'bundle = "disc16"\ncalibration = "palm.json"'))
    for other in (ROOT / "skin.toml", changed):
        said = service.skin(f"doctor --config {shlex.quote(str(other))}")
        assert f"the service runs {config}" in said and "FAIL" not in said and "restart the service:" not in said
    config.write_text(changed.read_text())
    try:
        said = service.skin("doctor", 1)
    finally:
        config.write_text(before)
    assert re.search(r"FAIL +palm: runs +bundle square16 \(\w{12}\), not disc16 \(\w{12}\): restart", said)
    assert re.search(r"FAIL +palm: runs +calibration no calibration, expected .*palm.json", said)


def test_the_supervisor_tells_the_stub_of_each_skin_on_it(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "manifest.json").write_text("{}")

    def told(*skins: str) -> tuple[str, ...]:
        """Of skins, each by port, bundle and what else is said of it."""
        rows = zip("abc", (skin.split(maxsplit=2) + [""] for skin in skins), strict=False)
        text = "".join(f"[skins.{n}]\nport = {port}\nbundle = {b}\n{more}\n" for n, (port, b, more, *_) in rows)
        (tmp_path / "skin.toml").write_text(text)
        config = load(tmp_path / "skin.toml")
        assert [p.arguments for p in programs(config) if p.name == "stub"] in ([], [stub_arguments(config)])
        return stub_arguments(config)

    disc, disc16 = '"stub" "disc16"', ROOT / "models/bundles/disc16"
    mine, both = f"c={tmp_path / 'mine'}", ("--skin", f"a={disc16}", "--skin", f"b={disc16}")
    assert told(disc, '"/dev/ttyACM0" "square16"', '"stub" "mine"') == (*both[:2], "--skin", mine)
    for option, value in (("mismatch", "mild"), ("world", "creep")):
        assert told(disc, f'{disc} {option} = "{value}"') == (*both, f"--{option}", f"b={value}")
        with pytest.raises(ConfigError, match="a real skin"):
            told(f'"/dev/ttyACM0" "disc16" {option} = "{value}"')
    with pytest.raises(ConfigError, match="a world has a sheet of its own"):
        told(f'{disc} world = "creep"\nmismatch = "mild"')
