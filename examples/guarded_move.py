"""Moves down until it presses with a force where contact is expected; backs off from contact anywhere else. Says how
long ago it was measured what it stopped for. With scans in parts, the default, the contact itself is known some 8 ms
after it began, plus what the computer takes (docs/figures.md, Speed).

Exit status: 0 the force was reached, 1 the skin could not be trusted, 2 backed off.
"""

from __future__ import annotations

import math
import sys
import time

from examples.robot import Robot, Vector, options
from protocol.client import ContactSubscriber, Stale
from protocol.frames import Contact, ContactFrame
from protocol.runtime import host_id

DOWN: Vector = (0.0, 0.0, -0.02)  # m/s
BACK: Vector = (0.0, 0.0, 0.05)
BACK_OFF_M = 0.01
EXPECTED_M = 0.025  # contact is expected so near the skin's centre


def guarded_move(robot: Robot, skin: ContactSubscriber, newtons: float, max_age: float | None = None) -> int:
    try:
        while True:
            frame = skin.next_frame(max_age)
            contacts = frame.contacts
            if not all(map(expected, contacts)):
                robot.stop()
                print(f"contact where none is expected{ago(frame)}:", *map(describe, contacts))
                return back_off(robot, skin, max_age)
            if sum(map(force, contacts)) >= newtons:
                robot.stop()
                print(f"force reached{ago(frame)}:", *map(describe, contacts))
                return 0
            robot.move(DOWN)
    except Stale as why:
        robot.stop()
        print(f"aborted, the skin cannot be trusted: {why}")
        return 1


def back_off(robot: Robot, skin: ContactSubscriber, max_age: float | None) -> int:
    """Away from what is touched, but not blindly: Stale ends this too."""
    top = robot.position[2] + BACK_OFF_M
    while robot.position[2] < top:
        robot.move(BACK)
        skin.next_frame(max_age)
    robot.stop()
    print(f"backed off by {1e3 * BACK_OFF_M:.0f} mm")
    return 2


def expected(contact: Contact) -> bool:
    return math.hypot(contact.position[0], contact.position[1]) <= EXPECTED_M


def force(contact: Contact) -> float:
    """Newtons; of a skin without a force law any contact counts as too much."""
    return math.inf if contact.force_n is None else contact.force_n


def ago(frame: ContactFrame) -> str:
    """How long ago it was measured, where its stamps are of this machine's clock."""
    if frame.host != host_id() or "sample" not in frame.stamps:
        return ""
    return f", stopped {1e-6 * (time.monotonic_ns() - frame.stamps['sample']):.0f} ms after it was measured"


def describe(contact: Contact) -> str:
    return f"({1e3 * contact.position[0]:+.1f}, {1e3 * contact.position[1]:+.1f}) mm with {force(contact):.1f} N"


if __name__ == "__main__":
    parser = options(str(__doc__))
    parser.add_argument("--newtons", type=float, default=2.0)
    given = parser.parse_args()
    with Robot() as robot, ContactSubscriber(given.skin, given.endpoint) as palm:
        sys.exit(guarded_move(robot, palm, given.newtons, given.max_age))
