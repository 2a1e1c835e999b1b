"""A robot that gives way to who pushes its skin: `wrench` in, `twist` out, as M dv/dt + D v = F, without ros2_control.

    ros2 run eitskin_ros admittance --ros-args -r wrench:=/palm/wrench -r twist:=/servo_node/delta_twist_cmds

It stands still as soon as no wrench comes that is new enough: the skin's node sends none while the skin is not valid.
"""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import TwistStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time

MASS_KG, DAMPING = 4.0, 40.0  # [kg], [N s/m]: it answers within MASS_KG / DAMPING = 0.1 s
DEAD_N = 0.3  # a lighter push is no intention
FASTEST = 0.1  # m/s
OLDEST_S = 0.25  # of a wrench, from when the skin was measured
PERIOD_S = 0.01


class Admittance(Node):
    """Speed along the skin's normal, in the frame of the skin."""

    def __init__(self) -> None:
        super().__init__("admittance")
        self._wrench: WrenchStamped | None = None
        self._speed = 0.0
        self.create_subscription(WrenchStamped, "wrench", self._on_wrench, qos_profile_sensor_data)
        self._twist = self.create_publisher(TwistStamped, "twist", 10)
        self.create_timer(PERIOD_S, self._step)

    def _on_wrench(self, wrench: WrenchStamped) -> None:
        self._wrench = wrench

    def _step(self) -> None:
        twist = TwistStamped()
        twist.header.stamp = self.get_clock().now().to_msg()
        if self._wrench is not None:
            twist.header.frame_id = self._wrench.header.frame_id
            age_s = (self.get_clock().now() - Time.from_msg(self._wrench.header.stamp)).nanoseconds * 1e-9
            self._speed = answer(self._speed, self._wrench.wrench.force.z) if 0 <= age_s <= OLDEST_S else 0.0
        twist.twist.linear.z = self._speed
        self._twist.publish(twist)


def answer(speed: float, force_n: float) -> float:
    """The speed [m/s] a PERIOD_S later under a force [N]."""
    push = force_n if abs(force_n) > DEAD_N else 0.0
    return max(-FASTEST, min(FASTEST, speed + PERIOD_S * (push - DAMPING * speed) / MASS_KG))


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Admittance())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
