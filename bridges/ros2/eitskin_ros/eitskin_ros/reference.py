"""A force-torque sensor of the robot as the topic reference/SKIN: what `skin calibrate --live` learns from."""

from __future__ import annotations

import time
from typing import Any

from eitskin.errors import EitskinError
from eitskin.frames import ReferenceFrame
from eitskin.publishing import Publisher
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

AXES = ("x", "y", "z", "-x", "-y", "-z")
MIND_S = 0.1
MOST_AGE_S = 10.0
"""A stamp further than that from now is of another clock: of simulated time, of a host whose time is not set."""


class Reference:
    """One skin's. `axis`: the force that presses the skin, "-z" where a press gives a negative z, as in ~/wrench."""

    def __init__(self, node: Node, skin: str, topic: str, axis: str) -> None:
        """Raises EitskinError for an axis that is none, and where another program is the reference already."""
        if axis not in AXES:
            raise EitskinError(f"reference_axis is {axis!r}, expected one of {', '.join(AXES)}")
        self._skin, self._axis, self._turn = skin, axis[-1], -1.0 if axis.startswith("-") else 1.0
        self._publisher = Publisher("reference")
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(WrenchStamped, topic, self._on_wrench, qos)
        node.create_timer(MIND_S, self._mind)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._publisher.send(reading(message, self._skin, self._turn * getattr(message.wrench.force, self._axis)))

    def _mind(self) -> None:
        self._publisher.mind()
        self._publisher.poll()


def reading(message: Any, skin: str, force_n: float) -> ReferenceFrame:
    """By the message's own stamp; where that is 0, by when it came. A stamp of another clock makes it not valid."""
    stamp, now = message.header.stamp, time.monotonic_ns()
    measured_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
    sample = measured_ns - time.time_ns() + now if measured_ns else now
    known = abs(now - sample) < MOST_AGE_S * 1e9
    stamps, reasons = {"sample": max(0, sample) if known else now}, [] if known else ["clock"]
    return ReferenceFrame(skin=skin, stamps=stamps, valid=known, reasons=reasons, force_n=float(force_n))
