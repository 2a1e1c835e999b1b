"""The bridge to Foxglove: its live server, fed while somebody looks."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable

import foxglove
from foxglove import Capability, Context

from bridges.clock import WallClock
from bridges.door import Door, kept_token
from bridges.process import Bridge, BridgedSkin, BridgeError, Handed, openable
from protocol.feeds import ContactFeed, ImageFeed, Measured, NewestFeed, Refusal
from protocol.frames import InfoFrame, ShapeFrame
from protocol.sockets import AllReader
from protocol.transport import Socket

from .channels import FoxgloveChannels, Outlines
from .front import Front, hidden_address
from .orders import services

BACKLOG = 64  # messages held for a viewer that does not read; the oldest go first
PLACE_AGAIN_S = 5.0  # how often outline and pose are sent again, for who came late

log = logging.getLogger(__name__)


class ShownSkin:
    """One skin: what is read of it while somebody looks."""

    def __init__(
        self, name: str, skin: BridgedSkin, context: Context, clock: WallClock, replay: bool, rate_hz: float
    ) -> None:
        self.name, self._clock = name, clock
        self.channels = FoxgloveChannels(name, skin.frame_id, context)
        self.contacts, self.images = ContactFeed(name, replay, rate_hz=rate_hz), ImageFeed(name, replay)
        self.state: Measured | Refusal | None = None
        self._shapes = NewestFeed("shape", name)
        self._outlines: tuple[str, Outlines] = "", {}  # session, outline of each contact
        self._said = ""
        self._info: InfoFrame | None = None
        self._placed = 0.0

    @property
    def wanted(self) -> bool:
        """Whether anybody looks."""
        c = self.channels
        return any(channel.has_sinks() for channel in (c.image, c.scene, c.forces, c.log))

    def look(self) -> None:
        """Who looks at what; we subscribe to what that needs."""
        c = self.channels
        self.contacts.want(c.scene.has_sinks() or c.forces.has_sinks() or c.log.has_sinks())
        self.images.want(c.image.has_sinks())
        self._shapes.want(c.scene.has_sinks())
        if (silent := self.contacts.silence()) is not None:
            self.state = silent
            self._say(silent.why)
        if self._info is not None and c.scene.has_sinks() and time.monotonic() - self._placed > PLACE_AGAIN_S:
            self.place(self._info)

    def sockets(self) -> Iterable[Socket]:
        yield from self.contacts.sockets()
        yield from self.images.sockets()

    def take(self, waited_ns: int) -> Measured | Refusal | None:
        """Hand on what has come; the contacts among it."""
        found = self.contacts.take(waited_ns)
        if found is not None:
            self.state = found
            if isinstance(found, Refusal):
                self._say(found.why)
            else:
                reasons = ", ".join(found.frame.reasons)
                self._say(f"valid, but {reasons}" if reasons else "valid")
                age_ms = (time.monotonic_ns() - found.measured_ns) * 1e-6
                ns = self._clock.time_ns(found.measured_ns)
                self.channels.put_contacts(found.frame, ns, self._outlines_of(found.frame.session), age_ms)
        if (picture := self.images.take(waited_ns)) is not None:
            self.channels.put_image(picture.frame, self._clock.time_ns(picture.measured_ns))
        return found

    def place(self, frame: InfoFrame) -> None:
        """Outline and pose."""
        self._info, self._placed = frame, time.monotonic()
        self.channels.put_place(frame, self._clock.time_ns(time.monotonic_ns()))

    def _outlines_of(self, session: str) -> Outlines:
        """Those of the newest shapes, where they are of this session's contacts."""
        frame = self._shapes.recv()
        if isinstance(frame, ShapeFrame) and frame.valid:
            self._outlines = frame.session, dict(zip(frame.ids, frame.outlines, strict=True))
        return self._outlines[1] if self._outlines[0] == session else {}

    def _say(self, text: str) -> None:
        """A line of log where something changed; numbers alone are no change."""
        kind = "".join(c for c in text if not c.isdigit())
        if kind != self._said:
            self._said = kind
            self.channels.put_log(text, self._clock.time_ns(time.monotonic_ns()))

    def close(self) -> None:
        self.contacts.close()
        self.images.close()
        self._shapes.close()


class FoxgloveBridge(Bridge):
    """All skins on one server."""

    def __init__(self, handed: Handed) -> None:
        super().__init__("foxglove", handed)
        options = handed.options
        host, port = str(options.get("host", "127.0.0.1")), int(options.get("port", 8765))
        secret, hidden = kept_token("foxglove"), hidden_address()
        self._clock = WallClock()
        self._context = context = Context()  # channels are closed with it
        logging.getLogger("foxglove").setLevel(logging.WARNING)  # it tells of each viewer
        replay, rate_hz = bool(options.get("replay")), float(options["rate_hz"])
        self._skins = {n: ShownSkin(n, skin, context, self._clock, replay, rate_hz) for n, skin in handed.skins.items()}
        try:
            self._server = foxglove.start_server(
                name="eitskin",
                host=hidden,
                port=0,
                capabilities=[Capability.Services],
                supported_encodings=["json"],
                services=services(handed.skins, secret),
                context=context,
                message_backlog_size=BACKLOG,
            )
        except Exception as why:  # the SDK has no exception of its own
            raise BridgeError(f"no Foxglove server at {hidden}: {why}; start the bridge anew") from None
        door = Door(host, map(str, options.get("names", ())), secret)
        try:
            self._front = Front(door, port, f"http://{hidden}:{self._server.port}")
        except BridgeError:
            self._server.stop()
            raise
        print(
            f"foxglove: open ws://{openable(host)}:{door.port}/?token={secret} in Foxglove (Open connection); "
            f'services ask for "token": "{secret}"',
            flush=True,
        )
        self._told = AllReader(["info"])

    def sockets(self) -> Iterable[Socket]:
        yield self._told.socket
        for skin in self._skins.values():
            yield from skin.sockets()

    def serve(self, waited_ns: int) -> None:
        for name, skin in self._skins.items():
            pulse, taken_ns = self.pulses[name], time.monotonic_ns()
            found = skin.take(waited_ns)
            if found is not None:
                pulse.heard()
            if isinstance(found, Measured):
                pulse.handed_on(found.measured_ns, taken_ns)
        while (frame := self._told.recv(0.0)) is not None:
            if isinstance(frame, InfoFrame) and frame.skin in self._skins:
                self._skins[frame.skin].place(frame)

    def tick(self) -> None:
        self._clock.measure()
        for name, skin in self._skins.items():
            skin.look()
            pulse = self.pulses[name]
            pulse.idle = not skin.wanted
            pulse.sent.update({k: n - pulse.sent[k] for k, n in skin.channels.sent.items()})
            pulse.drops["skipped"], pulse.drops["late"] = skin.contacts.skipped, skin.contacts.late
            if not self._front.alive:
                pulse.level, pulse.messages = "ERROR", ["the server has stopped: start the bridge anew"]
            elif pulse.idle:
                pulse.level, pulse.messages = "OK", ["idle: nobody looks"]
            elif isinstance(skin.state, Refusal):
                pulse.level, pulse.messages = "WARN", [f"not shown: {skin.state.why}"]
            else:
                pulse.level, pulse.messages = "OK", []

    def close(self) -> None:
        self._front.close()
        self._server.stop()
        self._told.close()
        for skin in self._skins.values():
            skin.close()
