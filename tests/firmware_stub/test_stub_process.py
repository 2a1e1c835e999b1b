"""The stub as a process: behind its pty or TCP port, its control socket, its signals."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from firmware_stub.__main__ import _open, arguments
from protocol import link
from protocol.control import ControlClient, ControlError
from protocol.sockets import NewestReader
from tests.firmware_stub.conftest import PAIRS
from tests.waiting import WAIT_S, until


class Process:
    """A running stub and a serial port to it."""

    def __init__(self, *options):
        command = [sys.executable, "-m", "firmware_stub", "--seed", "1", *options]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.line = self.process.stderr.readline()

    def open(self, url=None):
        url = url or self.line.split(" at ")[1].split(",")[0]
        self.serial, self.decoder, self.messages = serial.serial_for_url(str(url), timeout=0.02), link.Decoder(), []
        return self

    def next(self, kind):
        """Those before it are passed over."""

        def found():
            if not self.messages:
                self.messages += self.decoder.feed(self.serial.read(4096))  # or what comes within its time-out
            while self.messages:
                if isinstance(message := self.messages.pop(0), kind):
                    return message

        return until(found, self.process)

    def start(self):
        for message in (link.Config(1, 128, 80e3, PAIRS), link.Start(1)):
            self.serial.write(link.encode(message))
            assert self.next((link.Ack, link.Nak)).of == message.number
        return self


@pytest.fixture
def run(runtime):
    made = []
    yield lambda *options: made.append(Process(*options)) or made[-1]
    for stub in made:
        stub.process.kill()
        stub.process.wait()


@pytest.mark.live
def test_frames_and_truth_over_the_pty_and_a_second_stub_takes_over_nothing(run, runtime):
    stub = run().open(runtime / "board-palm").start()
    truth, client = NewestReader("truth", "palm"), ControlClient("stub", WAIT_S)
    first = stub.next(link.ScanFrame)
    assert client.call("press", x=0.02, y=-0.01, force=3, seconds=100)["drop"] == pytest.approx(0.3)
    until(lambda: np.abs(np.abs((felt := stub.next(link.ScanFrame)).z) / np.abs(first.z) - 1).max() > 3e-3 and felt)
    true = until(lambda: (found := truth.recv(1.0)) and found.touches and found, stub.process)
    assert [(t.shape, t.x, t.y, t.force_n) for t in true.touches] == [("circle", 0.02, -0.01, pytest.approx(3.0))]
    assert len(true.touches[0].outline) > 8 and true.scan > first.seq
    assert first.device_us * 1e3 < true.stamps["sample"] < time.monotonic_ns()
    assert client.call("release") == {"released": 1, "scene_ended": None, "faults": {}}
    assert stub.decoder.counts["good"] > 3 and stub.decoder.bad == 0
    for args, says in (
        ({"x": 1.0, "y": 0.0}, "not on the skin"),
        ({"y": 0.0}, "argument x: found none, expected a finite number .m."),
        ({"x": 0.0, "y": 0.0, "skin": "sole"}, "no skin 'sole': expected one of palm"),
    ):
        with pytest.raises(ControlError, match=says):
            client.call("press", force=1.0, **args)
    second = run()
    assert second.process.wait(WAIT_S) == 2 and "another stub runs" in second.line
    last = stub.next(link.ScanFrame)
    time.sleep(1.2)  # nobody reads: the kernel must not hand that second to the next reader
    stub.serial.close()
    stub.open(runtime / "board-palm")
    assert (stub.next(link.ScanFrame).device_us - last.device_us) * 1e-6 > 0.7
    truth.close()
    client.call("faults", name="unplug", args={"name": "board2"}, seconds=0.5)
    with pytest.raises((serial.SerialException, OSError)):
        until(lambda: stub.serial.read(4096) and False, stub.process)
    assert not (runtime / "board-palm").is_symlink()
    stub.serial.close()
    until((runtime / "board2").is_symlink, stub.process)
    stub.open(runtime / "board2")
    stub.serial.write(link.encode(link.Start(1)))
    assert stub.next(link.Nak).reason == link.NakReason.NOT_CONFIGURED
    assert len(stub.start().next(link.ScanFrame).z) == 120
    stub.process.terminate()
    assert stub.process.wait(WAIT_S) == 0 and not (runtime / "board2").is_symlink()


@pytest.mark.live
def test_over_tcp_a_second_client_takes_over_and_it_ends_when_its_host_has_left(run):
    stub = run("--listen", "socket://127.0.0.1:0", "--scene", "two", "--leave", "0.5")
    for _ in range(2):
        assert len(stub.open().start().next(link.ScanFrame).z) == 120
        stub.serial.close()
    assert stub.process.wait(WAIT_S) == 0 and "no host for 0.5 s" in stub.process.stderr.read()


@pytest.mark.live
def test_it_ends_with_its_parent(runtime):
    script = "import subprocess, sys; p = subprocess.Popen([sys.executable, '-m', 'firmware_stub'])"
    command = [sys.executable, "-c", f"{script}; print(p.pid, flush=True); p.wait()"]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    child = Path(f"/proc/{int(parent.stdout.readline())}/stat")
    until((runtime / "board-palm").is_symlink, parent)
    parent.kill()
    parent.wait()
    until(lambda: not child.exists() or child.read_text().rsplit(")", 1)[1].split()[0] == "Z")


def test_options_are_those_of_one_skin_or_of_everyone_and_wrong_ones_are_explained(capsys):
    skins = ("--skin", "a", "--skin", "b")
    assert arguments([*skins, "--mismatch", "b=mild"]).mismatches == {"a": "none", "b": "mild"}
    assert arguments([*skins, "--mismatch", "field5"]).mismatches == {"a": "field5", "b": "field5"}
    assert arguments([*skins, "--world", "b=creep"]).worlds == {"a": "", "b": "creep"}
    for options, says in (("--geometry=triangle99", "square16"), ("--mismatch=sole=mild", "expected one of palm")):
        with pytest.raises((SystemExit, ValueError)) as refused:
            _open(arguments([options]), {})
        assert says in f"{refused.value} {capsys.readouterr().err}"
