"""A genuine ROS 2 node (rclpy), run by the Python of a virtual environment that has ROS 2's packages: subscribes to all
topics of a skin, or to those that are named, and prints a line of JSON for each message. A line `tare` on its input
calls the service.

python ros_node.py /eitskin/palm [wrench pressure ...]
"""

import json
import sys
import threading
import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray


def wrench(m):
    f, t = m.wrench.force, m.wrench.torque
    return [f.x, f.y, f.z, t.x, t.y, t.z]


def cloud(m):
    names = [(f.name, f.offset, f.datatype) for f in m.fields]
    assert names == [(n, 4 * k, 7) for k, n in enumerate(("x", "y", "z", "drop", "sigma"))], names
    points = np.frombuffer(bytes(m.data), "<f4").reshape(m.width * m.height, 5)
    best = points[points[:, 3].argmax()] if len(points) else [0.0] * 5
    return {"points": len(points), "peak": [float(v) for v in best[:4]]}


def image(m):
    pixels = np.frombuffer(bytes(m.data), "<f4").reshape(m.height, m.width)
    row, column = divmod(int(pixels.argmax()), m.width)
    return {"size": [m.height, m.width], "encoding": m.encoding, "peak": [row, column], "most": float(pixels.max())}


def markers(m):
    return [[k.ns, k.id, k.action, [k.pose.position.x, k.pose.position.y], k.text] for k in m.markers]


def poses(m):
    return [[p.position.x, p.position.y, p.position.z, p.orientation.w] for p in m.poses]


def diagnostics(m):
    return [
        {"name": s.name, "level": s.level[0], "message": s.message, "values": {v.key: v.value for v in s.values}}
        for s in m.status
    ]


def say(**what):
    print(json.dumps(what), flush=True)


def main():
    base, named = sys.argv[1], sys.argv[2:]
    rclpy.init()
    node = rclpy.create_node("eitskin_listener")
    topics = {
        f"{base}/wrench": (WrenchStamped, wrench, 10),
        **{f"{base}/contacts/slot{k}": (WrenchStamped, wrench, 10) for k in range(4)},
        f"{base}/contacts": (MarkerArray, markers, 10),
        f"{base}/contacts/poses": (PoseArray, poses, 10),
        f"{base}/pressure": (PointCloud2, cloud, qos_profile_sensor_data),
        f"{base}/image": (Image, image, qos_profile_sensor_data),
        f"{base}/valid": (Bool, lambda m: m.data, 10),
        "/diagnostics": (DiagnosticArray, diagnostics, 10),
    }
    if named:
        topics = {f"{base}/{name}": topics[f"{base}/{name}"] for name in named}

    def subscribe(topic, kind, read, qos):
        def on_message(message):
            now, monotonic = time.time(), time.monotonic_ns()
            header = getattr(message, "header", None)
            if header is None and getattr(message, "markers", None):
                header = message.markers[0].header
            stamp = None if header is None else header.stamp.sec + header.stamp.nanosec * 1e-9
            frame = None if header is None else header.frame_id
            say(topic=topic, at=now, monotonic_ns=monotonic, stamp=stamp, frame=frame, value=read(message))

        node.create_subscription(kind, topic, on_message, qos)

    for topic, (kind, read, qos) in topics.items():
        subscribe(topic, kind, read, qos)
    client = node.create_client(Trigger, f"{base}/tare")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    asked = threading.Event()

    def orders():
        for line in sys.stdin:
            if line.strip() == "tare":
                asked.set()
        rclpy.try_shutdown()

    threading.Thread(target=orders, daemon=True).start()
    say(topic="ready", at=time.time())
    told, answer, began = False, None, time.time()
    while rclpy.ok():
        try:
            executor.spin_once(timeout_sec=0.05)
        except rclpy.executors.ExternalShutdownException:
            break
        if not told and time.time() - began > 3:
            began = time.time()
            found = {t: [str(i.topic_type_hash) for i in node.get_publishers_info_by_topic(t)] for t in topics}
            told = all(found.values())
            say(topic="hashes", at=time.time(), value=found)
        if asked.is_set():
            asked.clear()
            say(topic="service", at=time.time(), value=client.wait_for_service(timeout_sec=5.0))
            answer = client.call_async(Trigger.Request())
        if answer is not None and answer.done():
            said = answer.result()
            say(topic="tare", at=time.time(), value=[said.success, said.message])
            answer = None


if __name__ == "__main__":
    main()
