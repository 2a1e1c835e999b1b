"""A genuine ROS 2 node for test_ros2_node.py: prints messages as JSON; a line on its input calls the service `tare`."""

import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import WrenchStamped
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

TOPICS = {
    "/eitskin/palm/wrench": (WrenchStamped, lambda m: [m.wrench.force.z, m.wrench.torque.x, m.wrench.torque.y]),
    "/eitskin/palm/valid": (Bool, lambda m: m.data),
}


def say(topic, value):
    print(json.dumps({"topic": topic, "at": time.time(), "value": value}), flush=True)


def orders():
    while sys.stdin.readline():
        client.wait_for_service()
        told = client.call_async(Trigger.Request())
        told.add_done_callback(lambda done: say("tare", [done.result().success, done.result().message]))


rclpy.init()
node = rclpy.create_node("eitskin_listener")
for name, (kind, read) in TOPICS.items():
    node.create_subscription(kind, name, lambda m, name=name, read=read: say(name, read(m)), 10)
client = node.create_client(Trigger, "/eitskin/palm/tare")
threading.Thread(target=orders, daemon=True).start()
while rclpy.ok():
    rclpy.spin_once(node, timeout_sec=1.0)
    say("hashes", {t: [str(i.topic_type_hash) for i in node.get_publishers_info_by_topic(t)] for t in TOPICS})
