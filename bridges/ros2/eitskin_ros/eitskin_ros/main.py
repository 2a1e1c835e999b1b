"""Runs the node of one skin: what eitskin says of it, as ROS topics. `ros2 launch eitskin_ros skin.launch.py`.

A thread (reader.py) reads eitskin's sockets and publishes; rclpy's executor serves parameters, the service `tare` and
the sensor that is the reference.
"""

from __future__ import annotations

import sys

import rclpy
from eitskin.errors import EitskinError
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from .node import SkinNode
from .reader import ReaderThread

LOOK_S = 0.5
"""How often it looks whether it is to end: one SIGTERM in some fifteen does not wake `rclpy.spin` of Jazzy."""


def main() -> int:
    rclpy.init()
    reader = None
    try:
        node = SkinNode()
        reader = ReaderThread(node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=LOOK_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (EitskinError, NameValidationException, ParameterException) as why:
        print(f"skin: {why}", file=sys.stderr)
        return 1
    finally:
        if reader is not None:
            reader.close()
        rclpy.try_shutdown()
    return int(reader is not None and reader.failed)
