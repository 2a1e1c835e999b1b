"""A Foxglove viewer for tests: its WebSocket protocol, with messages decoded by the schemas that the server sends."""

import asyncio
import base64
import json
import struct
from collections import defaultdict
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from tornado.websocket import WebSocketClientConnection, websocket_connect

PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA, SERVICE_RESPONSE = 1, 3


def decoded(encoding: str, name: str, schema: bytes, data: bytes) -> dict[str, Any]:
    """A message in JSON or in protobuf, by the schema that came with it."""
    if encoding == "json":
        return json.loads(data)
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return json_format.MessageToDict(kind.FromString(data), preserving_proto_field_name=True)


class Viewer:
    """Connected to one server; `channels` and `services` by name, once it has told."""

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self._connection, self.close = connection, connection.close
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, int] = {}
        self.times: dict[str, list[int]] = defaultdict(list)  # [ns] of what has come, by topic
        self._subscribed: dict[int, str] = {}

    @staticmethod
    async def connect(url: str):
        return Viewer(await websocket_connect(url, subprotocols=[PROTOCOL]))

    async def message(self, wanted: str = "") -> Any:
        """What comes next; of a topic: its time [ns] and what is in it; or from a "service"."""
        while True:
            got = await asyncio.wait_for(self._connection.read_message(), 20)
            assert got is not None, "the server ended the connection"
            if isinstance(got, str):
                said = json.loads(got)
                self.channels |= {channel["topic"]: channel for channel in said.get("channels", [])}
                self.services |= {service["name"]: service["id"] for service in said.get("services", [])}
            elif got[0] == MESSAGE_DATA:
                number, ns = struct.unpack_from("<IQ", got, 1)
                topic = self._subscribed[number]
                self.times[topic].append(ns)
                channel = self.channels[topic]
                schema = base64.b64decode(channel["schema"]) if channel["encoding"] != "json" else b""
                if topic == wanted:
                    return ns, decoded(channel["encoding"], channel["schemaName"], schema, got[13:])
            elif got[0] == SERVICE_RESPONSE and wanted == "service":
                return json.loads(got[13 + struct.unpack_from("<III", got, 1)[2] :])
            if not wanted:
                return None

    async def subscribe(self, *topics: str) -> None:
        while not set(topics) <= self.channels.keys():
            await self.message()
        numbered = {len(self._subscribed) + k: topic for k, topic in enumerate(topics, 1)}
        self._subscribed |= numbered
        wanted = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in numbered.items()]
        await self._connection.write_message(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def call(self, name: str, **args: Any) -> dict[str, Any]:
        while name not in self.services:
            await self.message()
        request = struct.pack("<BIII", 2, self.services[name], 1, 4) + b"json" + json.dumps(args).encode()
        await self._connection.write_message(request, binary=True)
        return await self.message("service")
