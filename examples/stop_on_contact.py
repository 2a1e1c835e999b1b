"""Moves until something touches the skin, or until the skin cannot be trusted; then stops at once.

Exit status: 0 stopped by a contact, 1 by silence or by a frame that is not valid.
"""

from __future__ import annotations

import sys

from examples.robot import Robot, Vector, options
from protocol.client import ContactSubscriber, Stale

VELOCITY: Vector = (0.05, 0.0, 0.0)  # m/s


def stop_on_contact(robot: Robot, skin: ContactSubscriber, max_age: float | None = None) -> int:
    """Each frame, also an empty one, is the permission to move on until the next."""
    try:
        while not (frame := skin.next_frame(max_age)).contacts:
            robot.move(VELOCITY)
    except Stale as why:
        robot.stop()
        print(f"stopped, the skin cannot be trusted: {why}")
        return 1
    robot.stop()
    x, y, _ = frame.contacts[0].position
    print(f"stopped by frame {frame.seq}: contact at ({1e3 * x:+.1f}, {1e3 * y:+.1f}) mm")
    return 0


if __name__ == "__main__":
    given = options(str(__doc__)).parse_args()
    with Robot() as robot, ContactSubscriber(given.skin, given.endpoint) as palm:
        sys.exit(stop_on_contact(robot, palm, given.max_age))
