"""An arm of a given speed and deceleration moves into the stub's skin, again and again, until a contact frame stops it.
Says how far it goes on after it touched: what the skin takes to tell, and what the arm takes to stand.

The arm and the foam that it dents are calculated, the skin that feels it is the stub's, the frames are the running
service's. Runs on the service's own machine, as it compares clocks.

Exit status: 0 each touch stopped the arm, 1 the skin could not be trusted or is no stub's, 2 a touch did not stop it.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from examples.robot import options
from protocol.client import ContactSubscriber, Stale
from protocol.control import ControlClient, ControlError

MOST_N = 5.0  # the stub's foam gives way no more
HELD_S, APART_S, FIRST_S = 0.5, 1.5, 1.0
BEGINS_S = 0.3  # before it touches, the arm begins to move, unless the skin cannot be trusted then
REACH_M = 0.03  # touches lie so near the middle
RADIUS_M = 0.008  # of what touches
SOLVE_S = 60.0  # the stub solves its physics before the first touch


@dataclass(frozen=True)
class Arm:
    """speed [m/s], deceleration [m/s^2] once it is told to stop, stiffness [N/m] of the foam under its tip."""

    speed: float
    deceleration: float
    stiffness: float

    def goes_on_m(self, told_s: float) -> float:
        """From where it touched to where it stands, told to stop so long after it touched."""
        return self.speed * told_s + self.speed**2 / (2 * self.deceleration)

    @property
    def rises_s(self) -> float:
        """How long the force of one that does not stop grows."""
        return MOST_N / (self.stiffness * self.speed)

    def scene(self, onsets: Sequence[float], chosen: random.Random) -> str:
        """What the stub is to press: at each of these seconds the arm arrives, and does not stop."""
        text = [f'about = "an arm at {self.speed} m/s"\nduration = {onsets[-1] + self.rises_s + 2 * HELD_S}']
        for onset in onsets:
            x, y = (chosen.uniform(-REACH_M, REACH_M) for _ in range(2))
            full = onset + self.rises_s
            times = ((onset, 0.0), (full, MOST_N), (full + HELD_S, MOST_N), (full + HELD_S + 0.01, 0.0))
            keys = ", ".join(f"{{ t = {t!r}, x = {x!r}, y = {y!r}, force = {force!r} }}" for t, force in times)
            text.append(f"[[touch]]\nradius = {RADIUS_M!r}\nkeys = [{keys}]")
        return "\n".join(text) + "\n"


def told_s(skin: ContactSubscriber, touch_ns: int, max_age: float | None = None) -> float | None:
    """How long after it touched (host monotonic time) the arm was told to stop; None where it was not told in time.
    Raises Stale where the skin cannot be trusted while the arm moves: it stops then, too.
    """
    while True:
        try:
            frame = skin.next_frame(max_age)
        except Stale:
            if time.monotonic_ns() < touch_ns - round(1e9 * BEGINS_S):
                continue
            raise
        after_s = 1e-9 * (time.monotonic_ns() - touch_ns)
        if after_s > HELD_S:
            return None
        if after_s > 0 and frame.contacts:
            return after_s


def approaches(arm: Arm, skin: ContactSubscriber, count: int, seed: int, max_age: float | None) -> list[float | None]:
    """`told_s` of so many touches at random places. Raises Stale, and ControlError where there is no stub."""
    apart_s, chosen = arm.rises_s + HELD_S + APART_S, random.Random(seed)
    onsets = [FIRST_S + n * apart_s + chosen.uniform(0.0, 0.1) for n in range(count)]
    with tempfile.TemporaryDirectory(prefix="eitskin-reflex") as folder:
        script = Path(folder) / "reflex.toml"
        script.write_text(arm.scene(onsets, chosen))
        start_ns = int(ControlClient("stub", SOLVE_S).call("scene", name=str(script), solved=True)["start_ns"])
    return [told_s(skin, start_ns + round(1e9 * onset), max_age) for onset in onsets]


def row(arm: Arm, told: Sequence[float]) -> str:
    """What is printed of one speed."""
    if not told:
        return f"{arm.speed:9g}   no touch was told"
    far = [1e3 * arm.goes_on_m(after) for after in told]
    times, ways = f"{1e3 * median(told):26.0f}, {1e3 * max(told):6.0f}", f"{median(far):19.1f}, {max(far):4.1f}"
    return f"{arm.speed:9g}   {times}   {ways}   {1e3 * arm.goes_on_m(0.0):18.1f}"


def main() -> int:
    parser = options(str(__doc__))
    parser.add_argument("--speeds", type=float, nargs="+", default=[0.05, 0.1, 0.25, 0.5], help="m/s")
    parser.add_argument("--deceleration", type=float, default=10.0, help="m/s^2")
    parser.add_argument("--stiffness", type=float, default=2000.0, help="of the foam under the tip, N/m")
    parser.add_argument("--touches", type=int, default=10, help="at each speed")
    parser.add_argument("--seed", type=int, default=1, help="of their places")
    given = parser.parse_args()
    print(
        "speed m/s   told to stop after, ms: median, latest   goes on, mm: median, most   of which it brakes",
        flush=True,
    )
    missed = 0
    try:
        with ContactSubscriber(given.skin, given.endpoint) as skin:
            skin.latest()
            for speed in given.speeds:
                arm = Arm(speed, given.deceleration, given.stiffness)
                told = approaches(arm, skin, given.touches, given.seed, given.max_age)
                missed += told.count(None)
                print(row(arm, [after for after in told if after is not None]), flush=True)
    except Stale as why:
        print(f"stopped, the skin cannot be trusted: {why}")
        return 1
    except ControlError as why:
        print(f"only a stub's skin can be told to be touched: {why}")
        return 1
    if missed:
        print(f"{missed} touches did not stop the arm")
    return 2 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
