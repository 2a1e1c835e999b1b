"""The ROS 2 messages that the bridge and the exports write: one table, and all that follows from it.

Fields are those of ROS 2 Humble and later, in the order of the wire. From the table come the bytes (cdr.py), the types
that DDS announces (dds.py), the definitions inside an MCAP file, and the hash that ROS 2 tools show beside a type.
"""

from __future__ import annotations

import hashlib
import json
import re
from functools import cache
from typing import Any, NamedTuple

TABLE = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "std_msgs/Bool": "bool data",
    "std_msgs/ColorRGBA": "float32 r; float32 g; float32 b; float32 a",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x 0; float64 y 0; float64 z 0; float64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseArray": "std_msgs/Header header; geometry_msgs/Pose[] poses",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force; geometry_msgs/Vector3 torque",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header; geometry_msgs/Wrench wrench",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header; string child_frame_id; "
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/CompressedImage": "std_msgs/Header header; string format; uint8[] data",
    "sensor_msgs/Image": "std_msgs/Header header; uint32 height; uint32 width; string encoding; uint8 is_bigendian; "
    "uint32 step; uint8[] data",
    "sensor_msgs/PointField": "string name; uint32 offset; uint8 datatype; uint32 count",
    "sensor_msgs/PointCloud2": "std_msgs/Header header; uint32 height; uint32 width; sensor_msgs/PointField[] fields; "
    "bool is_bigendian; uint32 point_step; uint32 row_step; uint8[] data; bool is_dense",
    "visualization_msgs/UVCoordinate": "float32 u; float32 v",
    "visualization_msgs/MeshFile": "string filename; uint8[] data",
    "visualization_msgs/Marker": "std_msgs/Header header; string ns; int32 id; int32 type; int32 action; "
    "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; std_msgs/ColorRGBA color; "
    "builtin_interfaces/Duration lifetime; bool frame_locked; geometry_msgs/Point[] points; "
    "std_msgs/ColorRGBA[] colors; string texture_resource; sensor_msgs/CompressedImage texture; "
    "visualization_msgs/UVCoordinate[] uv_coordinates; string text; string mesh_resource; "
    "visualization_msgs/MeshFile mesh_file; bool mesh_use_embedded_materials",
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
    "diagnostic_msgs/KeyValue": "string key; string value",
    "diagnostic_msgs/DiagnosticStatus": "byte level; string name; string message; string hardware_id; "
    "diagnostic_msgs/KeyValue[] values",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header; diagnostic_msgs/DiagnosticStatus[] status",
}

SCALARS = {
    # name: struct's letter, number in a type description
    "bool": ("?", 15),
    "byte": ("B", 16),
    "uint8": ("B", 3),
    "int32": ("i", 6),
    "uint32": ("I", 7),
    "float32": ("f", 10),
    "float64": ("d", 11),
    "string": ("", 17),
}
NESTED, SEQUENCE = 1, 144
"""Numbers of a type description: a message inside; added for a sequence without bound."""


class Member(NamedTuple):
    """One field of a message."""

    name: str
    type: str  # a scalar's name, or a message's
    sequence: bool
    default: str


@cache
def members(message: str) -> tuple[Member, ...]:
    """The fields of a message."""
    found = []
    for field in TABLE[message].split("; "):
        kind, name, default = re.fullmatch(r"(\S+) (\w+)(?: (\S+))?", field).groups()  # type: ignore[union-attr]
        found.append(Member(name, kind.removesuffix("[]"), kind.endswith("[]"), default or ""))
    return tuple(found)


def nested(message: str) -> list[str]:
    """All messages inside a message, each once, by name."""
    found: set[str] = set()
    todo = [message]
    while todo:
        inner = {m.type for m in members(todo.pop()) if m.type in TABLE} - found
        found |= inner
        todo += inner
    return sorted(found)


def full_name(message: str) -> str:
    """`geometry_msgs/msg/Wrench` of `geometry_msgs/Wrench`."""
    package, _, name = message.partition("/")
    return f"{package}/msg/{name}"


def dds_name(message: str) -> str:
    """The name of the type on the wire."""
    package, _, name = message.partition("/")
    return f"{package}::msg::dds_::{name}_"


def definition(message: str) -> str:
    """The definition as text with those of all messages inside, as MCAP and rosbag2 keep it (`ros2msg`)."""
    parts = [TABLE[message].replace("; ", "\n")]
    parts += [f"MSG: {name}\n" + TABLE[name].replace("; ", "\n") for name in nested(message)]
    return f"\n{'=' * 80}\n".join(parts) + "\n"


@cache
def type_hash(message: str) -> str:
    """The hash of the type, `RIHS01_...`: ROS 2's, of its description as JSON (ROS enhancement proposal 2016)."""
    told = {
        "type_description": _described(message),
        "referenced_type_descriptions": [_described(name) for name in nested(message)],
    }
    return "RIHS01_" + hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _described(message: str) -> dict[str, Any]:
    fields = []
    for member in members(message):
        number = NESTED if member.type in TABLE else SCALARS[member.type][1]
        kind = {
            "type_id": number + SEQUENCE * member.sequence,
            "capacity": 0,
            "string_capacity": 0,
            "nested_type_name": full_name(member.type) if member.type in TABLE else "",
        }
        fields.append({"name": member.name, "type": kind})
    return {"type_name": full_name(message), "fields": fields}
