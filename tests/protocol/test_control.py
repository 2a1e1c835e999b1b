"""Commands: typed answers, whatever is asked; and no caller that hangs."""

import threading
import time

import msgpack
import pytest
import zmq

from protocol.commands import COMMANDS, Argument, Command, Content
from protocol.control import BUSY
from protocol.fields import Bool, Float, Int, Text
from protocol.runtime import control_endpoint
from protocol.sockets import ControlClient, ControlError, ControlServer, clock_offset

pytestmark = pytest.mark.live


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
        commands={
            "needs": Command("test", "", {"x": Argument(Int(), "a number", needed=True)}),
            "press": Command(
                "test",
                "",
                {"x": Argument(Float(unit="m"), ""), "shape": Argument(Text(), ""), "n": Argument(Int(), "")},
            ),
            **{name: Command("test", "") for name in ("fail", "refuse", "slow", "odd")},
        },
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
        ("needs", "bad_request", "needs, argument x: found none, expected a whole number: a number"),
    ],
)
def test_a_failing_command_is_a_typed_error_and_the_server_lives(server, context, command, kind, says):
    client = ControlClient("stub", context=context)
    with pytest.raises(ControlError, match=says) as caught:
        client.call(command)
    assert caught.value.kind == kind
    assert client.call("press") == {"got": {}}


@pytest.fixture
def all_commands(runtime, context):
    """Every command of the table, each of which notes with what it was carried out; gives those notes."""
    carried_out = []
    handlers = {name: lambda args, name=name: carried_out.append((name, args)) or {} for name in COMMANDS}
    own, stop = ControlServer("stub", handlers, context=context), threading.Event()
    thread = threading.Thread(target=lambda: [own.serve_once(0.02) for _ in iter(stop.is_set, True)])
    thread.start()
    yield carried_out
    stop.set()
    thread.join()
    own.close()


RIGHT = {Bool: True, Float: 1.5, Int: 1, Text: "x", Content: {"a": 1}}
WRONG = {
    Bool: ("no", "true", "", 0, 1, 1.0, [], {}, b"\1"),
    Float: ("1", True, [1.0], {}, float("nan"), float("inf"), -float("inf"), b""),
    Int: ("1", True, 1.5, float("nan"), [1]),
    Text: (1, True, ["x"], {}, b"x", "x" * 5000),
    Content: ("x", 1, True, []),
}
ARGUMENTS = [(name, key) for name, command in COMMANDS.items() for key in command.arguments]


def right(name):
    return {key: RIGHT[type(argument.check)] for key, argument in COMMANDS[name].arguments.items()}


@pytest.mark.parametrize(("name", "key"), ARGUMENTS)
def test_an_argument_of_another_type_carries_nothing_out(all_commands, context, name, key):
    """`tare` with force: "no" is no tare by force."""
    client = ControlClient("stub", context=context)
    for wrong in WRONG[type(COMMANDS[name].arguments[key].check)]:
        with pytest.raises(ControlError, match=f"{name}, argument {key}: found .*, expected ") as refused:
            client.call(name, **{**right(name), key: wrong})
        assert refused.value.kind == "bad_request" and len(str(refused.value)) < 300, wrong
    assert not all_commands


@pytest.mark.parametrize("name", COMMANDS)
def test_arguments_of_their_types_are_handed_on(all_commands, context, name):
    client, given = ControlClient("stub", context=context), right(name)
    client.call(name, **given)
    needed = {key for key, argument in COMMANDS[name].arguments.items() if argument.needed}
    client.call(name, **{key: value if key in needed else None for key, value in given.items()})
    with pytest.raises(ControlError, match=f"{name}: found the argument forse, expected (only|no argument)"):
        client.call(name, **given, forse=True)
    for key in needed:
        for without in ({k: v for k, v in given.items() if k != key}, {**given, key: None}):
            with pytest.raises(ControlError, match=f"{name}, argument {key}: found none, expected "):
                client.call(name, **without)
    if name != "clock":  # which is the server's own
        assert all_commands == [(name, given), (name, {key: given[key] for key in needed})]


def test_a_command_without_its_arguments_in_the_table_is_not_taken(runtime, context):
    with pytest.raises(ValueError, match="no command melt in protocol/commands.py"):
        ControlServer("stub", {"melt": lambda args: {}}, context=context)


@pytest.mark.parametrize("message", ["", "  "])
def test_a_refusal_without_a_word_says_at_least_of_what(runtime, context, message):
    socket = context.socket(zmq.REP)
    socket.bind(control_endpoint("stub"))

    def answer():
        assert socket.poll(3000)
        socket.recv()
        socket.send(msgpack.packb({"ok": False, "error": {"type": "refused", "message": message}}))

    thread = threading.Thread(target=answer)
    thread.start()
    with pytest.raises(ControlError, match="stub refused tare without saying why .refused.") as refused:
        ControlClient("stub", context=context).call("tare")
    assert refused.value.kind == "refused"
    thread.join()
    socket.close(0)


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
            socket.send(msgpack.packb({"command": command, "args": {"scan": 1} if command == "part" else {}}))
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
