"""Frames as ROS messages. `ros` holds the message types by their names: rclpy's in the node, those of the exporter.

Forces and torques are those on the skin, at the origin of its frame, as a force-torque sensor there would measure
them: a finger that presses gives a negative z.
"""

from __future__ import annotations

import array
import math
import re
from collections.abc import Callable, Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

try:
    from eitskin import views
except ImportError:  # in eitskin's own checkout, where `skin export` needs no wheel
    from protocol import views

TYPES = {
    "builtin_interfaces": "Duration Time",
    "diagnostic_msgs": "DiagnosticArray DiagnosticStatus KeyValue",
    "eitskin_msgs": "Contact ContactArray",
    "geometry_msgs": "Point Pose PoseWithCovariance Quaternion Transform TransformStamped Vector3 Wrench WrenchStamped",
    "sensor_msgs": "Image PointCloud2 PointField",
    "std_msgs": "ColorRGBA Header",
    "tf2_msgs": "TFMessage",
    "visualization_msgs": "Marker MarkerArray",
}
"""The messages that `ros` holds, by their packages."""
BEGIN, HOLD = 1, 2
ARROW, CYLINDER, TEXT = 0, 3, 9
DELETE_ALL = 3
METRES_PER_NEWTON = 0.01  # length of an arrow
FLOAT32 = 7
LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}
SILENT = "silent"
"""The reason of ContactArray where no measurement has come."""


def message_types(find: Callable[[str, str], Any]) -> Any:
    """`ros`: each message type as `find` gives it, by package and name."""
    found = {name: find(package, name) for package, names in TYPES.items() for name in names.split()}
    return SimpleNamespace(**found)


def ros_name(skin: str) -> str:
    """A skin's name as ROS allows names: letters, digits and _ alone, no digit first."""
    name = re.sub(r"\W", "_", skin, flags=re.ASCII)
    return f"_{name}" if name[:1].isdigit() else name


def stamp(ros: Any, ns: int) -> Any:
    return ros.Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)


def header(ros: Any, ns: int, frame_id: str) -> Any:
    """A Header: measured at `ns` since 1970."""
    return ros.Header(stamp=stamp(ros, ns), frame_id=frame_id)


def contacts(ros: Any, head: Any, frame: Any) -> Any:
    """ContactArray of a frame. One that is not valid says nothing of contacts."""
    found = views.present(frame) if frame.valid else []
    ended = [*frame.ended, *(c for c in frame.contacts if c.state == "end")] if frame.valid else []
    return ros.ContactArray(
        header=head,
        valid=frame.valid,
        reasons=list(frame.reasons),
        contacts=[_contact(ros, contact) for contact in found],
        ended=array.array("Q", [contact.id for contact in ended]),
    )


def not_valid(ros: Any, head: Any, reasons: list[str]) -> Any:
    """ContactArray where there is no frame to act on."""
    return ros.ContactArray(header=head, valid=False, reasons=reasons, contacts=[], ended=array.array("Q"))


def _contact(ros: Any, c: Any) -> Any:
    return ros.Contact(
        id=c.id,
        state=BEGIN if c.state == "begin" else HOLD,
        pose=ros.PoseWithCovariance(pose=_pose(ros, c), covariance=covariance(c)),
        velocity=_xyz(ros.Vector3, c.velocity),
        area=float(c.area_m2),
        force=_known(c.force_n),
        force_sigma=_known(c.force_sigma_n),
        peak_pressure=_known(c.pressure_pa),
        peak_pressure_sigma=_known(c.pressure_sigma_pa),
        wrench=_wrench(ros, c.wrench),
        shape=c.shape,
        confidence=float(c.confidence),
    )


def _known(value: float | None) -> float:
    return math.nan if value is None else float(value)


def covariance(c: Any) -> Any:
    """(36,) of a contact's place; its first element is -1 where nobody knows."""
    found = np.zeros((6, 6))
    if c.position_sigma is None:
        found[0, 0] = -1.0
        return found.ravel()
    longest, shortest, angle = c.position_sigma
    x, y, z, w = views.orientation(c.normal)  # from the sheet, as it lies flat, into the skin's frame
    across = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    up = np.array([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])
    cos, sin = math.cos(angle), math.sin(angle)
    axes = np.stack([longest * (cos * across + sin * up), shortest * (cos * up - sin * across)])
    found[:3, :3] = axes.T @ axes
    return found.ravel()


def wrench(ros: Any, head: Any, frame: Any) -> Any:
    """WrenchStamped: the sum of the contacts' wrenches, 0 where there is none."""
    return ros.WrenchStamped(header=head, wrench=_wrench(ros, views.total(views.present(frame))))


def markers(ros: Any, head: Any, frame: Any) -> Any:
    """MarkerArray: patch, force as an arrow onto it, label. It begins with the deletion of all that was shown before:
    nothing old stays, whatever was lost and wherever a recording begins anew. No frame: that alone.
    """
    found = [ros.Marker(header=head, action=DELETE_ALL)]
    for c in views.present(frame) if frame is not None else ():
        tail, across = views.tail(c, METRES_PER_NEWTON), 2 * math.sqrt(max(c.area_m2, 1e-6) / math.pi)
        ends_ns = int(frame.valid_for_s * 1e9)
        lifetime = ros.Duration(sec=ends_ns // 10**9, nanosec=ends_ns % 10**9)
        common = {"header": head, "id": c.id & 0x7FFFFFFF, "lifetime": lifetime}
        points = [_xyz(ros.Point, tail), _xyz(ros.Point, c.position)]
        for ns, kind, scale, colour, more in (
            ("patch", CYLINDER, (across, across, 0.001), (1.0, 0.5, 0.1, 0.6), {"pose": _pose(ros, c)}),
            ("force", ARROW, (0.002, 0.005, 0.006), (0.9, 0.1, 0.1, 1.0), {"points": points}),
            ("label", TEXT, (0.0, 0.0, 0.004), (1.0, 1.0, 1.0, 1.0), {"pose": ros.Pose(position=points[0])}),
        ):
            shade = ros.ColorRGBA(**dict(zip("rgba", colour, strict=True)))
            text = views.label(c) if ns == "label" else ""
            size = _xyz(ros.Vector3, scale)
            found.append(ros.Marker(ns=ns, type=kind, scale=size, color=shade, text=text, **common, **more))
    return ros.MarkerArray(markers=found)


def conductivity_drop(ros: Any, head: Any, frame: Any, surface: Any) -> Any:
    """PointCloud2: a point for each pixel, with the conductivity drop and its standard uncertainty [S/m].

    `surface`: what the sheet is wrapped round, as info says; None where it lies flat.
    """
    drop, sigma = views.filled(frame)
    rows, columns = drop.shape
    names = ("x", "y", "z", "conductivity_drop", "sigma")
    points = np.zeros((rows, columns, len(names)), "<f4")
    m, (x0, y0) = frame.metres_per_pixel, frame.origin
    x, y = x0 + (np.arange(columns) + 0.5) * m, (y0 + (np.arange(rows) + 0.5) * m)[:, None]
    points[..., 0], points[..., 1], points[..., 2] = _wrapped(x, y, surface) if surface else (x, y, 0.0)
    points[..., 3], points[..., 4] = drop, sigma
    return ros.PointCloud2(
        header=head,
        height=1,
        width=rows * columns,
        fields=[ros.PointField(name=name, offset=4 * k, datatype=FLOAT32, count=1) for k, name in enumerate(names)],
        point_step=4 * len(names),
        row_step=4 * points.size,
        data=array.array("B", points.tobytes()),
        is_dense=bool(np.isfinite(sigma).all()),
    )


def _wrapped(x: Any, y: Any, surface: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Where points of the sheet are on the outside of a cylinder, whose axis lies below the sheet's centre."""
    r, axis = surface["radius_m"], math.radians(surface["axis_degrees"])
    cos, sin = math.cos(axis), math.sin(axis)
    along, angle = cos * x + sin * y, (sin * x - cos * y) / r
    across = r * np.sin(angle)
    return along * cos + across * sin, along * sin - across * cos, r * (np.cos(angle) - 1)


def image(ros: Any, head: Any, frame: Any) -> Any:
    """Image, 32FC1: the conductivity drop [S/m] as seen from above, so the first row is that of the highest y."""
    drop, _ = views.filled(frame)
    data = array.array("B", np.ascontiguousarray(drop[::-1], "<f4").tobytes())
    rows, columns = drop.shape
    return ros.Image(header=head, height=rows, width=columns, encoding="32FC1", step=4 * columns, data=data)


def transform(ros: Any, ns: int, info: Mapping[str, Any]) -> Any:
    """TFMessage with the skin's pose; None where the service does not say."""
    found, parent, child = info.get("pose"), info.get("parent_frame_id"), info.get("frame_id")
    if not (isinstance(parent, str) and parent and isinstance(child, str) and child):
        return None
    try:
        x, y, z, *turn = (float(v) for v in found)  # type: ignore[union-attr]
        rotation = _quaternion(ros, turn)
    except (TypeError, ValueError):
        return None
    moved = ros.Transform(translation=_xyz(ros.Vector3, (x, y, z)), rotation=rotation)
    return ros.TFMessage(
        transforms=[ros.TransformStamped(header=header(ros, ns, parent), child_frame_id=child, transform=moved)]
    )


def diagnostic(ros: Any, skin: str, of: str, level: str, message: str, values: Mapping[str, object]) -> Any:
    """DiagnosticStatus."""
    shown = {key: f"{value:.4g}" if isinstance(value, float) else str(value) for key, value in values.items()}
    return ros.DiagnosticStatus(
        level=bytes([LEVELS.get(level, LEVELS["STALE"])]),
        name=f"eitskin {skin}: {of}",
        message=message,
        hardware_id=skin,
        values=[ros.KeyValue(key=key, value=value) for key, value in shown.items()],
    )


def of_process(ros: Any, frame: Any, age_s: float) -> Any:
    """DiagnosticStatus of a process; one that has said nothing for long is stale."""
    stale = age_s > max(frame.valid_for_s, 1.0)
    said = "; ".join(frame.messages) or frame.level
    values: dict[str, object] = {f"rate {topic} [Hz]": rate for topic, rate in frame.rates.items()}
    values |= {f"drops {cause}": n for cause, n in frame.drops.items()}
    values |= {f"latency {name} [ms]": ms for name, ms in frame.latency.items()}
    values |= {"cpu": frame.cpu, **frame.counters}
    message = f"no status for {age_s:.0f} s; the last: {said}" if stale else said
    return diagnostic(ros, frame.skin, frame.process, "STALE" if stale else frame.level, message, values)


def of_electrodes(ros: Any, skin: str, states: list[str]) -> Any:
    """DiagnosticStatus of the electrodes' states, in their order; none where they are not known."""
    bad = [f"{k} {state}" for k, state in enumerate(states) if state != "ok"]
    level, said = ("WARN", ", ".join(bad)) if bad else ("OK", "all ok") if states else ("STALE", "not known")
    return diagnostic(ros, skin, "electrodes", level, said, {f"electrode {k}": s for k, s in enumerate(states)})


def _pose(ros: Any, c: Any) -> Any:
    turn = views.orientation(c.normal, c.orientation)
    return ros.Pose(position=_xyz(ros.Point, c.position), orientation=_quaternion(ros, turn))


def _wrench(ros: Any, values: Any) -> Any:
    return ros.Wrench(force=_xyz(ros.Vector3, values[:3]), torque=_xyz(ros.Vector3, values[3:]))


def _quaternion(ros: Any, values: Iterable[float]) -> Any:
    return ros.Quaternion(**dict(zip("xyzw", values, strict=True)))


def _xyz(kind: Any, values: Iterable[float]) -> Any:
    return kind(**dict(zip("xyz", map(float, values), strict=True)))
