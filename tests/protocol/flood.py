"""A peer that does too much, `python tests/protocol/flood.py ADDRESS COUNT [LENGTH]`: different subscriptions."""

import sys

import zmq


def main(address, count, length="20"):
    socket = zmq.Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, 0)
    for number in range(int(count)):
        socket.subscribe(b"contact/palm%020d" % (number * 2654435761 % 10**9) + bytes(int(length) - 20))
    socket.connect(address)  # now, with all of it ready to be sent at once
    print(count, flush=True)
    while True:  # it goes on as long as it is let: a subscriber sends all again whenever it is connected anew
        socket.poll(100, zmq.POLLERR)
        socket.subscribe(b"more")
        socket.unsubscribe(b"more")


if __name__ == "__main__":
    main(*sys.argv[1:])
