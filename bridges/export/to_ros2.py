"""MCAP as rosbag2 writes it: CDR, definitions inside. Any ROS 2 tool reads it, and PlotJuggler."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import IO

from mcap.writer import CompressionType, Writer

from bridges import views
from bridges.ros2 import messages
from bridges.ros2.cdr import Value, encode
from bridges.ros2.definitions import definition, full_name
from bridges.ros2.names import topic_base
from protocol.frames import ContactFrame, ImageFrame, InfoFrame, StatusFrame

from .entries import Entry, frame_id

_QOS = (
    "- history: 1\n  depth: 10\n  reliability: {reliability}\n  durability: {durability}\n"
    "  deadline: {{sec: 2147483647, nsec: 4294967295}}\n  lifespan: {{sec: 2147483647, nsec: 4294967295}}\n"
    "  liveliness: 1\n  liveliness_lease_duration: {{sec: 2147483647, nsec: 4294967295}}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""Of a channel, as rosbag2 keeps it for `ros2 bag play`."""


def write_ros2(entries: Iterable[Entry], out: IO[bytes]) -> Counter[str]:
    """Write all entries; how many messages of each topic."""
    writer = Bag(out)
    shown: dict[str, set[int]] = {}
    for entry in entries:
        frame, ns, base = entry.frame, entry.ns, topic_base(entry.skin)
        header = {"stamp": messages.stamp(ns), "frame_id": frame_id(frame)}
        if isinstance(frame, ContactFrame):
            writer.put(f"{base}/valid", "std_msgs/Bool", {"data": frame.valid}, ns)
            if frame.valid:
                _contacts(writer, base, header, frame, ns, shown.setdefault(base, set()))
        elif isinstance(frame, ImageFrame) and frame.valid:
            writer.put(f"{base}/pressure", "sensor_msgs/PointCloud2", messages.cloud(header, frame), ns)
            writer.put(f"{base}/image", "sensor_msgs/Image", messages.image(header, frame), ns)
        elif isinstance(frame, StatusFrame):
            told = {"header": {"stamp": messages.stamp(ns)}, "status": [messages.of_status(frame, 0.0)]}
            writer.put("/diagnostics", "diagnostic_msgs/DiagnosticArray", told, ns)
        elif isinstance(frame, InfoFrame) and (moved := messages.transform(ns, frame)) is not None:
            writer.put("/tf_static", "tf2_msgs/TFMessage", {"transforms": [moved]}, ns, latched=True)
    writer.finish()
    return writer.counts


def _contacts(writer: Bag, base: str, header: messages.Message, frame: ContactFrame, ns: int, shown: set[int]) -> None:
    contacts = views.present(frame)
    if views.has_forces(frame):
        writer.put(f"{base}/wrench", "geometry_msgs/WrenchStamped", messages.wrench(header, contacts), ns)
        for k in range(messages.SLOTS):
            each = messages.wrench(header, contacts[k : k + 1])
            writer.put(f"{base}/contacts/slot{k}", "geometry_msgs/WrenchStamped", each, ns)
    writer.put(f"{base}/contacts/poses", "geometry_msgs/PoseArray", messages.poses(header, frame), ns)
    now = {contact.id for contact in contacts}
    put = messages.markers(header, frame, shown - now)
    writer.put(f"{base}/contacts", "visualization_msgs/MarkerArray", put, ns)
    shown.clear()
    shown |= now


class Bag:
    """An MCAP file of ROS 2 messages."""

    def __init__(self, out: IO[bytes]) -> None:
        self._writer = Writer(out, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="eitskin")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.counts: Counter[str] = Counter()

    def put(self, topic: str, message: str, value: Value, ns: int, latched: bool = False) -> None:
        """Add a message."""
        if message not in self._schemas:
            data = definition(message).encode()
            self._schemas[message] = self._writer.register_schema(full_name(message), "ros2msg", data)
        if topic not in self._channels:
            best_effort = message.startswith("sensor_msgs/")
            qos = _QOS.format(reliability=2 if best_effort else 1, durability=1 if latched else 2)
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[message], {"offered_qos_profiles": qos}
            )
        self._writer.add_message(self._channels[topic], ns, encode(message, value), ns, self.counts[topic])
        self.counts[topic] += 1

    def finish(self) -> None:
        """Write what ends the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
