"""The bridge to ROS 2: from the service's frames to the topics of docs/ros.md.

What may not be acted on is not published: a wrench, a contact, a cloud that stops coming is the sign to stop, which
every ROS controller that looks at a message's age knows already. `/eitskin/SKIN/valid` and `/diagnostics` say why.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

from cyclonedds.core import DDSException
from cyclonedds.domain import DomainParticipant

from bridges import views
from bridges.clock import WallClock
from bridges.feeds import ContactFeed, ImageFeed, Measured, NewestFeed, Picture, Refusal
from bridges.process import Bridge, BridgeError, Handed
from protocol.control import ControlClient, ControlError
from protocol.frame_types import ELECTRODE_STATES
from protocol.frames import DeltaFrame, Frame, InfoFrame, StatusFrame
from protocol.sockets import AllReader
from protocol.transport import Socket

from . import dds, messages
from .dds import RosWriter
from .names import topic_base
from .reference import references
from .tare_service import Act, TareService

DIAGNOSTICS_S = 1.0
TARE_S = 10.0
VALID_S = 0.1
"""How often `valid` says false while nothing comes."""


class SkinTopics:
    """The topics of one skin."""

    def __init__(
        self,
        skin: str,
        frame_id: str,
        participant: DomainParticipant,
        clock: WallClock,
        replay: bool,
        rate_hz: float,
    ) -> None:
        base = topic_base(skin)
        self._frame_id, self._clock = frame_id, clock
        self.contacts = ContactFeed(skin, replay, rate_hz=rate_hz)
        self.images = ImageFeed(skin, replay)
        self.electrodes = NewestFeed("delta", skin)

        def writer(name: str, message: str, kind: dds.Kind = "state") -> RosWriter:
            return RosWriter(participant, f"{base}/{name}", message, kind)

        self.valid = writer("valid", "std_msgs/Bool")
        self.wrench = writer("wrench", "geometry_msgs/WrenchStamped")
        self.slots = [writer(f"contacts/slot{k}", "geometry_msgs/WrenchStamped") for k in range(messages.SLOTS)]
        self.poses = writer("contacts/poses", "geometry_msgs/PoseArray")
        self.markers = writer("contacts", "visualization_msgs/MarkerArray")
        self.cloud = writer("pressure", "sensor_msgs/PointCloud2", "sensor")
        self.image = writer("image", "sensor_msgs/Image", "sensor")
        self._of_contacts = (self.valid, self.wrench, *self.slots, self.poses, self.markers)
        self._of_images = (self.cloud, self.image)
        self.wanted: set[RosWriter] = set()
        self.state: Measured | Refusal | None = None
        """What the newest contact frame was, or why there is none."""
        self._shown: set[int] = set()  # contacts that have markers
        self._said_invalid = 0.0

    def writers(self) -> Iterable[RosWriter]:
        return (*self._of_contacts, *self._of_images)

    def sockets(self) -> Iterable[Socket]:
        yield from self.contacts.sockets()
        yield from self.images.sockets()

    def look(self, diagnostics: bool) -> None:
        """Who subscribes; we subscribe to what they want. `diagnostics`: somebody asks for the electrodes too."""
        self.wanted = {writer for writer in self.writers() if writer.wanted}
        self.contacts.want(diagnostics or not self.wanted.isdisjoint(self._of_contacts))
        self.images.want(not self.wanted.isdisjoint(self._of_images))
        self.electrodes.want(diagnostics)
        if (silent := self.contacts.silence()) is not None:
            self.state = silent
        if isinstance(self.state, Refusal) and time.monotonic() - self._said_invalid >= VALID_S:
            self._say_valid(False)

    def publish_contacts(self, found: Measured | Refusal) -> None:
        """Hand a contact frame on, or say that there is none to act on."""
        self.state = found
        if isinstance(found, Refusal):
            self._say_valid(False)
            return
        frame = found.frame
        header = self._header(found.measured_ns)
        contacts = views.present(frame)
        if views.has_forces(frame):
            if self.wrench in self.wanted:
                self.wrench.write(messages.wrench(header, contacts))
            for k, slot in enumerate(self.slots):
                if slot in self.wanted:
                    slot.write(messages.wrench(header, contacts[k : k + 1]))
        if self.poses in self.wanted:
            self.poses.write(messages.poses(header, frame))
        if self.markers in self.wanted:
            shown = {contact.id for contact in contacts}
            self.markers.write(messages.markers(header, frame, self._shown - shown))
            self._shown = shown
        if self.valid in self.wanted:
            self.valid.write({"data": True})

    def publish_image(self, found: Picture) -> None:
        """Hand an image on."""
        header = self._header(found.measured_ns)
        if self.cloud in self.wanted:
            self.cloud.write(messages.cloud(header, found.frame))
        if self.image in self.wanted:
            self.image.write(messages.image(header, found.frame))

    def electrode_states(self) -> list[str] | None:
        """The state of each electrode, by the newest scan; None where nothing has come since the last call."""
        frame = self.electrodes.recv()
        if not isinstance(frame, DeltaFrame):
            return None
        return [ELECTRODE_STATES[s] if s < len(ELECTRODE_STATES) else "unknown" for s in frame.electrodes.tolist()]

    def _say_valid(self, valid: bool) -> None:
        self._said_invalid = time.monotonic()
        if self.valid in self.wanted:
            self.valid.write({"data": valid})

    def _header(self, measured_ns: int) -> messages.Message:
        return {"stamp": messages.stamp(self._clock.time_ns(measured_ns)), "frame_id": self._frame_id}

    def close(self) -> None:
        self.contacts.close()
        self.images.close()
        self.electrodes.close()


class Ros2Bridge(Bridge):
    """All skins, on one DDS participant."""

    def __init__(self, handed: Handed) -> None:
        super().__init__("ros2", handed)
        options = handed.options
        dds.configure(options.get("interface", ""))
        try:
            domain = dds.domain_id(options.get("domain"))
            self._participant = DomainParticipant(domain)
        except (ValueError, DDSException) as why:
            raise BridgeError(
                f"no DDS participant: {why}; see [ros2] in skin.toml, ROS_DOMAIN_ID, CYCLONEDDS_URI"
            ) from None
        bases = ", ".join(topic_base(name) for name in handed.skins)
        print(f"ros2: publishing {bases} in ROS domain {domain}", flush=True)
        self._clock = WallClock()
        replay, rate_hz = bool(options.get("replay")), float(options["rate_hz"])
        self._skins = {
            name: SkinTopics(name, skin.frame_id, self._participant, self._clock, replay, rate_hz)
            for name, skin in handed.skins.items()
        }
        self._diagnostics = RosWriter(self._participant, "/diagnostics", "diagnostic_msgs/DiagnosticArray", "state")
        self._tf = RosWriter(self._participant, "/tf_static", "tf2_msgs/TFMessage", "latched")
        self._told = AllReader(["status", "info"])
        self._references = references(options.get("reference", {}), handed.skins, self._participant, self._clock)
        self._tare: TareService | None = None
        if options.get("commands"):
            acts = {topic_base(name): tare(name) for name in handed.skins}
            self._tare = TareService(domain, dds.interface(str(options.get("interface", ""))), acts)
        self._transforms: dict[str, messages.Message] = {}
        self._statuses: dict[tuple[str, str], tuple[StatusFrame, float]] = {}
        self._electrodes: dict[str, list[str]] = {}
        self._next_diagnostics = 0.0

    def sockets(self) -> Iterable[Socket]:
        yield self._told.socket
        for topics in self._skins.values():
            yield from topics.sockets()

    def serve(self, waited_ns: int) -> None:
        for name, topics in self._skins.items():
            pulse, taken_ns = self.pulses[name], time.monotonic_ns()
            if (found := topics.contacts.take(waited_ns)) is not None:
                topics.publish_contacts(found)
                pulse.heard()
                if isinstance(found, Measured):
                    pulse.handed_on(found.measured_ns, taken_ns)
            if (picture := topics.images.take(waited_ns)) is not None:
                topics.publish_image(picture)
        for _ in range(100):
            frame = self._told.recv(0.0)
            if isinstance(frame, StatusFrame):
                self._note(frame)
            elif isinstance(frame, InfoFrame):
                self._place(frame)
            elif frame is None:
                break

    def frames(self) -> Iterable[Frame]:
        for reference in self._references:
            yield from reference.frames()

    def _note(self, frame: StatusFrame) -> None:
        """A process says how it does."""
        if frame.skin not in self._skins:
            return
        key = frame.skin, frame.process
        before = self._statuses.get(key)
        self._statuses[key] = frame, time.monotonic()
        if before is None or before[0].level != frame.level:
            self._next_diagnostics = 0.0

    def _place(self, frame: InfoFrame) -> None:
        """Where a skin is: sent again only when it changes."""
        found = messages.transform(self._clock.time_ns(time.monotonic_ns()), frame)
        known = self._transforms.get(frame.skin)
        if found is None or frame.skin not in self._skins:
            return
        if known is not None and {**known, "header": None} == {**found, "header": None}:
            if known["header"]["frame_id"] == found["header"]["frame_id"]:
                return
        self._transforms[frame.skin] = found
        self._tf.write({"transforms": list(self._transforms.values())})

    def tick(self) -> None:
        self._clock.measure()
        diagnostics = self._diagnostics.wanted
        for name, topics in self._skins.items():
            topics.look(diagnostics)
            self._judge(name, topics)
        if diagnostics and time.monotonic() >= self._next_diagnostics:
            self._next_diagnostics = time.monotonic() + DIAGNOSTICS_S
            self._diagnose()

    def _judge(self, name: str, topics: SkinTopics) -> None:
        """How this skin's bridge does, for our own status."""
        pulse = self.pulses[name]
        pulse.idle = not topics.wanted
        pulse.sent.update({writer.name: writer.sent - pulse.sent[writer.name] for writer in topics.writers()})
        pulse.drops["skipped"], pulse.drops["late"] = topics.contacts.skipped, topics.contacts.late
        if pulse.idle:
            pulse.level, pulse.messages = "OK", ["idle: nobody subscribes"]
        elif isinstance(topics.state, Refusal):
            pulse.level, pulse.messages = "WARN", [f"not published: {topics.state.why}"]
        elif topics.state is None:
            pulse.level, pulse.messages = "STALE", ["no frame yet"]
        else:
            pulse.level, pulse.messages = "OK", []
            if not views.has_forces(topics.state.frame):
                pulse.level, pulse.messages = "WARN", ["no wrench is published: this skin has no force law"]

    def _diagnose(self) -> None:
        """Each process, each skin's electrodes, and what is published and why not."""
        now = time.monotonic()
        found = [messages.of_status(frame, now - at) for frame, at in self._statuses.values()]
        for name, topics in self._skins.items():
            states = self._electrodes.get(name, [])
            if (fresh := topics.electrode_states()) is not None:
                self._electrodes[name] = states = fresh
            bad = [f"{k} {state}" for k, state in enumerate(states) if state != "ok"]
            said = f"electrode {', '.join(bad)}" if bad else "all ok" if states else "not known"
            level = "WARN" if bad else "OK" if states else "STALE"
            values: dict[str, object] = {f"electrode {k}": state for k, state in enumerate(states)}
            found.append(messages.diagnostic(f"eitskin {name}: electrodes", name, level, said, values))
            found.append(self._contacts_diagnostic(name, topics))
        header = {"stamp": messages.stamp(self._clock.time_ns(time.monotonic_ns())), "frame_id": ""}
        self._diagnostics.write({"header": header, "status": found})

    def _contacts_diagnostic(self, name: str, topics: SkinTopics) -> messages.Message:
        state, rates = topics.state, self.pulses[name].rates
        values: dict[str, object] = {f"rate {topic} [Hz]": rate for topic, rate in rates.items() if rate}
        uncertain_ns = self._clock.uncertainty_ns
        if isinstance(state, Measured):
            uncertain_ns += state.frame.sample_sigma_ns
            level, said = "OK", "valid"
            if state.frame.reasons:
                level, said = "WARN", "valid, but " + ", ".join(state.frame.reasons)
            values["contacts"] = len(views.present(state.frame))
        else:
            level, said = ("ERROR", f"not published: {state.why}") if state else ("STALE", "no frame yet")
        values |= {"stamp uncertainty [s]": uncertain_ns * 1e-9, "system time was set": self._clock.steps}
        return messages.diagnostic(f"eitskin {name}: contacts", name, level, said, values)

    def close(self) -> None:
        if self._tare is not None:
            self._tare.close()
        self._told.close()
        for topics in self._skins.values():
            topics.close()


def tare(skin: str) -> Act:
    """What a call of the service does."""

    def act() -> tuple[bool, str]:
        try:
            taken = ControlClient("preprocessing", TARE_S).call("tare", skin=skin)
        except ControlError as why:
            return False, str(why)
        return True, f"new baseline from {taken.get('frames', 'some')} frames"

    return act
