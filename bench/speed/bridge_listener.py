"""The other side of a bridge, in a process of its own, for bench/speed/bridges.py: prints a line for each message, when
the skin was measured by the message's own time [Unix ns] and when it came [monotonic ns].

    python -m bench.speed.bridge_listener ros2 DOMAIN
    python -m bench.speed.bridge_listener foxglove ws://127.0.0.1:PORT
"""

from __future__ import annotations

import asyncio
import json
import struct
import sys
import time
from typing import Any


def ros2(domain: int) -> None:
    """Reads the wrench over DDS."""
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from bridges.ros2 import dds

    dds.configure("lo")
    participant = DomainParticipant(domain)
    topic: Topic[Any] = Topic(participant, "rt/eitskin/palm/wrench", dds.idl_type("geometry_msgs/WrenchStamped"))
    qos = Qos(
        Policy.Reliability.Reliable(100_000_000),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    reader: DataReader[Any] = DataReader(participant, topic, qos)
    waiting = WaitSet(participant)
    condition = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Alive)
    waiting.attach(condition)
    while True:
        waiting.wait(1_000_000_000)
        for sample in reader.take(20):
            at = time.monotonic_ns()
            stamp = sample.header.stamp
            print(stamp.sec * 1_000_000_000 + stamp.nanosec, at, flush=True)


async def foxglove(url: str) -> None:
    """Looks at forces and scene, as the application would; the forces count."""
    from tornado.httpclient import HTTPRequest
    from tornado.websocket import websocket_connect

    connection = await websocket_connect(HTTPRequest(url), subprotocols=["foxglove.sdk.v1"])
    wanted = {"/palm/forces": 1, "/palm/scene": 2, "/palm/image": 3}
    while (got := await connection.read_message()) is not None:
        at = time.monotonic_ns()
        if isinstance(got, str):
            said = json.loads(got)
            found = [c for c in said.get("channels", []) if c["topic"] in wanted]
            if said["op"] == "advertise" and found:
                asked = [{"id": wanted[c["topic"]], "channelId": c["id"]} for c in found]
                await connection.write_message(json.dumps({"op": "subscribe", "subscriptions": asked}))
        elif got[0] == 1:
            number, ns = struct.unpack_from("<IQ", got, 1)
            if number == wanted["/palm/forces"]:
                print(ns, at, flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "ros2":
        ros2(int(sys.argv[2]))
    else:
        asyncio.run(foxglove(sys.argv[2]))
