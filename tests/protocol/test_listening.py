"""Sockets that are robbed, deleted or flooded: it is said, it is mended within 2 s, and nobody else suffers."""

import contextlib
import ctypes
import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq

from protocol import transport
from protocol.control import ControlClient, ControlServer
from protocol.frames import ContactFrame, InfoFrame
from protocol.publishing import MOST_PREFIXES
from protocol.sockets import AllReader, NewestReader, Publisher
from protocol.transport import TransportError

from .test_sockets import until

pytestmark = pytest.mark.live

FLOOD = Path(__file__).with_name("flood.py")
CURED_S = 2.0
PATIENCE = 5  # times as long on a machine that does other things too


@pytest.fixture
def publisher(runtime, context):
    made = Publisher("publisher", context)
    yield made
    made.close()
    transport.stop_gate(context)


@contextlib.contextmanager
def another(*command):
    """Another process, ended afterwards; gives it once it has said a line."""
    process = subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def resident_mb():
    """What is held, without what malloc keeps of freed memory: up to 100 MB after a flood, by chance."""
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def step(publisher, reader=None):
    """A turn of the runner: whether a frame came through."""
    publisher.mind()
    publisher.poll()
    publisher.send(ContactFrame(skin="palm"))
    return reader is not None and reader.recv(0.01) is not None


def test_a_deleted_socket_file_is_there_again_and_nobody_is_forgotten(publisher, context, runtime):
    info = Publisher("preprocessing", context)
    reader = NewestReader("contact", "palm", context=context)
    latched = AllReader(["info"], "palm", context=context)
    until(lambda: step(publisher, reader))
    info.send(InfoFrame(skin="palm", process="preprocessing", info={"units": "si"}))
    until(lambda: info.poll() or latched.recv(0.01) is not None)
    for name, socket in (("publisher", publisher), ("preprocessing", info)):
        os.unlink(f"{runtime}/{name}.ipc")
        began = time.monotonic()
        until(socket.mind)
        assert time.monotonic() - began < PATIENCE * CURED_S
        assert f"{name}.ipc was deleted" in " ".join(socket.problems)
        assert socket.wanted("contact" if name == "publisher" else "info", "palm")  # while its readers come back
    until(lambda: step(publisher, reader))
    until(lambda: step(publisher) or publisher.subscribers("contact", "palm") == 1)
    newcomer = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, newcomer))
    late = AllReader(["info"], "palm", context=context)
    until(lambda: info.poll() or late.recv(0.01) is not None)  # the latched value
    info.close()


def test_a_second_publisher_is_refused_and_a_dead_ones_file_is_no_hindrance(publisher, context, runtime):
    code = "from protocol.sockets import Publisher; Publisher('publisher')"
    second = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert second.returncode and f"process {os.getpid()} does already" in second.stderr
    code = "from protocol.sockets import Publisher; import os; Publisher('inference'); os._exit(1)"
    subprocess.run([sys.executable, "-c", code], timeout=60, check=False)
    assert os.path.exists(f"{runtime}/inference.ipc")
    Publisher("inference", context).close()


THIEF = """
import sys, time, zmq
socket = zmq.Context.instance().socket(zmq.PUB)
socket.bind(sys.argv[1])  # takes the file over, as ZeroMQ does
print("bound", flush=True)
time.sleep(60)
"""


def test_a_socket_file_that_another_process_took_is_taken_back_and_its_thief_named(publisher, context, runtime):
    address = f"ipc://{runtime}/publisher.ipc"
    with another("-c", THIEF, address) as thief:
        assert thief.stdout.readline() == "bound\n"
        assert transport.listener(address) == thief.pid
        until(publisher.mind)
        assert f"process {thief.pid} put its own socket" in " ".join(publisher.problems)
        assert transport.listener(address) == os.getpid()
        reader = NewestReader("contact", "palm", context=context)
        until(lambda: step(publisher, reader))


def test_two_processes_that_take_one_file_from_each_other_do_not_fight_for_ever(publisher, runtime, monkeypatch):
    now, taken = time.monotonic(), 0
    monkeypatch.setattr("protocol.listening.time.monotonic", lambda: now)
    for _ in range(600):  # a minute
        now += 0.1
        os.unlink(f"{runtime}/publisher.ipc") if os.path.exists(f"{runtime}/publisher.ipc") else None
        taken += publisher.mind()
    assert 4 < taken < 15


def test_a_port_that_is_taken_meanwhile_is_said_and_bound_when_it_is_free(context, runtime):
    from .test_transport import free_port

    port = free_port()
    publisher = Publisher("publisher", context, address=f"tcp://127.0.0.1:{port}")
    publisher.socket.close(0)
    other = context.socket(zmq.PUB)
    until(lambda: _binds(other, port))
    publisher._listening.reopen("the test closed it")
    assert "another program uses it" in " ".join(publisher.problems)
    publisher.send(ContactFrame(skin="palm"))  # goes nowhere, and hurts nobody
    other.close(0)
    until(lambda: publisher.mind() and "another program" not in " ".join(publisher.problems), 20)
    reader = NewestReader("contact", "palm", f"tcp://127.0.0.1:{port}", context)
    until(lambda: step(publisher, reader))
    publisher.close()


def _binds(socket, port):
    try:
        socket.bind(f"tcp://127.0.0.1:{port}")
    except zmq.ZMQError:
        return False
    return True


@pytest.mark.parametrize(("kind", "count"), [("subscribe", 50_000), ("lengthy", 4000)])
def test_a_flood_of_subscriptions_is_shed_named_and_kept_out(publisher, context, runtime, kind, count):
    """50 000 here; half a million by hand: `python tests/protocol/flood.py subscribe ipc://... 500000`."""
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, reader))
    before = resident_mb()
    with another(FLOOD, kind, f"ipc://{runtime}/publisher.ipc", count) as flood:
        until(lambda: step(publisher, reader) or publisher.problems, 20)
        until(lambda: step(publisher) or publisher.problems, 20)
        assert f"process {flood.pid}" in " ".join(publisher.problems)
        assert f"too many subscriptions (at most {MOST_PREFIXES}" in " ".join(publisher.problems)
        while reader.recv(0.2) is not None:  # what was on its way
            pass
        until(lambda: step(publisher, reader), PATIENCE * CURED_S)
        while reader.recv(0.2) is not None:
            pass
        socket = publisher.socket
        for _ in range(100):
            publisher.mind()
            publisher.poll()
            publisher.send(ContactFrame(skin="palm"))
            assert reader.recv(5.0) is not None
        assert publisher.socket is socket  # it is kept out: no second time
        assert publisher.subscribers("contact", "palm") == 1
        assert len(publisher._subscriptions) <= MOST_PREFIXES
    assert resident_mb() - before < 50


LONG = """
import sys, time, zmq
socket = zmq.Context.instance().socket(zmq.SUB)
socket.connect(sys.argv[1])
socket.subscribe(b"contact/" + b"x" * 1_000_000)
print("sent", flush=True)
time.sleep(60)
"""


def test_a_subscription_too_long_for_any_topic_is_cut_off(publisher, context, runtime):
    """libzmq takes some 50 bytes of memory for each byte of a subscription."""
    reader = NewestReader("contact", "palm", context=context)
    with another("-c", LONG, f"ipc://{runtime}/publisher.ipc") as long:
        assert long.stdout.readline() == "sent\n"
        until(lambda: step(publisher, reader))
        for _ in range(50):
            step(publisher, reader)
        assert publisher.subscribers("contact", "palm") == 1
        assert max(map(len, publisher._subscriptions)) < 100


def test_a_flood_of_commands_is_answered_one_by_one_named_and_bounded(runtime, context):
    served = 0
    state = {"baseline": b"\0" * 200_000}

    def give(args):
        nonlocal served
        served += 1
        return {"state": state}

    control = ControlServer("publisher", {"state": give}, context=context)
    before = resident_mb()
    with another(FLOOD, "command", f"ipc://{runtime}/publisher.ctl", 20_000) as flood:
        end = time.monotonic() + 60
        while served < 5000:
            control.serve_once(0.1)
            assert time.monotonic() < end
        assert "control requests" in " ".join(control.problems) and f"process {flood.pid}" in control.problems[0]
        assert resident_mb() - before < 50
        stranger = zmq.Context.instance().socket(zmq.REQ)
        stranger.connect(f"ipc://{runtime}/publisher.ctl")
        stranger.send(b"\x82\xa7command\xa5clock\xa4args\x80")
        until(lambda: control.serve_once(0.1) and stranger.poll(0))
        stranger.close(0)
    control.close()


def test_a_deleted_runtime_folder_is_there_again(publisher, context, runtime):
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, reader))
    shutil.rmtree(runtime)
    until(lambda: publisher.mind())
    assert stat.S_IMODE(os.stat(runtime).st_mode) == 0o700 and not publisher._listening._unbound
    until(lambda: step(publisher, reader))


def test_a_folder_of_somebody_else_in_its_place_ends_nothing(publisher, context, runtime):
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, reader))
    shutil.rmtree(runtime)
    os.mkdir(runtime)
    os.chmod(runtime, 0o777)
    until(lambda: publisher.mind())
    assert "expected 0700" in " ".join(publisher.problems)
    os.chmod(runtime, 0o700)
    until(lambda: step(publisher, reader))


def test_commands_go_on_after_the_control_socket_was_deleted(runtime, context):
    control = ControlServer("publisher", {}, context=context)
    os.unlink(f"{runtime}/publisher.ctl")
    until(control.mind)
    assert "deleted" in " ".join(control.problems)
    import threading

    stop = threading.Event()
    thread = threading.Thread(target=lambda: [control.serve_once(0.02) for _ in iter(stop.is_set, True)])
    thread.start()
    assert "monotonic_ns" in ControlClient("publisher", 3.0, context=context).call("clock")
    stop.set()
    thread.join()
    control.close()


def test_an_address_in_use_is_an_error_that_says_so(context):
    from .test_transport import free_port

    port = free_port()
    first = Publisher("publisher", context, address=f"tcp://127.0.0.1:{port}")
    with pytest.raises(TransportError, match="another program uses it"):
        Publisher("inference", context, address=f"tcp://127.0.0.1:{port}")
    first.close()
