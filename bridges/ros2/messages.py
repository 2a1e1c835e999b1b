"""Frames as ROS messages: maps from field to value, as definitions.py has them.

Forces and torques are those on the skin, at the origin of its frame, as a force-torque sensor there would measure
them: a finger that presses gives a negative z.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bridges import views
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, StatusFrame

SLOTS = 4
"""Contacts that have a wrench topic of their own."""
ARROW, CYLINDER, TEXT = 0, 3, 9
ADD, DELETE = 0, 2
FLOAT32 = 7
POINT = ("x", "y", "z", "drop", "sigma")
METRES_PER_NEWTON = 0.01  # length of the arrow
LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}

Message = dict[str, Any]


def wrench(header: Message, contacts: Iterable[Contact]) -> Message:
    """geometry_msgs/WrenchStamped: the sum of the contacts' wrenches, 0 where there is none."""
    found = views.total(contacts)
    return {"header": header, "wrench": {"force": xyz(found[:3]), "torque": xyz(found[3:])}}


def poses(header: Message, frame: ContactFrame) -> Message:
    """geometry_msgs/PoseArray: z out of the skin, x along the patch's longest axis; strongest first."""
    return {"header": header, "poses": [pose(contact) for contact in views.present(frame)]}


def pose(contact: Contact) -> Message:
    """geometry_msgs/Pose of a contact."""
    return {
        "position": xyz(contact.position),
        "orientation": quaternion(views.orientation(contact.normal, contact.orientation)),
    }


def markers(header: Message, frame: ContactFrame, gone: Iterable[int]) -> Message:
    """visualization_msgs/MarkerArray: the patch, the force as an arrow onto it, a label. What is not sent again is
    gone when the frame is no longer valid. `gone`: ids of contacts that are there no more.
    """
    lifetime = {"sec": int(frame.valid_for_s), "nanosec": int(frame.valid_for_s % 1 * 1e9)}
    found: list[Message] = []
    for contact in views.present(frame):
        tail = views.tail(contact, METRES_PER_NEWTON)
        across = 2 * math.sqrt(max(contact.area_m2, 1e-6) / math.pi)
        common = {"header": header, "id": _id32(contact.id), "action": ADD, "lifetime": lifetime}
        found += [
            common
            | {
                "ns": "patch",
                "type": CYLINDER,
                "pose": pose(contact),
                "scale": {"x": across, "y": across, "z": 0.001},
                "color": {"r": 1.0, "g": 0.5, "b": 0.1, "a": 0.6},
            },
            common
            | {
                "ns": "force",
                "type": ARROW,
                "points": [xyz(tail), xyz(contact.position)],
                "scale": {"x": 0.002, "y": 0.005, "z": 0.006},
                "color": {"r": 0.9, "g": 0.1, "b": 0.1, "a": 1.0},
            },
            common
            | {
                "ns": "label",
                "type": TEXT,
                "pose": {"position": xyz(tail)},
                "scale": {"z": 0.008},
                "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                "text": views.label(contact),
            },
        ]
    for each in gone:
        found += [
            {"header": header, "ns": ns, "id": _id32(each), "action": DELETE} for ns in ("patch", "force", "label")
        ]
    return {"markers": found}


def cloud(header: Message, frame: ImageFrame) -> Message:
    """sensor_msgs/PointCloud2: a point for each pixel, with the conductivity drop and its uncertainty in S/m."""
    drop, sigma = views.filled(frame)
    rows, columns = drop.shape
    points = np.zeros((rows, columns, len(POINT)), "<f4")
    m, (x0, y0) = frame.metres_per_pixel, frame.origin
    points[..., 0] = x0 + (np.arange(columns) + 0.5) * m
    points[..., 1] = (y0 + (np.arange(rows) + 0.5) * m)[:, None]
    points[..., 3], points[..., 4] = drop, sigma
    step = 4 * len(POINT)
    return {
        "header": header,
        "height": 1,
        "width": rows * columns,
        "fields": [{"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1} for k, name in enumerate(POINT)],
        "point_step": step,
        "row_step": step * rows * columns,
        "data": points.tobytes(),
        "is_dense": bool(np.isfinite(sigma).all()),
    }


def image(header: Message, frame: ImageFrame) -> Message:
    """sensor_msgs/Image, 32FC1: the conductivity drop in S/m, as seen from above: y up, so the first row is the
    highest y.
    """
    drop, _ = views.filled(frame)
    rows, columns = drop.shape
    data = np.ascontiguousarray(drop[::-1], "<f4")
    return {
        "header": header,
        "height": rows,
        "width": columns,
        "encoding": "32FC1",
        "step": 4 * columns,
        "data": data.tobytes(),
    }


def transform(ns: int, frame: InfoFrame) -> Message | None:
    """geometry_msgs/TransformStamped of the skin's pose; None where the service does not say."""
    found, parent, child = frame.info.get("pose"), frame.info.get("parent_frame_id"), frame.info.get("frame_id")
    if not isinstance(parent, str) or not isinstance(child, str) or not parent or not child:
        return None
    try:
        x, y, z, qx, qy, qz, qw = (float(v) for v in found)  # type: ignore[union-attr]
    except (TypeError, ValueError):
        return None
    return {
        "header": {"stamp": stamp(ns), "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": xyz((x, y, z)), "rotation": quaternion((qx, qy, qz, qw))},
    }


def diagnostic(name: str, hardware: str, level: str, message: str, values: Mapping[str, object]) -> Message:
    """diagnostic_msgs/DiagnosticStatus."""
    return {
        "level": LEVELS.get(level, LEVELS["STALE"]),
        "name": name,
        "message": message,
        "hardware_id": hardware,
        "values": [{"key": key, "value": _shown(value)} for key, value in values.items()],
    }


def of_status(frame: StatusFrame, age_s: float) -> Message:
    """diagnostic_msgs/DiagnosticStatus of a process; one that has said nothing for long is stale."""
    stale = age_s > max(frame.valid_for_s, 1.0)
    said = "; ".join(frame.messages) or frame.level
    values: dict[str, object] = {f"rate {topic} [Hz]": rate for topic, rate in frame.rates.items()}
    values |= {f"drops {cause}": n for cause, n in frame.drops.items()}
    values |= {f"latency {name} [ms]": ms for name, ms in frame.latency.items()}
    values |= {"cpu": frame.cpu, **frame.counters}
    return diagnostic(
        f"eitskin {frame.skin}: {frame.process}",
        frame.skin,
        "STALE" if stale else frame.level,
        f"no status for {age_s:.0f} s; the last: {said}" if stale else said,
        values,
    )


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def stamp(ns: int) -> Message:
    """A builtin_interfaces/Time."""
    return {"sec": ns // 1_000_000_000, "nanosec": ns % 1_000_000_000}


def quaternion(values: Sequence[float]) -> Message:
    """A Quaternion of x, y, z, w."""
    return dict(zip("xyzw", values, strict=True))


def xyz(values: Sequence[float]) -> Message:
    """A Vector3 or Point."""
    return {"x": float(values[0]), "y": float(values[1]), "z": float(values[2])}


def _id32(number: int) -> int:
    """A contact's id as a marker's, which has 31 bits."""
    return number & 0x7FFFFFFF
