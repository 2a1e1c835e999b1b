"""A peer that does too much: `python tests/protocol/flood.py subscribe|lengthy|command ADDRESS COUNT`. Plain ZeroMQ,
nothing of ours. `subscribe`: COUNT different subscriptions from one socket; `lengthy`: each of 600 bytes. `command`:
COUNT requests `state`, no answer read.
"""

import os
import sys
import time

import msgpack
import zmq


def main(what: str, address: str, count: int) -> None:
    socket = zmq.Context.instance().socket(zmq.DEALER if what == "command" else zmq.SUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, 0)
    if what == "command":
        socket.connect(address)
    began = time.monotonic()
    request = msgpack.packb({"command": "state", "args": {}})
    for number in range(count):
        if what == "subscribe":
            socket.subscribe(b"contact/palm%020d" % (number * 2654435761 % 10**9))
        elif what == "lengthy":
            socket.subscribe(os.urandom(600))
        else:
            socket.send_multipart([b"", request])
    if what != "command":
        socket.connect(address)  # now, with all of it ready to be sent at once
    print(f"{count} in {time.monotonic() - began:.1f} s", flush=True)
    while True:  # it goes on as long as it is let: a subscriber sends all again whenever it is connected anew
        socket.poll(100, zmq.POLLERR)
        if what != "command":
            socket.subscribe(b"more")
            socket.unsubscribe(b"more")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
