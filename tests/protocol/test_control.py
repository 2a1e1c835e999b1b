"""Commands: typed answers, whatever is asked; and no caller that hangs."""

import threading
import time

import msgpack
import pytest
import zmq

from protocol.control import BUSY
from protocol.runtime import control_endpoint
from protocol.sockets import ControlClient, ControlError, ControlServer, clock_offset


@pytest.fixture
def server(runtime, context):
    def fail(args):
        raise FileNotFoundError("no bundle `x`: see models/bundles")

    def refuse(args):
        raise ControlError("busy", "taring")

    def slow(args):
        time.sleep(0.5)
        return {}

    own = ControlServer(
        "stub",
        {
            "needs": lambda a: {"got": a["x"]},
            "press": lambda a: {"got": a},
            "fail": fail,
            "refuse": refuse,
            "slow": slow,
            "odd": lambda a: {"x": object()},
        },
        context=context,
    )
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            own.serve_once(0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    yield own
    stop.set()
    thread.join()


def test_a_command_is_answered(server, context):
    client = ControlClient("stub", context=context)
    assert client.call("press", x=0.02, shape="circle") == {"got": {"x": 0.02, "shape": "circle"}}
    assert client.call("press") == {"got": {}}


@pytest.mark.parametrize(
    ("command", "kind", "says"),
    [
        ("tear", "unknown_command", "it has: clock, fail, needs, odd, press, refuse, slow"),
        ("fail", "FileNotFoundError", "see models/bundles"),
        ("refuse", "busy", "taring"),
        ("odd", "TypeError", "serialize"),
        ("needs", "KeyError", "needs the argument 'x'"),
    ],
)
def test_a_failing_command_is_a_typed_error_and_the_server_lives(server, context, command, kind, says):
    client = ControlClient("stub", context=context)
    with pytest.raises(ControlError, match=says) as caught:
        client.call(command)
    assert caught.value.kind == kind
    assert client.call("press") == {"got": {}}


def test_nobody_there_is_found_out_in_time(runtime, context):
    began = time.monotonic()
    with pytest.raises(ControlError, match="is the service running") as caught:
        ControlClient("stub", 0.3, context=context).call("press")
    assert caught.value.kind == "unreachable"
    assert time.monotonic() - began < 1.0


def test_a_request_given_up_is_not_carried_out_later(runtime, context):
    with pytest.raises(ControlError):
        ControlClient("stub", 0.1, context=context).call("press")
    server = ControlServer("stub", {"press": lambda a: {}}, context=context)
    assert server.serve_once(0.3) is False


def test_no_answer_in_time_and_the_late_one_is_not_taken_for_the_next(server, context):
    client = ControlClient("stub", 0.2, context=context)
    with pytest.raises(ControlError, match="did not answer slow within 0.2 s") as caught:
        client.call("slow")
    assert caught.value.kind == "timeout"
    time.sleep(0.5)
    assert client.call("press", n=1) == {"got": {"n": 1}}


def test_any_req_socket_can_ask_and_nonsense_is_refused(server, context):
    socket = context.socket(zmq.REQ)
    socket.connect(control_endpoint("stub"))
    for request in (
        b"",
        b"\xc1",
        msgpack.packb([1]),
        msgpack.packb({"args": {}}),
        msgpack.packb({"command": "press", "args": 1}),
    ):
        socket.send(request)
        assert socket.poll(1000)
        reply = msgpack.unpackb(socket.recv())
        assert reply["ok"] is False and reply["error"]["type"] == "bad_request"
    socket.send(msgpack.packb({"command": "press"}))
    assert socket.poll(1000) and msgpack.unpackb(socket.recv()) == {"ok": True, "result": {"got": {}}}
    dealer = context.socket(zmq.DEALER)
    dealer.connect(control_endpoint("stub"))
    dealer.send(b"no delimiter")
    assert not dealer.poll(100)
    assert server.malformed == 6


def test_what_a_replay_asks_after_each_part_is_no_flood(runtime, context):
    parts = {command: lambda args: {"seen": True} for command in ("part", "status")}
    control = ControlServer("preprocessing", parts, context=context)
    socket = context.socket(zmq.REQ)
    socket.connect(control_endpoint("preprocessing"))

    def ask(command):
        for _ in range(2 * BUSY + 1):  # of which BUSY are in one second, unless they take more than two
            socket.send(msgpack.packb({"command": command}))
            assert control.serve_once(1.0)
            assert socket.poll(1000) and msgpack.unpackb(socket.recv())["ok"]

    ask("part")
    assert control.problems == []
    ask("status")
    assert "control requests a second" in control.problems[0]
    socket.close(0)
    control.close()


def test_the_clock_of_another_process(server, context):
    offset, uncertainty = clock_offset(ControlClient("stub", context=context))
    assert abs(offset) <= uncertainty < 50_000_000  # the same clock: the true offset is 0
