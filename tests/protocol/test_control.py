"""Commands: typed answers, whatever is asked. The runtime folder: whose it is; what is logged of others' text."""

import io
import logging
import os
import stat
import threading
import time

import msgpack
import pytest
import zmq

from protocol import control, logs
from protocol import runtime as rt
from protocol.commands import COMMANDS, Argument, Command, Content
from protocol.control import BUSY, SPOKEN_OF_S
from protocol.fields import Bool, Float, Int, Text
from protocol.logs import foreign
from protocol.runtime import control_endpoint, host_id
from protocol.sockets import ControlClient, ControlError, ControlServer, clock_offset
from tests.waiting import until

from .line import AHEAD_NS, Clock
from .peers import another, served

pytestmark = pytest.mark.live

PRESS = {"x": Argument(Float(unit="m"), ""), "shape": Argument(Text(), ""), "n": Argument(Int(), "")}
TABLE = {
    "needs": Command("test", "", {"x": Argument(Int(), "a number", needed=True)}),
    "press": Command("test", "", PRESS),
    **{name: Command("test", "") for name in ("fail", "refuse", "slow", "odd")},
}


@pytest.fixture
def server(runtime, context):
    go_on = threading.Event()

    def fail(args):
        raise FileNotFoundError("no bundle `x`: see models/bundles")

    def refuse(args):
        raise ControlError("busy", "taring")

    handlers = {"fail": fail, "refuse": refuse, "slow": lambda _: go_on.wait(60) and {}}
    handlers |= {"odd": lambda _: {"x": object()}, "needs": lambda args: {"got": args["x"]}}
    own = ControlServer("stub", handlers | {"press": lambda args: {"got": args}}, context=context, commands=TABLE)
    with served(own):
        own.go_on = go_on.set
        yield own


@pytest.fixture
def client(context):
    return ControlClient("stub", 60.0, context=context)


def refused(kind, says, of, command, **args):
    with pytest.raises(ControlError, match=says) as caught:
        of.call(command, **args)
    assert caught.value.kind == kind and len(str(caught.value)) < 300, args


def test_a_failing_command_is_a_typed_error_and_the_server_lives(server, client):
    refused("unknown_command", "it has: clock, fail, needs, odd, press, refuse, slow", client, "tear")
    refused("FileNotFoundError", "see models/bundles", client, "fail")
    refused("busy", "taring", client, "refuse")
    refused("TypeError", "serialize", client, "odd")
    refused("bad_request", "argument x: found none, expected a whole number: a number", client, "needs")
    assert client.call("press") == {"got": {}}
    assert client.call("press", x=0.02, shape="circle") == {"got": {"x": 0.02, "shape": "circle"}}


RIGHT = {Bool: True, Float: 1.5, Int: 1, Text: "x", Content: {"a": 1}}
WRONG = {
    Bool: ("no", "true", "", 0, 1, 1.0, [], {}, b"\1"),
    Float: ("1", True, [1.0], {}, float("nan"), float("inf"), -float("inf"), b""),
    Int: ("1", True, 1.5, float("nan"), [1]),
    Text: (1, True, ["x"], {}, b"x", "x" * 5000),
    Content: ("x", 1, True, []),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_carried_out_with_arguments_of_their_types_or_not_at_all(runtime, context, client, name):
    """`tare` with force: "no" is no tare by force."""
    carried_out, arguments = [], COMMANDS[name].arguments
    handlers = {each: lambda args, each=each: carried_out.append((each, args)) or {} for each in COMMANDS}
    given = {key: RIGHT[type(argument.check)] for key, argument in arguments.items()}
    needed = {key: given[key] for key, argument in arguments.items() if argument.needed}
    with served(ControlServer("stub", handlers, context=context)):
        for key, argument in arguments.items():
            for wrong in WRONG[type(argument.check)]:
                says = f"{name}, argument {key}: found .*, expected "
                refused("bad_request", says, client, name, **{**given, key: wrong})
        says = f"{name}: found the argument forse, expected (only|no argument)"
        refused("bad_request", says, client, name, **given, forse=True)
        for key in needed:
            for less in ({k: v for k, v in given.items() if k != key}, {**given, key: None}):
                refused("bad_request", f"{name}, argument {key}: found none, expected ", client, name, **less)
        assert not carried_out
        client.call(name, **given)
        client.call(name, **{key: needed.get(key) for key in given})
    assert carried_out == [(name, given), (name, needed)] or name == "clock"  # which is the server's own


def test_nobody_there_is_found_out_and_the_request_is_not_carried_out_later(runtime, context, client):
    refused("unreachable", "is the service running", ControlClient("stub", 0.1, context=context), "press")
    pressed = []
    with served(ControlServer("stub", {"press": pressed.append}, context=context)):
        client.call("clock")
    assert not pressed


def test_no_answer_in_time_and_the_late_one_is_not_taken_for_the_next(server, context, client):
    refused("timeout", "did not answer slow within 1 s", ControlClient("stub", 1.0, context=context), "slow")
    server.go_on()
    assert client.call("press", n=1) == {"got": {"n": 1}}


def test_any_req_socket_can_ask_and_nonsense_is_refused(server, context):
    def sent(request):
        asking.send(request)
        assert asking.poll(60_000)
        return msgpack.unpackb(asking.recv())

    dealer, asking = context.socket(zmq.DEALER), context.socket(zmq.REQ)
    for each in (dealer, asking):
        each.connect(control_endpoint("stub"))
    for request in (b"", b"\xc1", *map(msgpack.packb, ([1], {"args": {}}, {"command": "press", "args": 1}))):
        assert sent(request)["error"]["type"] == "bad_request"
    dealer.send(b"no delimiter")
    dealer.send_multipart([b"", msgpack.packb({"command": "clock"})])
    assert dealer.poll(60_000) and dealer.recv_multipart()[0] == b"", "the first of them has no answer"
    assert sent(msgpack.packb({"command": "press"})) == {"ok": True, "result": {"got": {}}}
    assert server.malformed == 6 and not dealer.poll(0)


def test_a_flood_is_named_and_what_a_replay_asks_after_each_part_is_none(runtime, context, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(control, "time", clock)
    seen = {command: lambda args: {"seen": True} for command in ("part", "status")}
    server = ControlServer("preprocessing", seen, context=context)
    asking = context.socket(zmq.REQ)
    asking.connect(control_endpoint("preprocessing"))

    def ask(command, count):
        for _ in range(count):
            asking.send(msgpack.packb({"command": command, "args": {"scan": 1} if command == "part" else {}}))
            assert server.serve_once(60.0) and msgpack.unpackb(asking.recv())["ok"]
        return " ".join(server.problems)

    assert BUSY == 100 and ask("part", 2 * BUSY) == ask("status", BUSY - 1) == ""
    clock.go(1.0)
    assert ask("status", BUSY - 1) == "", "within a second"
    assert f"more than {BUSY} control requests a second" in ask("status", 1)
    clock.go(SPOKEN_OF_S + 0.1)
    assert ask("status", 1) == ""
    server.close()


def test_the_clock_of_another_process(server, client, context):
    assert abs((of := clock_offset(client, host=host_id()))[0]) <= of[1], "the same clock: the true offset is 0"
    with pytest.raises(ControlError, match="another host than third") as caught:
        clock_offset(client, host="third")
    assert caught.value.kind == "other_host"
    ahead = {"clock": lambda _: {"monotonic_ns": time.monotonic_ns() + AHEAD_NS}}
    with served(ControlServer("publisher", ahead, context=context)):
        offset, uncertainty = clock_offset(ControlClient("publisher", 60.0, context=context))
    assert abs(offset - AHEAD_NS) <= uncertainty


def test_it_is_made_for_us_alone_where_the_environment_says(monkeypatch, runtime):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    monkeypatch.delenv("EITSKIN_RUNTIME", raising=False)
    assert rt.runtime_dir() == runtime / "eitskin"
    monkeypatch.setenv("EITSKIN_RUNTIME", str(runtime / "a" / "b"))
    assert stat.S_IMODE(rt.runtime_dir().stat().st_mode) == 0o700
    assert rt.endpoint("publisher") == f"ipc://{runtime}/a/b/publisher.ipc"
    assert rt.control_endpoint("stub") == f"ipc://{runtime}/a/b/stub.ctl"
    monkeypatch.setenv("EITSKIN_RUNTIME", str(runtime / ("x" * 100)))
    with pytest.raises(rt.RuntimeDirError, match="at most 107"):
        rt.endpoint("publisher")


def test_an_unsafe_folder_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_RUNTIME", str(path := tmp_path / "run"))

    def refused(make, says):
        make()
        with pytest.raises(rt.RuntimeDirError, match=says):
            rt.runtime_dir()

    refused(lambda: path.mkdir(mode=0o755), "mode 0755, expected 0700: chmod 700")
    path.chmod(0o700)
    refused(lambda: monkeypatch.setattr(os, "geteuid", lambda: 12345), "expected 12345")
    monkeypatch.undo()
    monkeypatch.setenv("EITSKIN_RUNTIME", str(path))
    path.rmdir()
    refused(lambda: path.symlink_to(tmp_path), "symbolic link")


HOLDING = "import time; from protocol.runtime import lock\nwith lock(): print('held', flush=True); time.sleep(600)"


@pytest.mark.live
def test_a_second_service_is_refused_and_the_lock_goes_with_its_process(runtime):
    with another("-c", HOLDING) as holder:
        with pytest.raises(rt.AlreadyRunning, match=f"in use by process {holder.pid}"), rt.lock():
            pass
        with rt.lock(process="publisher"):  # another one
            pass

    def ours():
        try:
            with rt.lock() as folder:
                return (folder / "lock").read_text() == f"{os.getpid()}\n"
        except rt.AlreadyRunning:  # the kernel has not quite let go
            return False

    until(ours)


@pytest.fixture
def log(monkeypatch):
    """A process's log; gives a function that returns the lines since the last call."""
    root, stream = logging.getLogger(), io.StringIO()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    monkeypatch.setattr("sys.stderr", stream)
    logs.setup("here: %(message)s")

    def lines():
        text = stream.getvalue()
        stream.seek(0)
        stream.truncate()
        return text.splitlines()

    return lines


def test_foreign_text_is_one_short_line_without_control_characters():
    assert foreign("two\nlines: ä\x1b[31m red\r") == r"two\nlines: ä\x1b[31m red\r"
    assert foreign(b"\xff\x00bytes") == r"\xff\x00bytes" and foreign("right\u202eto left") == r"right\u202eto left"
    assert foreign("x" * 10**6) == "x" * (logs.TEXT - 3) + "..."


def test_what_is_logged_is_bounded_in_lines_and_in_length(log, monkeypatch):
    monkeypatch.setattr(logs, "time", clock := Clock())

    def hostile(times):
        for number in range(times):
            logging.getLogger("t").warning("message\n%d", number)
        return log()

    assert len(lines := hostile(1000)) <= 2 * logs.BURST and lines[0] == "here: message"
    logging.getLogger("t").warning("another place %s\x1b[2J", "y" * 10**6)
    (line,) = log()
    assert line.startswith("here: another place") and len(line) <= logs.LINE + len("here: ")
    clock.go(logs.EVERY_S + 1)
    assert f"{1000 - logs.BURST} more like it" in " ".join(hostile(1))
