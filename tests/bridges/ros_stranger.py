"""A ROS node of somebody else, for test_ros2_node.py: it knows eitskin by its messages alone, and prints what it hears.

A line on its input: `tell`, of parameters and publishers; `tare`; `press N`, as the robot's force-torque sensor; `play
TOPIC TYPE BASE64`, a message of a bag; or `bag START N`, 0.3 s of a bag's time and of its wrenches, where N is not 0.
"""

import base64
import importlib
import json
import struct
import sys
import threading
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from eitskin_msgs.msg import ContactArray
from geometry_msgs.msg import TwistStamped, WrenchStamped
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

PALM = "/left/palm"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def contacts(m):
    touches = [[c.id, c.force, c.pose.pose.position.x, c.pose.pose.position.y] for c in m.contacts]
    return [m.valid, list(m.reasons), touches, m.header.frame_id]


def peak(values, step, first=0):
    return max(struct.unpack(f"<{len(values) // 4}f", values)[first::step], default=0.0)


TOPICS = {
    f"{PALM}/contacts": (ContactArray, contacts, qos_profile_sensor_data),
    f"{PALM}/wrench": (WrenchStamped, lambda m: [m.wrench.force.z, m.wrench.torque.y], 10),
    f"{PALM}/markers": (MarkerArray, lambda m: [each.action for each in m.markers], 10),
    f"{PALM}/conductivity_drop": (PointCloud2, lambda m: peak(bytes(m.data), 5, 3), qos_profile_sensor_data),
    f"{PALM}/image": (Image, lambda m: [m.encoding, peak(bytes(m.data), 1)], 10),
    "/diagnostics": (DiagnosticArray, lambda m: {s.name: [ord(s.level), s.message] for s in m.status}, 10),
    "/tf_static": (TFMessage, lambda m: [[t.header.frame_id, t.child_frame_id] for t in m.transforms], LATCHED),
    "/bag/contacts": (ContactArray, contacts, qos_profile_sensor_data),
    "/right/sole/contacts": (ContactArray, contacts, qos_profile_sensor_data),
    "/bag/twist": (TwistStamped, lambda m: m.twist.linear.z, 10),
}


def say(topic, stamp, value):
    sys.stdout.write(json.dumps({"topic": topic, "stamp": stamp, "value": value}) + "\n")  # whole, from two threads
    sys.stdout.flush()


def hear(topic, read, message):
    header = getattr(message, "header", None)
    say(topic, header.stamp.sec + header.stamp.nanosec * 1e-9 if header else 0.0, read(message))


def call(kind, name, request, read):
    client = node.create_client(kind, f"{PALM}/{name}")
    client.wait_for_service()
    client.call_async(request).add_done_callback(lambda done: say(name, 0.0, read(done.result())))


def tell():
    """What ROS's own tools would: publishers' quality of service, and the parameters."""
    for topic in TOPICS:
        of = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
        say("qos", 0.0, [topic, [[q.reliability.name, q.deadline.nanoseconds] for q in of]])
    names = DescribeParameters.Request(names=["skin", "marker_rate"])
    spans = lambda each: [[s.to_value for s in d.floating_point_range] for d in each.descriptors]  # noqa: E731
    call(DescribeParameters, "describe_parameters", names, lambda a: [[d.description for d in a.descriptors], spans(a)])
    simulated = SetParameters.Request(parameters=[Parameter("use_sim_time", value=True).to_parameter_msg()])
    call(SetParameters, "set_parameters", simulated, lambda a: [[r.successful, r.reason] for r in a.results])


def wrench(force, seconds=0.0):
    message = WrenchStamped()
    message.header.stamp = Time(seconds=seconds).to_msg()
    message.wrench.force.z = -force
    return message


def bag(start, force):
    while not (clock.get_subscription_count() and bagged.get_subscription_count()):
        time.sleep(0.01)
    for k in range(30):
        clock.publish(Clock(clock=Time(seconds=start + 0.01 * k).to_msg()))
        if force:
            bagged.publish(wrench(force, start + 0.01 * k))
        time.sleep(0.01)


def orders():
    for word, *rest in map(str.split, sys.stdin):
        if word == "tell":
            tell()
        elif word == "tare":
            call(Trigger, "tare", Trigger.Request(), lambda answer: [answer.success, answer.message])
        elif word == "press":
            sensor.publish(wrench(float(rest[0])))
        elif word == "bag":
            bag(*map(float, rest))
        elif word == "play":
            package, _, name = rest[1].split("/")
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            player = node.create_publisher(kind, rest[0], qos_profile_sensor_data)
            while not player.get_subscription_count():
                pass
            player.publish(base64.b64decode(rest[2]))


rclpy.init()
node = rclpy.create_node("stranger")
for topic, (kind, read, qos) in TOPICS.items():
    node.create_subscription(kind, topic, lambda m, topic=topic, read=read: hear(topic, read, m), qos)
sensor, bagged = (node.create_publisher(WrenchStamped, name, 10) for name in ("/ft/wrench", "/bag/wrench"))
clock = node.create_publisher(Clock, "/clock", 10)
threading.Thread(target=orders, daemon=True).start()
rclpy.spin(node)
