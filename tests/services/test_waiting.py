"""Waiting for many sockets: nothing is missed, whatever was read of what waits."""

import os
import time
from collections.abc import Iterator

import pytest
import zmq

from protocol.transport import Socket
from services.runtime.waiting import Waiter

pytestmark = pytest.mark.live

MANY = 40


@pytest.fixture
def context() -> Iterator["zmq.Context[Socket]"]:
    made: zmq.Context[Socket] = zmq.Context()
    yield made
    made.destroy(0)


@pytest.fixture
def waiter() -> Iterator[Waiter]:
    made = Waiter()
    yield made
    made.close()


def pair(context: "zmq.Context[Socket]", name: str, *, conflate: bool = False) -> tuple[Socket, Socket]:
    """(sender, receiver)"""
    send, receive = context.socket(zmq.PUSH), context.socket(zmq.PULL)
    receive.setsockopt(zmq.CONFLATE, int(conflate))
    receive.bind(f"inproc://{name}")
    send.connect(f"inproc://{name}")
    return send, receive


def test_only_what_has_something_comes(context: "zmq.Context[Socket]", waiter: Waiter) -> None:
    pairs = [pair(context, str(k)) for k in range(MANY)]
    for _, receive in pairs:
        waiter.register(receive)
    _read_all(waiter, 0.1)
    pairs[7][0].send(b"x")
    pairs[30][0].send(b"x")
    found = set(map(id, waiter.wait(1.0) + waiter.wait(0.0)))
    assert found == {id(pairs[7][1]), id(pairs[30][1])}


def test_what_is_not_read_empty_comes_again(context: "zmq.Context[Socket]", waiter: Waiter) -> None:
    send, receive = pair(context, "a")
    waiter.register(receive)
    for _ in range(5):
        send.send(b"x")
    for _ in range(5):  # one each time, as a channel that takes the newest does
        assert receive in waiter.wait(1.0)
        assert receive.recv(zmq.NOBLOCK) == b"x"
    assert waiter.wait(0.0) == [] or waiter.wait(0.0) == []  # asked once more, then silent


def test_a_message_between_reading_and_waiting_is_not_missed(context: "zmq.Context[Socket]", waiter: Waiter) -> None:
    """The descriptor does not wake again for a message that came while the socket was read."""
    send, receive = pair(context, "a", conflate=True)
    waiter.register(receive)
    for k in range(2000):
        send.send(b"%d" % k)
        assert receive in waiter.wait(1.0), k
        send.send(b"%d again" % k)  # its signal is taken by the read below, or is not
        first = receive.recv(zmq.NOBLOCK)
        if first == b"%d" % k:
            assert receive in waiter.wait(1.0), k
            assert receive.recv(zmq.NOBLOCK) == b"%d again" % k


def test_plain_descriptors_and_time(waiter: Waiter) -> None:
    event = os.eventfd(0, os.EFD_NONBLOCK)
    waiter.register(event)
    began = time.monotonic()
    assert waiter.wait(0.05) == []
    assert time.monotonic() - began >= 0.049
    os.eventfd_write(event, 1)
    assert waiter.wait(1.0) == [event] and waiter.wait(0.0) == [event]
    os.eventfd_read(event)
    assert waiter.wait(-1.0) == []  # a deadline that is over
    os.close(event)


def test_doubt_finds_what_another_use_of_the_socket_hid(context: "zmq.Context[Socket]", waiter: Waiter) -> None:
    send, receive = pair(context, "a")
    waiter.register(receive)
    _read_all(waiter, 0.05)
    send.send(b"x")
    receive.get(zmq.EVENTS)  # takes the signal
    waiter.doubt()
    assert waiter.wait(0.0) == [receive]


def _read_all(waiter: Waiter, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        waiter.wait(0.01)
