"""A bag of rosbag2 (MCAP), with the topics of the ROS node: what `ros2 bag record` would have kept of it."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bridges.ros2.eitskin_ros.eitskin_ros import messages
from protocol import views
from protocol.frames import ContactFrame, ImageFrame, InfoFrame, StatusFrame

from .entries import Entry

DEFINITIONS = Path(__file__).parents[1] / "ros2" / "eitskin_msgs" / "msg"
BEST_EFFORT = ("eitskin_msgs/msg/ContactArray", "sensor_msgs/msg/PointCloud2")
FOR_EVER = QosTime(2147483647, 4294967295)


def write_ros2(entries: Iterable[Entry], out: Path) -> Counter[str]:
    """Write all entries; how many messages of each topic."""
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".bag") as folder:
        writer = Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            bag = _Bag(writer)
            for entry in entries:
                bag.put(entry)
        shutil.move(Path(folder) / "bag" / "bag.mcap", out)
    return bag.counts


class _Bag:
    def __init__(self, writer: Writer) -> None:
        self._writer, self._store = writer, typestore()
        self._ros = messages.message_types(lambda of, name: partial(_message, self._store, f"{of}/msg/{name}"))
        self._connections: dict[str, Any] = {}
        self._infos: dict[str, dict[str, Any]] = {}  # by skin
        self.counts: Counter[str] = Counter()

    def put(self, entry: Entry) -> None:
        """Write what the node would have published of a frame."""
        frame, ros, base = entry.frame, self._ros, f"/{messages.ros_name(entry.skin)}"
        info = self._infos.get(entry.skin, {})
        of_contacts = frame.frame_id if isinstance(frame, ContactFrame) else ""
        head = messages.header(ros, entry.ns, of_contacts or info.get("frame_id") or entry.skin)
        found: dict[str, Any] = {}
        if isinstance(frame, ContactFrame):
            found[f"{base}/contacts"] = messages.contacts(ros, head, frame)
            found[f"{base}/markers"] = messages.markers(ros, head, frame if frame.valid else None)
            if frame.valid and views.has_forces(frame):
                found[f"{base}/wrench"] = messages.wrench(ros, head, frame)
        elif isinstance(frame, ImageFrame) and frame.valid:
            found[f"{base}/conductivity_drop"] = messages.conductivity_drop(ros, head, frame, info.get("surface"))
            found[f"{base}/image"] = messages.image(ros, head, frame)
        elif isinstance(frame, StatusFrame):
            of = messages.of_process(ros, frame, 0.0)
            found["/diagnostics"] = ros.DiagnosticArray(header=messages.header(ros, entry.ns, ""), status=[of])
        elif isinstance(frame, InfoFrame):
            self._infos[entry.skin] = frame.info
            if (moved := messages.transform(ros, entry.ns, frame.info)) is not None:
                found["/tf_static"] = moved
        for topic, message in found.items():
            self._write(topic, entry.ns, message)

    def _write(self, topic: str, ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            profile = qos(kind in BEST_EFFORT, topic == "/tf_static")
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=[profile]
            )
        self._writer.write(self._connections[topic], ns, self._store.serialize_cdr(message, kind))
        self.counts[topic] += 1


def qos(best_effort: bool, latched: bool) -> Qos:
    """As the node offers a topic, which `ros2 bag play` then does too; but for deadlines, that no bag can keep."""
    reliability = QosReliability.BEST_EFFORT if best_effort else QosReliability.RELIABLE
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    depth, alive = 1 if latched else 5, QosLiveliness.AUTOMATIC
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, FOR_EVER, FOR_EVER, alive, FOR_EVER, False)


def typestore() -> Typestore:
    """The message types of ROS 2, and eitskin_msgs."""
    store = get_typestore(Stores.ROS2_KILTED)
    found: dict[str, Any] = {}
    for file in sorted(DEFINITIONS.glob("*.msg")):
        found |= get_types_from_msg(file.read_text(), f"eitskin_msgs/msg/{file.stem}")
    store.register(found)
    return store


def _message(store: Typestore, kind: str, **values: Any) -> Any:
    """A message of some fields, the others at their defaults, as rclpy makes them."""
    fields = store.fielddefs[kind][1]
    if unknown := values.keys() - dict(fields):
        raise AttributeError(f"{kind} has no field {', '.join(sorted(unknown))}")
    return store.types[kind](**{name: _value(store, field, values.get(name)) for name, field in fields})


def _value(store: Typestore, field: Any, value: Any) -> Any:
    """A field's value as rosbags has it; its default where it is None."""
    node, of = field
    if node == Nodetype.NAME:
        return _message(store, of) if value is None else value
    if node == Nodetype.BASE:
        default = {"string": "", "bool": False}.get(of[0], 0)
        return default if value is None else value[0] if isinstance(value, bytes) else value
    (inner, name), length = of
    if inner == Nodetype.NAME or name[0] == "string":
        return [] if value is None else value
    return np.asarray([0] * (length if node == Nodetype.ARRAY else 0) if value is None else value, name[0])
