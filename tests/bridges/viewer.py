"""A Foxglove viewer for tests: its WebSocket protocol, with messages decoded by the schemas that the server sends."""

from __future__ import annotations

import asyncio
import base64
import json
import struct
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

PROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA, SERVICE_RESPONSE = 1, 3


class Viewer:
    """Connected to one server; `channels` and `services` by name, once it has told."""

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self._connection = connection
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, int] = {}
        self._subscribed: dict[int, str] = {}

    @staticmethod
    async def connect(url: str) -> Viewer:
        connection = await websocket_connect(HTTPRequest(url, request_timeout=20), subprotocols=[PROTOCOL])
        return Viewer(connection)

    async def _next(self) -> tuple[str, Any]:
        """The next that the server says: ("text", JSON), or the topic or "service" with what came."""
        got = await asyncio.wait_for(self._connection.read_message(), 20)
        assert got is not None, "the server ended the connection"
        if isinstance(got, str):
            said = json.loads(got)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
            elif said["op"] == "advertiseServices":
                self.services |= {service["name"]: service["id"] for service in said["services"]}
            return "text", said
        if got[0] == MESSAGE_DATA:
            number, ns = struct.unpack_from("<IQ", got, 1)
            topic = self._subscribed[number]
            return topic, (ns, self._decode(topic, got[13:]))
        if got[0] == SERVICE_RESPONSE:
            _, _, length = struct.unpack_from("<III", got, 1)
            return "service", json.loads(got[13 + length :])
        return "other", got

    async def told(self, *topics: str) -> None:
        """Wait until the server has told of these channels."""
        while not set(topics) <= self.channels.keys():
            await self._next()

    async def subscribe(self, *topics: str) -> None:
        await self.told(*topics)
        numbered = {len(self._subscribed) + k: topic for k, topic in enumerate(topics, 1)}
        self._subscribed |= numbered
        wanted = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in numbered.items()]
        await self._connection.write_message(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def message(self, topic: str) -> tuple[int, dict[str, Any]]:
        """The next message of a topic: its time [ns] and what is in it."""
        while True:
            found, got = await self._next()
            if found == topic:
                return got  # type: ignore[no-any-return]

    async def call(self, name: str, **args: Any) -> dict[str, Any]:
        while name not in self.services:
            await self._next()
        request = struct.pack("<BIII", 2, self.services[name], 1, 4) + b"json" + json.dumps(args).encode()
        await self._connection.write_message(request, binary=True)
        while True:
            found, got = await self._next()
            if found == "service":
                return got  # type: ignore[no-any-return]

    def _decode(self, topic: str, data: bytes) -> dict[str, Any]:
        channel = self.channels[topic]
        if channel["encoding"] == "json":
            return json.loads(data)  # type: ignore[no-any-return]
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
        return json_format.MessageToDict(kind.FromString(data), preserving_proto_field_name=True)

    def close(self) -> None:
        self._connection.close()
