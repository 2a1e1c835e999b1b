"""Follows a finger that pushes the skin: admittance, M dv/dt + D v = F, so that it feels like a mass in honey.

A push to the side of the centre moves the robot to that side, a push at the centre away from the finger. It stands
still while the skin cannot be trusted, and goes on when it can again. Ctrl-C ends it.
"""

from __future__ import annotations

import math
import time

from examples.robot import Robot, Vector, options
from protocol.client import ContactSubscriber, Stale
from protocol.frames import Contact

MASS_KG, DAMPING = 4.0, 40.0  # [kg], [N s/m]: it answers within MASS_KG / DAMPING = 0.1 s
DEAD_N, DEAD_M = 0.3, 0.004  # lighter, and nearer to the centre, than this is no intention
REACH_M = 0.05  # from the skin's centre to its edge
FASTEST = 0.1  # m/s
LONGEST_STEP_S = 0.1  # that one frame may change the velocity by, however long it was waited for
STILL = 0.0005  # m/s: slower than this is standing


def follow(robot: Robot, skin: ContactSubscriber, max_age: float | None = None, seconds: float = math.inf) -> None:
    velocity: Vector = (0.0, 0.0, 0.0)
    then = began = time.monotonic()
    trusted: bool | None = None  # what was said last of the skin
    while then - began < seconds:
        try:
            frame = skin.next_frame(max_age)
        except Stale as why:
            if trusted is not False:
                print(f"holding still: {why}", flush=True)
            trusted, velocity = False, (0.0, 0.0, 0.0)
        else:
            if not trusted:
                print("following: push the skin", flush=True)
            trusted = True
            velocity = answer(velocity, push(frame.contacts), min(time.monotonic() - then, LONGEST_STEP_S))
        then = time.monotonic()
        robot.move(velocity)
    robot.stop()


def push(contacts: list[Contact]) -> Vector:
    """The fingers' intention as a force [N] on the robot, dead bands taken off."""
    fx = fy = fz = 0.0
    for contact in contacts:
        newtons = max(0.0, (contact.force_n or 0.0) - DEAD_N)
        x, y, _ = contact.position
        away = math.hypot(x, y)
        sideways = newtons * max(0.0, away - DEAD_M) / REACH_M
        fx += sideways * x / max(away, DEAD_M)
        fy += sideways * y / max(away, DEAD_M)
        fz -= newtons
    return fx, fy, fz


def answer(velocity: Vector, force: Vector, dt: float) -> Vector:
    """The velocity `dt` seconds on: towards force / DAMPING, with the mass's time constant; never above FASTEST."""
    share = 1 - math.exp(-dt * DAMPING / MASS_KG)
    x, y, z = (v + share * (f / DAMPING - v) for v, f in zip(velocity, force, strict=True))
    speed = math.hypot(x, y, z)
    if speed < STILL:
        return 0.0, 0.0, 0.0
    slower = min(1.0, FASTEST / speed)
    return slower * x, slower * y, slower * z


if __name__ == "__main__":
    parser = options(str(__doc__))
    parser.add_argument("--seconds", type=float, default=math.inf)
    given = parser.parse_args()
    with Robot() as robot, ContactSubscriber(given.skin, given.endpoint) as palm:
        follow(robot, palm, given.max_age, given.seconds)
