"""The stub as a process: behind its pty or TCP port, its control socket, its signals."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import serial

from firmware_stub.__main__ import arguments
from models.patterns import pattern
from protocol import link
from protocol.control import ControlClient, ControlError
from protocol.sockets import NewestReader

pytestmark = pytest.mark.live

PAIRS = pattern("pairs").astype("u1")


class Process:
    """A running stub and a serial port to it."""

    def __init__(self, folder, *options):
        env = dict(os.environ, EITSKIN_RUNTIME=str(folder), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        command = [sys.executable, "-m", "firmware_stub", "--seed", "1", *options]
        self.process = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
        self.line = self.process.stderr.readline()
        self.url = self.line.split(" at ")[1].split(",")[0] if " at " in self.line else ""
        self.serial, self.decoder = None, link.Decoder()

    def open(self, url=None):
        self.serial = serial.serial_for_url(str(url or self.url), 921_600, timeout=0.02)
        self.decoder = link.Decoder()
        return self

    def until(self, kind, timeout_s=20.0):
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            for message in self.decoder.feed(self.serial.read(self.serial.in_waiting or 1)):
                if isinstance(message, kind):
                    return message
        raise AssertionError(f"no {kind.__name__} within {timeout_s} s; {self.decoder.counts}")

    def start(self):
        for message in (link.Config(1, 128, 80e3, PAIRS), link.Start(1)):
            self.serial.write(link.encode(message))
            assert self.until((link.Ack, link.Nak)).of == message.number
        return self

    def stop(self, number=signal.SIGTERM):
        if self.serial is not None:
            self.serial.close()
        self.process.send_signal(number)
        return self.process.wait(20)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    path.chmod(0o700)
    before = os.environ.get("EITSKIN_RUNTIME")
    os.environ["EITSKIN_RUNTIME"] = str(path)
    yield path
    os.environ.pop("EITSKIN_RUNTIME")
    if before is not None:
        os.environ["EITSKIN_RUNTIME"] = before


@pytest.fixture
def other_folder(tmp_path):
    """For a second stub: in the first one's folder it would take over its sockets."""
    tmp_path.chmod(0o700)
    return tmp_path


@pytest.fixture(scope="module")
def stub(folder):
    stub = Process(folder)
    yield stub
    assert stub.stop() == 0
    assert not (folder / "board-palm").is_symlink()


def test_frames_and_truth_over_the_pty(stub, folder):
    stub.open(folder / "board-palm").start()
    truth = NewestReader("truth", "palm")
    client = ControlClient("stub", 20.0)
    healthy = np.abs(stub.until(link.ScanFrame).z)
    assert client.call("press", x=0.02, y=-0.01, force=3, seconds=5)["drop"] == pytest.approx(0.3)
    # what was measured before does not feel it; all later scans do
    frames = [stub.until(link.ScanFrame) for _ in range(5)]
    assert np.abs(np.abs(frames[-1].z) / healthy - 1).max() > 3e-3
    true = truth.recv(10.0)
    assert [(t.shape, t.x, t.y, t.force_n) for t in true.touches] == [("circle", 0.02, -0.01, pytest.approx(3.0))]
    assert len(true.touches[0].outline) > 8
    assert abs(true.scan - frames[-1].seq) < 40
    assert 0 < time.monotonic_ns() - true.stamps["sample"] < 3e9
    assert client.call("release") == {"released": 1, "scene_ended": None, "faults": {}}
    assert stub.decoder.counts["good"] > 5 and stub.decoder.bad == 0
    truth.close()


def test_commands_explain_what_was_wrong(stub):
    client = ControlClient("stub", 20.0)
    for command, args, says in (
        ("press", {"x": 1.0, "y": 0.0, "force": 1.0}, "not on the skin"),
        ("press", {"x": 0.0, "y": 0.0}, "force"),
        ("press", {"y": 0.0, "force": 1.0}, "argument x: found none, expected a finite number .m."),
        ("press", {"x": "left", "y": 0.0, "force": 1.0}, "left"),
        ("press", {"x": 0.0, "y": 0.0, "force": 1.0, "skin": "sole"}, "no skin 'sole': expected one of palm"),
        ("scene", {"name": "nowhere"}, "paper_49"),
        ("faults", {"name": "gremlins"}, "electrode_open"),
    ):
        with pytest.raises(ControlError, match=says):
            client.call(command, **args)
    assert "paper_49" in client.call("scene")["scenes"]
    assert "electrode_open" in client.call("faults")["known"]
    assert client.call("status")["plugged"] is True


def test_unplugged_and_back_under_another_name(stub, folder):
    stub.open(folder / "board-palm").start()
    device = os.path.realpath(folder / "board-palm")
    ControlClient("stub", 20.0).call("faults", name="unplug", args={"name": "board2"}, seconds=0.5)
    with pytest.raises((serial.SerialException, OSError)):
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            stub.serial.read(4096)
    assert not (folder / "board-palm").is_symlink()
    stub.serial.close()
    end = time.monotonic() + 20.0
    while not (folder / "board2").is_symlink() and time.monotonic() < end:
        time.sleep(0.02)
    assert os.path.realpath(folder / "board2") != device or os.path.exists(device)
    stub.open(folder / "board2")
    stub.serial.write(link.encode(link.Start(1)))
    assert stub.until(link.Nak).reason == link.NakReason.NOT_CONFIGURED
    stub.start()
    assert len(stub.until(link.ScanFrame).z) == 120
    ControlClient("stub", 20.0).call(
        "faults", name="unplug", seconds=0.1
    )  # and back to its own name, for the other tests
    stub.serial.close()
    end = time.monotonic() + 20.0
    while not (folder / "board-palm").is_symlink() and time.monotonic() < end:
        time.sleep(0.02)
    assert not (folder / "board2").is_symlink()


def test_a_late_reader_finds_fresh_frames(stub, folder):
    """Nobody read for a second: the kernel must not hand that second to the next reader."""
    stub.open(folder / "board-palm").start()
    first = stub.until(link.ScanFrame)
    time.sleep(1.2)
    stub.serial.close()
    stub.open(folder / "board-palm")
    frame = stub.until(link.ScanFrame)
    assert (frame.device_us - first.device_us) * 1e-6 > 0.7


def test_over_tcp_with_scripted_scene_and_interrupt(other_folder):
    stub = Process(other_folder, "--listen", "socket://127.0.0.1:0", "--scene", "two")
    assert stub.url.startswith("socket://127.0.0.1:")
    stub.open().start()
    assert len(stub.until(link.ScanFrame).z) == 120
    stub.serial.close()
    stub.open()  # a second client takes over
    assert len(stub.until(link.ScanFrame).z) == 120
    assert stub.stop(signal.SIGINT) == 0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--scene", "nowhere"), "paper_49"),
        (("--geometry", "triangle99"), "square16"),
        (("--listen", "serial://x:7"), "socket://HOST:PORT"),
    ],
)
def test_wrong_options_are_explained(other_folder, options, says):
    stub = Process(other_folder, *options)
    assert stub.process.wait(60) == 2
    assert says in stub.line


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--mismatch", "wild"), "anisotropy5"),
        (("--mismatch", "sole=mild"), "no skin 'sole'; expected one of palm"),
        (("--world", "moon"), "expected one of plain, creep"),
        (("--world", "creep", "--mismatch", "mild"), "a world has a sheet of its own"),
    ],
)
def test_a_mismatch_that_there_is_not(capsys, options, says):
    with pytest.raises(SystemExit):
        arguments([*options])
    assert says in capsys.readouterr().err


def test_a_mismatch_is_one_skins_or_everyones():
    skins = ("--skin", "a", "--skin", "b")
    assert arguments([*skins, "--mismatch", "b=mild"]).mismatches == {"a": "none", "b": "mild"}
    assert arguments([*skins, "--mismatch", "field5"]).mismatches == {"a": "field5", "b": "field5"}
    assert arguments([*skins, "--world", "b=creep"]).worlds == {"a": "", "b": "creep"}


def test_it_ends_with_its_parent(other_folder):
    """A shell that is killed outright cannot tell its stub to stop."""
    script = (
        "import subprocess, sys; p = subprocess.Popen([sys.executable, '-m', 'firmware_stub']); "
        "print(p.pid, flush=True); p.wait()"
    )
    env = dict(os.environ, EITSKIN_RUNTIME=str(other_folder))
    parent = subprocess.Popen([sys.executable, "-c", script], env=env, stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    end = time.monotonic() + 20.0
    while not (other_folder / "board-palm").is_symlink() and time.monotonic() < end:
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    end = time.monotonic() + 20.0
    while os.path.exists(f"/proc/{child}") and time.monotonic() < end:
        if open(f"/proc/{child}/stat").read().rsplit(")", 1)[1].split()[0] == "Z":
            break
        time.sleep(0.05)
    else:
        assert not os.path.exists(f"/proc/{child}")


def test_a_second_stub_does_not_take_over_the_first_ones_sockets(stub, folder):
    second = Process(folder)
    assert second.process.wait(60) == 2
    assert "another stub runs" in second.line
    assert ControlClient("stub", 20.0).call("status")["plugged"] is True


@pytest.mark.release
def test_a_stub_that_its_host_has_left_ends_where_it_is_told_to(other_folder):
    """In containers its network has gone with the host: started anew, it is in the host's new one."""
    stub = Process(other_folder, "--listen", "socket://127.0.0.1:0", "--leave", "1")
    time.sleep(1.5)
    assert stub.process.poll() is None  # nobody came yet: that is no leaving
    stub.open().start()
    time.sleep(1.5)
    assert stub.process.poll() is None
    stub.serial.close()
    assert stub.process.wait(20) == 0
    assert "no host for 1 s" in stub.process.stderr.read()
