"""Acquisition behind a line that holds bytes up, told from outside: what comes late says so.

The stub and acquisition as processes, between them a proxy, and a client of plain zmq and msgpack: none of the two
shares code with the project.
"""

from __future__ import annotations

import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import pytest
import zmq

from tests.board.delaying_proxy import DelayingProxy

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
HALF_SCAN_S = 0.0218  # of 120 measurements at 128 points
LINE_S = 0.0114  # that a full scan takes at 921 600 baud
SLACK_S = 0.1
START_S = 60.0
RIGHT_S = 0.02


@dataclass(frozen=True)
class Got:
    frame: dict
    at_ns: int

    @property
    def age_s(self) -> float:
        """As the frame states it."""
        return (self.at_ns - self.frame["stamps"]["sample"]) * 1e-9

    @property
    def usable(self) -> bool:
        return self.frame.get("valid", False) and self.age_s <= self.frame["valid_for_s"]


class Bench:
    def __init__(self, folder: Path, scan: str) -> None:
        self.scan = scan
        environment = dict(os.environ, EITSKIN_RUNTIME=str(folder), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        self.log = folder / "log.txt"
        stub = [sys.executable, "-m", "firmware_stub", "--listen", "socket://127.0.0.1:0", "--seed", "1"]
        self.processes = [subprocess.Popen(stub, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)]
        line = self.processes[0].stderr.readline()
        assert " at socket://" in line, line
        self.proxy = DelayingProxy(("127.0.0.1", int(line.split(",")[0].rpartition(":")[2])))
        config = folder / "skin.toml"
        port = f"socket://127.0.0.1:{self.proxy.port}"
        config.write_text(f'[skins.palm]\nport = "{port}"\nbundle = "square16"\nscan = "{scan}"\n')
        environment["EITSKIN_CONFIG"] = str(config)
        with open(self.log, "w") as log:
            self.processes.append(
                subprocess.Popen([sys.executable, "-m", "services.acquisition"], cwd=ROOT, env=environment, stderr=log)
            )
        self.acquisition = self.processes[1]
        self.socket = zmq.Context.instance().socket(zmq.SUB)
        self.socket.connect(f"ipc://{folder}/acquisition.ipc")
        self.socket.subscribe(b"raw/palm\0")
        end = time.monotonic() + START_S
        while not (got := self.hear(0.5)) or not all(g.usable for g in got):
            assert time.monotonic() < end and self.acquisition.poll() is None, self.log.read_text()

    def hear(self, seconds: float, meanwhile: Callable[[float], None] | None = None) -> list[Got]:
        """Frames of so many seconds; `meanwhile` is called with the seconds gone."""
        began, got = time.monotonic(), []
        while (gone := time.monotonic() - began) < seconds:
            if meanwhile is not None:
                meanwhile(gone)
            if self.socket.poll(20):
                message = self.socket.recv()
                now = time.monotonic_ns()
                got.append(Got(msgpack.unpackb(message[message.index(b"\0") + 1 :]), now))
        return got

    def entered_ns(self, got: Got) -> int:
        """When this scan left the board."""
        return self.proxy.entered[got.frame.get("scan", 0), got.frame.get("device_us", 0)]

    def true_age_s(self, got: Got) -> float:
        """Since the middle of its scan, at least: the board may have sent it late."""
        return (got.at_ns - self.entered_ns(got)) * 1e-9 + LINE_S + HALF_SCAN_S

    def stamp_s(self, got: Got) -> float:
        """From its `sample` to when it left the board."""
        return (self.entered_ns(got) - got.frame["stamps"]["sample"]) * 1e-9

    def promise(self, heard: list[Got]) -> None:
        """Nothing that may be acted on is older than it may be."""
        old = [g for g in heard if g.usable and self.true_age_s(g) > g.frame["valid_for_s"] + SLACK_S]
        assert not old, [(self.true_age_s(g), g.age_s, g.frame.get("reasons")) for g in old[:3]]

    def close(self) -> None:
        for process in self.processes:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)
        for process in self.processes:
            process.wait(20)
        self.processes[0].stderr.close()
        self.proxy.close()
        self.socket.close(linger=0)


@pytest.fixture(scope="module", params=["full", "rolling"])
def line(request: pytest.FixtureRequest) -> Iterator[Bench]:
    folder = Path(tempfile.mkdtemp(prefix="eit", dir="/tmp"))
    bench = Bench(folder, request.param)
    yield bench
    bench.close()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def well(line: Bench) -> Bench:
    """The line as it should be, and frames that are usable."""
    line.proxy.delay_s, line.proxy.repeat, line.proxy.reorder = 0.0, False, False
    end = time.monotonic() + START_S
    while not (got := line.hear(1.0)) or not all(g.usable for g in got):
        assert time.monotonic() < end, line.log.read_text()
    return line


def test_a_delay_that_sets_in_is_in_the_stamp(well: Bench) -> None:
    before = well.hear(2.0)
    well.proxy.delay_s = 0.9
    heard = well.hear(4.0)
    late = [g for g in heard if (g.at_ns - well.entered_ns(g)) * 1e-9 > 0.85]
    assert len(late) > 30 and not any(g.usable for g in late)
    assert min(g.age_s for g in late) > 0.85, "the age of each of them says it"
    usual = statistics.median(map(well.stamp_s, before))
    assert statistics.median(map(well.stamp_s, late)) == pytest.approx(usual, abs=RIGHT_S)
    well.proxy.delay_s = 0.0
    well.promise(before + heard + well.hear(1.0))


def test_a_delay_that_grows_is_in_the_stamp(well: Bench) -> None:
    usual = statistics.median(map(well.stamp_s, well.hear(1.0)))

    def grows(gone: float) -> None:
        well.proxy.delay_s = min(2.0, 0.5 * gone)

    heard = well.hear(6.0, grows)
    well.promise(heard)
    late = [g for g in heard if (g.at_ns - well.entered_ns(g)) * 1e-9 > 0.5]
    assert len(late) > 20 and not any(g.usable for g in late)
    assert statistics.median(map(well.stamp_s, late)) == pytest.approx(usual, abs=RIGHT_S)


def test_scans_that_come_twice_or_out_of_order_are_shown_once_and_in_order(well: Bench) -> None:
    for what in ("repeat", "reorder"):
        setattr(well.proxy, what, True)
        heard = well.hear(2.0)
        setattr(well.proxy, what, False)
        scans = [g.frame.get("scan", 0) for g in heard]
        assert scans == sorted(set(scans))
        # in parts every second one is refused, being older than what came last: no scan has all its values
        assert len(scans) > 10 or (what == "reorder" and well.scan == "rolling")
        well.promise(heard)


def test_a_process_that_stood_still_empties_its_port_first(well: Bench) -> None:
    os.kill(well.acquisition.pid, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(well.acquisition.pid, signal.SIGCONT)
    heard = well.hear(2.0)
    well.promise(heard)
    assert any(g.usable for g in heard)
    played_out = [g for g in heard if well.true_age_s(g) > 1.0]
    assert len(played_out) <= 2, "what waited was skipped"
