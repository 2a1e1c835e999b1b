"""A node of ROS 1: /eitskin/SKIN/wrench from the skin's contacts, as a start for more.

    .venv/bin/python -m examples.ros1_bridge --skin palm

Needs a roscore, and Debian's python3-rospy and python3-geometry-msgs. What is not valid is not published: a subscriber
that looks at the age of the newest wrench stops.
"""

from __future__ import annotations

import math
import sys
import time

from examples.robot import options
from protocol.client import ContactSubscriber, Stale

DEBIAN = "/usr/lib/python3/dist-packages"  # where its packages are; ours come first

sys.path.append(DEBIAN)
import rospy  # noqa: E402
from geometry_msgs.msg import WrenchStamped  # noqa: E402


def main() -> int:
    given = options(str(__doc__)).parse_args()
    rospy.init_node("eitskin")
    out = rospy.Publisher(f"/eitskin/{given.skin}/wrench", WrenchStamped, queue_size=1, tcp_nodelay=True)
    with ContactSubscriber(given.skin, given.endpoint) as skin:
        while not rospy.is_shutdown():
            try:
                frame = skin.next_frame(given.max_age)
            except Stale as why:
                rospy.logwarn_throttle(1.0, f"nothing is published: {why}")
                continue
            contacts = frame.contacts
            if "uncalibrated_force" in frame.reasons or any(contact.force_n is None for contact in contacts):
                rospy.logwarn_throttle(10.0, "nothing is published: the skin has no force law")
                continue
            message = WrenchStamped()
            message.header.frame_id = frame.frame_id
            age_s = (time.monotonic_ns() - frame.stamps["sample"]) * 1e-9  # of this host's clock
            message.header.stamp = rospy.Time.from_sec(time.time() - age_s)
            total = [math.fsum(each) for each in zip(*(c.wrench for c in contacts), strict=True)] or [0.0] * 6
            force, torque = message.wrench.force, message.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = total
            out.publish(message)
    return 0


if __name__ == "__main__":
    sys.exit(main())
