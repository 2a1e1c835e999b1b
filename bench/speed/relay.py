"""One process of a relay of four hops, for bench/speed/peers.py: source, three nodes that hand on, controller.

    python bench/speed/relay.py TRANSPORT WHERE POSITION SIZES

Position 0 is both ends: for each line on its input, a number of frames, it sends so many at 22 a second and prints how
long each took to come back, ms, as JSON. Positions 1 to 3 are the nodes between. Imports nothing of the project but for
the transport "eitskin": rclpy runs in the Python of `make ros-venv`. Messages have the sizes of the service's hops;
their first 16 bytes say which one and when it was sent.
"""

from __future__ import annotations

import json
import os
import queue
import struct
import sys
import time
from typing import Any

RATE_HZ = 22.0
SETTLE_S, LOST_S = 3.0, 1.0
TOKEN = struct.Struct("<QQ")  # number, monotonic ns


class Bytes:
    """A transport of bytes: messages of the given size that begin with the token."""

    def __init__(self, size: int) -> None:
        self.padding = bytes(size - TOKEN.size)
        self.arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def take(self, timeout_s: float) -> bytes | None:
        """The next message, from a transport that calls back."""
        try:
            return self.arrived.get(timeout=max(timeout_s, 1e-4))
        except queue.Empty:
            return None

    def put(self, message: bytes) -> None:
        raise NotImplementedError

    def send(self, token: bytes) -> None:
        self.put(token + self.padding)

    def recv(self, timeout_s: float) -> bytes | None:
        message = self.take(timeout_s)
        return None if message is None else message[: TOKEN.size]


class Zmq(Bytes):
    """Bare pyzmq over ipc."""

    def __init__(self, where: str, reads: int, writes: int, size: int) -> None:
        import zmq

        super().__init__(size)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self.out, self.into = context.socket(zmq.PUB), context.socket(zmq.SUB)
        self.out.bind(f"ipc://{where}/zmq{writes}")
        self.into.connect(f"ipc://{where}/zmq{reads}")
        self.into.subscribe(b"")

    def put(self, message: bytes) -> None:
        self.out.send(message)

    def take(self, timeout_s: float) -> bytes | None:
        return self.into.recv() if self.into.poll(int(timeout_s * 1000)) else None


class Zenoh(Bytes):
    """eclipse-zenoh, peers joined by TCP on the loopback interface; it has no other way inside one host."""

    def __init__(self, where: str, reads: int, writes: int, size: int) -> None:
        import zenoh

        super().__init__(size)
        first = int(where)
        config = zenoh.Config()
        for key, value in (
            ("mode", "peer"),
            ("scouting/multicast/enabled", False),
            ("scouting/gossip/enabled", False),
            ("listen/endpoints", [f"tcp/127.0.0.1:{first + writes}"]),
            ("connect/endpoints", [f"tcp/127.0.0.1:{first + reads}"]),
        ):
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.out = self.session.declare_publisher(f"relay/{writes}", express=True)
        self.into = self.session.declare_subscriber(
            f"relay/{reads}", lambda sample: self.arrived.put(sample.payload.to_bytes())
        )

    def put(self, message: bytes) -> None:
        self.out.put(message)


class Ros(Bytes):
    """rclpy (ROS 2), best effort, the newest message."""

    def __init__(self, where: str, reads: int, writes: int, size: int) -> None:
        import array
        import threading

        import rclpy
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from std_msgs.msg import UInt8MultiArray

        super().__init__(size)
        rclpy.init()
        node = rclpy.create_node(f"relay{writes}")
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.message: Any = lambda data: UInt8MultiArray(data=array.array("B", data))
        self.out = node.create_publisher(UInt8MultiArray, f"relay{writes}", newest)
        node.create_subscription(
            UInt8MultiArray, f"relay{reads}", lambda got: self.arrived.put(got.data.tobytes()), newest
        )
        threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()

    def put(self, message: bytes) -> None:
        self.out.publish(self.message(message))


class Eitskin:
    """The service's own sockets and frames: checked, packed, unpacked at every hop."""

    def __init__(self, where: str, reads: int, writes: int, size: int) -> None:
        from pathlib import Path

        sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
        from bench.speed.relay_frames import HOPS, hop
        from protocol.sockets import NewestReader, Publisher

        self.frame = hop(writes)
        self.out = Publisher(HOPS[writes][0], address=f"ipc://{where}/eitskin{writes}")
        self.into = NewestReader(HOPS[reads][1], "palm", endpoint=f"ipc://{where}/eitskin{reads}")

    def send(self, token: bytes) -> None:
        self.frame.scan, self.frame.stamps["sample"] = TOKEN.unpack(token)
        self.out.send(self.frame)

    def recv(self, timeout_s: float) -> bytes | None:
        got = self.into.recv(timeout_s)
        return None if got is None else TOKEN.pack(got.scan, got.stamps["sample"])


TRANSPORTS = {"zmq": Zmq, "zenoh": Zenoh, "rclpy": Ros, "eitskin": Eitskin}


def relay(link: Any) -> None:
    """Hands on until the benchmark is gone."""
    parent = os.getppid()
    while os.getppid() == parent:
        token = link.recv(1.0)
        if token is not None:
            link.send(token)


def ends(link: Any, frames: int) -> list[float]:
    """Milliseconds of each frame that came back."""
    took, due = [], time.monotonic()
    while link.recv(0.0) is not None:
        pass
    for number in range(1, frames + 1):
        time.sleep(max(0.0, due - time.monotonic()))
        due += 1 / RATE_HZ
        sent = time.monotonic_ns()
        link.send(TOKEN.pack(number, sent))
        token = link.recv(LOST_S)
        if token is not None and TOKEN.unpack(token) == (number, sent):
            took.append((time.monotonic_ns() - sent) * 1e-6)
    return took


def main() -> None:
    transport, where, position, sizes = sys.argv[1], sys.argv[2], int(sys.argv[3]), json.loads(sys.argv[4])
    link = TRANSPORTS[transport](where, (position - 1) % len(sizes), position, sizes[position])
    if position:
        relay(link)
    time.sleep(SETTLE_S)  # until all have found each other
    for line in sys.stdin:
        print(json.dumps(ends(link, int(line))), flush=True)


if __name__ == "__main__":
    main()
