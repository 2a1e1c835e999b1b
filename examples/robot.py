"""A simulated robot: a point that moves at the commanded velocity and prints what it does."""

from __future__ import annotations

import argparse
import time

Vector = tuple[float, float, float]

COMMAND_S = 0.5
"""How long a velocity command holds: as a real drive, it stops by itself when the controller falls silent."""
SAY_S = 0.5
"""How often at most a change of velocity is printed; starting and stopping always are."""


class Robot:
    """Moves at the velocity [m/s] last commanded, COMMAND_S at most. Positions in metres, from where it began.

    As a context it stands still afterwards, however its controller ended.
    """

    def __init__(self) -> None:
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self._position: Vector = (0.0, 0.0, 0.0)
        self._commanded = self._said = self._then = time.monotonic()

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *why: object) -> None:
        self.stop()

    @property
    def position(self) -> Vector:
        """Where it is now."""
        now = time.monotonic()
        moved_s = max(0.0, min(now, self._commanded + COMMAND_S) - self._then)
        x, y, z = (p + v * moved_s for p, v in zip(self._position, self.velocity, strict=True))
        self._position, self._then = (x, y, z), now
        return self._position

    def move(self, velocity: Vector) -> None:
        """Go on at `velocity`; to be repeated at least every COMMAND_S."""
        place, now = self.position, time.monotonic()
        started = any(velocity) != any(self.velocity)
        if started or (velocity != self.velocity and now - self._said > SAY_S):
            word = f"moves at {millimetres(velocity)}/s" if any(velocity) else "stands"
            print(f"robot {word}, at {millimetres(place)}", flush=True)
            self._said = now
        self.velocity, self._commanded = velocity, now

    def stop(self) -> None:
        """Stand still."""
        self.move((0.0, 0.0, 0.0))


def millimetres(v: Vector) -> str:
    return "({:+.1f}, {:+.1f}, {:+.1f}) mm".format(*(1e3 * c for c in v))


def options(about: str) -> argparse.ArgumentParser:
    """What the examples' command lines have in common."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--skin", default="palm")
    parser.add_argument("--endpoint", help="of the publisher, where it is not in the runtime folder: tcp://HOST:PORT")
    parser.add_argument(
        "--max-age", type=float, help="seconds without a frame that count as silence (default: what the frames say)"
    )
    return parser
