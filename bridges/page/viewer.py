"""One browser: what it is sent, at its own pace, and what it asks for."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import msgpack
from aiohttp import WSCloseCode, WSMsgType, web

from bridges.door import hurry
from protocol.errors import EitskinError
from protocol.logs import foreign

from .feed import NEWEST, Latest, Reconstruction, SkinFeed

MOST_UNREAD = 2
"""Messages on their way that the browser has not yet said to have read; further frames replace each other here."""
PAUSE_S = 0.03
"""At least so long between two messages: 30 pictures a second are what a person sees."""
MOST_NAME = 64
AT_ONCE = 8
"""Commands under way for one browser; a further one is refused."""

log = logging.getLogger(__name__)

LONGEST_REASON = 123
"""Of a WebSocket's end, in bytes."""

Command = Callable[[str, str, dict[str, Any], str], Awaitable[dict[str, Any]]]
"""(skin, command, arguments, token) -> the answer, as the browser gets it."""


class NotUnderstood(EitskinError, ValueError):
    """A browser says what the page's own does not. The text says what was found and what was expected."""


class Viewer:
    def __init__(self, socket: web.WebSocketResponse, feeds: Mapping[str, SkinFeed], command: Command) -> None:
        self._socket, self._feeds, self._command = socket, feeds, command
        self._feed: SkinFeed | None = None
        self.name = ""
        """What it looks at: a skin's name, or that of the replay; "" for nothing yet."""
        self._topics: frozenset[str] = frozenset()
        self._sent: dict[str, int] = {}  # version by key
        self._pictures: dict[str, Reconstruction | None] = {}  # that the browser has, by topic
        self._unread = 0
        self._news = False  # since the last message
        self._go, self._wants = asyncio.Event(), asyncio.Event()
        self._under_way: set[asyncio.Task[None]] = set()

    def tell(self) -> None:
        """There is news."""
        self._news = True
        self._go.set()

    async def run(self, hello: dict[str, Any], hurried: bool) -> None:
        """Until the browser leaves or is not understood; `hurried`: or does not soon say what it wants."""
        await self._socket.send_bytes(msgpack.packb(hello))
        tasks = [asyncio.create_task(self._send())]
        if hurried:
            tasks.append(asyncio.create_task(hurry(self._socket, self._wants)))
        try:
            async for message in self._socket:
                if message.type is WSMsgType.TEXT:
                    await self._asked(_understood(message.data))
        except NotUnderstood as why:
            log.warning("a browser is sent away: %s", why)
            reason = str(why).encode("ascii", "replace")[:LONGEST_REASON]
            await self._socket.close(code=WSCloseCode.INVALID_TEXT, message=reason)
        finally:
            for task in tasks:
                task.cancel()
            self._look_at(None, frozenset())
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send(self) -> None:
        while True:
            await self._go.wait()
            self._go.clear()
            if self._unread >= MOST_UNREAD or self._feed is None:
                continue
            self._news = False
            batch = self._batch(self._feed)
            if not batch:
                continue
            self._unread += 1
            answer = {"kind": "frames", "skin": self.name, "now": time.monotonic_ns(), "frames": batch}
            await self._socket.send_bytes(msgpack.packb(answer))
            await asyncio.sleep(PAUSE_S)

    def _batch(self, feed: SkinFeed) -> list[tuple[int | None, bytes]]:
        """[when measured, message] of what the browser does not have yet, oldest first."""
        new: list[Latest] = []
        for key, latest in feed.latest.items():
            topic = key.partition("/")[0]
            if self._sent.get(key) == latest.version or topic in NEWEST and topic not in self._topics:
                continue
            self._sent[key] = latest.version
            if latest.picture is not None and self._pictures.get(topic) != latest.picture:
                brought = feed.pictures.get(topic)
                if brought is not None and brought.picture == latest.picture:
                    self._pictures[topic] = latest.picture
                    if brought is not latest:
                        new.append(brought)
            new.append(latest)
        return [(latest.measured_ns, latest.message) for latest in sorted(new, key=lambda each: each.version)]

    async def _asked(self, said: dict[str, Any]) -> None:
        """What the browser says: {ack}, {ping}, {skin, want}, {command, args, id, token}."""
        if "ack" in said:
            self._unread = max(0, self._unread - 1)
            if self._news:  # that had to wait
                self._go.set()
        elif "ping" in said:
            await self._answer({"kind": "pong", "ping": said["ping"], "now": time.monotonic_ns()})
        elif "want" in said:
            self._wants.set()
            topics = said["want"] if isinstance(said["want"], list) else []
            self.name = str(said.get("skin"))[:MOST_NAME]
            self._look_at(self._feeds.get(self.name), frozenset(t for t in NEWEST if t in topics), anew=True)
        elif "command" in said:
            if len(self._under_way) >= AT_ONCE:
                await self._answer({"kind": "answer", "id": said.get("id"), "ok": False, "error": "too many at once"})
                return
            task = asyncio.create_task(self._carry_out(said))
            self._under_way.add(task)
            task.add_done_callback(self._under_way.discard)

    async def _carry_out(self, said: dict[str, Any]) -> None:
        args = said.get("args")
        answer = await self._command(
            str(said.get("skin")),
            str(said["command"]),
            args if isinstance(args, dict) else {},
            str(said.get("token", "")),
        )
        await self._answer({"kind": "answer", "id": said.get("id"), **answer})

    async def _answer(self, answer: dict[str, Any]) -> None:
        if not self._socket.closed:
            await self._socket.send_bytes(msgpack.packb(answer))

    async def close(self) -> None:
        """Send the browser away; it will look for us again."""
        await self._socket.close(code=WSCloseCode.GOING_AWAY)

    def _look_at(self, feed: SkinFeed | None, topics: frozenset[str], anew: bool = False) -> None:
        """Look at these topics of this skin, and no more at others. anew: the browser knows nothing of them yet."""
        before, self._feed = self._feed, feed
        gone, self._topics = self._topics, topics
        if feed is not None:
            feed.watch(topics)
        if before is not None:
            before.unwatch(gone)
        if anew:
            self._sent, self._pictures, self._unread = {}, {}, 0
            self._go.set()


def _understood(text: str) -> dict[str, Any]:
    """A message of a browser. Raises NotUnderstood, also for what msgpack could not send back."""
    try:
        said = json.loads(text)
        msgpack.packb(said)  # half a surrogate pair, 2**70, thousands of levels
    except (ValueError, OverflowError, RecursionError) as bad:
        raise NotUnderstood(f"found {foreign(text, 30)} ({foreign(bad, 40)}), expected JSON of text, numbers") from None
    if not isinstance(said, dict) or not said.keys() & {"ack", "ping", "want", "command"}:
        raise NotUnderstood(f"found {foreign(text, 30)}, expected a map with ack, ping, want or command")
    return said
