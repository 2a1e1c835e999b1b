"""Frames as Foxglove's own messages: image, scene, numbers to plot, log. The live server and the export share them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from foxglove import Channel, Context
from foxglove.channels import FrameTransformsChannel, LogChannel, RawImageChannel, SceneUpdateChannel
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    Duration,
    FrameTransform,
    FrameTransforms,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    Point3,
    Pose,
    Quaternion,
    RawImage,
    SceneEntity,
    SceneUpdate,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from protocol import views
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame

METRES_PER_NEWTON = 0.01
RED, ORANGE, WHITE = Color(r=0.9, g=0.1, b=0.1, a=1.0), Color(r=1.0, g=0.5, b=0.1, a=1.0), Color(r=1, g=1, b=1, a=1)
GREY = Color(r=0.5, g=0.5, b=0.5, a=1.0)

_NUMBER: dict[str, Any] = {"type": "number"}
FORCES = {
    "type": "object",
    "title": "eitskin.Forces",
    "properties": {
        **{name: _NUMBER for name in ("fx", "fy", "fz", "tx", "ty", "tz", "force_n", "age_ms")},
        "touches": {"type": "integer"},
        "contacts": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "id": {"type": "integer"},
                    **{name: _NUMBER for name in ("x", "y", "z", "force_n", "force_sigma_n", "area_m2", "confidence")},
                    "shape": {"type": "string"},
                },
            },
        },
    },
}
"""Schema of the numbers: newton, newton metre, metre; null where the skin has no force law."""

Outlines = Mapping[int, Sequence[Sequence[float]]]


class FoxgloveChannels:
    """The channels of one skin."""

    def __init__(self, skin: str, frame_id: str, context: Context) -> None:
        self.skin, self.frame_id = skin, frame_id
        self.image = RawImageChannel(f"/{skin}/image", context=context)
        self.scene = SceneUpdateChannel(f"/{skin}/scene", context=context)
        self.forces = Channel(f"/{skin}/forces", schema=FORCES, context=context)
        self.log = LogChannel(f"/{skin}/log", context=context)
        self.tf = FrameTransformsChannel(f"/{skin}/tf", context=context)
        self.sent = {"image": 0, "scene": 0, "forces": 0, "log": 0}

    def put_contacts(self, frame: ContactFrame, ns: int, outlines: Outlines, age_ms: float = 0.0) -> None:
        """A contact frame that was measured at `ns`: its scene and its numbers."""
        if self.scene.has_sinks():
            self.scene.log(SceneUpdate(entities=[self._entity(frame, ns, outlines)]), log_time=ns)
            self.sent["scene"] += 1
        if self.forces.has_sinks():
            self.forces.log(forces(frame, age_ms), log_time=ns)
            self.sent["forces"] += 1

    def put_image(self, frame: ImageFrame, ns: int) -> None:
        """An image, in S/m; its first row is the highest y."""
        drop, _ = views.filled(frame)
        rows, columns = drop.shape
        if not self.image.has_sinks() or not drop.size:
            return
        self.image.log(
            RawImage(
                timestamp=_time(ns),
                frame_id=self.frame_id,
                width=columns,
                height=rows,
                encoding="32FC1",
                step=4 * columns,
                data=np.ascontiguousarray(drop[::-1], "<f4").tobytes(),
            ),
            log_time=ns,
        )
        self.sent["image"] += 1

    def put_log(self, text: str, ns: int, level: LogLevel = LogLevel.Warning) -> None:
        """A line of log."""
        if self.log.has_sinks():
            self.log.log(Log(timestamp=_time(ns), level=level, message=text, name=self.skin), log_time=ns)
            self.sent["log"] += 1

    def put_place(self, frame: InfoFrame, ns: int) -> None:
        """Where the skin is, and its outline."""
        found, parent = frame.info.get("pose"), frame.info.get("parent_frame_id")
        if isinstance(parent, str) and parent and isinstance(found, list | tuple) and len(found) == 7:
            x, y, z, qx, qy, qz, qw = (float(v) for v in found)
            moved = FrameTransform(
                timestamp=_time(ns),
                parent_frame_id=parent,
                child_frame_id=self.frame_id,
                translation=Vector3(x=x, y=y, z=z),
                rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
            )
            self.tf.log(FrameTransforms(transforms=[moved]), log_time=ns)
        geometry = frame.info.get("geometry")
        outline = np.asarray(geometry["outline"]) if isinstance(geometry, dict) and "outline" in geometry else None
        if outline is not None and outline.ndim == 2 and outline.shape[1] == 2 and np.isfinite(outline).all():
            entity = SceneEntity(
                timestamp=_time(ns), frame_id=self.frame_id, id="skin", lines=[_loop(outline.tolist(), GREY)]
            )
            self.scene.log(SceneUpdate(entities=[entity]), log_time=ns)

    def _entity(self, frame: ContactFrame, ns: int, outlines: Outlines) -> SceneEntity:
        """All contacts; gone by itself when the frame is no longer valid."""
        contacts = views.present(frame)
        until = frame.valid_for_s
        return SceneEntity(
            timestamp=_time(ns),
            frame_id=self.frame_id,
            id="contacts",
            lifetime=Duration(sec=int(until), nsec=int(until % 1 * 1e9)),
            arrows=[_arrow(contact) for contact in contacts],
            lines=[_loop(outlines[c.id], ORANGE) if c.id in outlines else _circle(c) for c in contacts],
            texts=[
                TextPrimitive(
                    pose=_pose(views.tail(contact, METRES_PER_NEWTON)),
                    billboard=True,
                    font_size=0.006,
                    color=WHITE,
                    text=views.label(contact),
                )
                for contact in contacts
            ],
        )


def forces(frame: ContactFrame, age_ms: float) -> dict[str, Any]:
    """Numbers to plot, as FORCES has them."""
    contacts = views.present(frame)
    known = views.has_forces(frame)
    wrench = views.total(contacts)
    found: dict[str, Any] = dict(
        zip(("fx", "fy", "fz", "tx", "ty", "tz"), wrench if known else [None] * 6, strict=True)
    )
    found |= {
        "force_n": math.fsum(c.force_n or 0.0 for c in contacts) if known else None,
        "age_ms": age_ms,
        "touches": len(contacts),
        "contacts": [
            {
                "id": c.id,
                **dict(zip("xyz", c.position, strict=True)),
                "force_n": c.force_n,
                "force_sigma_n": c.force_sigma_n,
                "area_m2": c.area_m2,
                "confidence": c.confidence,
                "shape": c.shape,
            }
            for c in contacts
        ],
    }
    return found


def _time(ns: int) -> Timestamp:
    return Timestamp(sec=ns // 1_000_000_000, nsec=ns % 1_000_000_000)


def _pose(at: Sequence[float], turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> Pose:
    x, y, z = at
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=turn[0], y=turn[1], z=turn[2], w=turn[3]))


def _arrow(contact: Contact) -> ArrowPrimitive:
    """From outside onto the contact. Foxglove's arrows point along x."""
    start = views.tail(contact, METRES_PER_NEWTON)
    length = math.dist(start, contact.position)
    dx, dy, dz = (-n for n in contact.normal)
    w = math.sqrt(max(0.0, 0.5 * (1 + dx)))
    turn = (0.0, -0.5 * dz / w, 0.5 * dy / w, w) if w > 1e-3 else (0.0, 0.0, 1.0, 0.0)
    return ArrowPrimitive(
        pose=_pose(start, turn),
        shaft_length=0.7 * length,
        shaft_diameter=0.002,
        head_length=0.3 * length,
        head_diameter=0.005,
        color=RED,
    )


def _loop(points: Sequence[Sequence[float]], color: Color) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitiveLineType.LineLoop,
        thickness=2.0,
        scale_invariant=True,
        points=[Point3(x=point[0], y=point[1], z=0.0) for point in points],
        color=color,
    )


def _circle(contact: Contact) -> LinePrimitive:
    """A circle of the contact's area, where its outline is not known."""
    r, (x, y, z) = math.sqrt(max(contact.area_m2, 1e-6) / math.pi), contact.position
    angles = [2 * math.pi * k / 24 for k in range(24)]
    return LinePrimitive(
        type=LinePrimitiveLineType.LineLoop,
        thickness=2.0,
        scale_invariant=True,
        points=[Point3(x=x + r * math.cos(a), y=y + r * math.sin(a), z=z) for a in angles],
        color=ORANGE,
    )
