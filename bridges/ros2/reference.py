"""A force-torque sensor of the robot as reference/SKIN: what `skin calibrate --live` learns from."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from cyclonedds.domain import DomainParticipant

from bridges.clock import WallClock
from bridges.process import BridgeError
from protocol.frames import ReferenceFrame

from .dds import RosReader

MOST_AGE_S = 10.0
"""A stamp further than that from now is of another clock: of simulated time, of a host whose time is not set."""


class RosReference:
    """One skin's. `axis` says which force presses the skin: "-z" where a press gives a negative z, as in our wrench."""

    def __init__(self, skin: str, topic: str, axis: str, participant: DomainParticipant, clock: WallClock) -> None:
        self._skin, self._axis, self._turn = skin, axis[-1], -1.0 if axis.startswith("-") else 1.0
        self._clock = clock
        self._reader = RosReader(participant, topic, "geometry_msgs/WrenchStamped")

    def frames(self) -> Iterator[ReferenceFrame]:
        """What has come since the last call."""
        for message in self._reader.take():
            force = self._turn * float(getattr(message.wrench.force, self._axis))
            stamp = message.header.stamp
            now = time.monotonic_ns()
            sent_ns = int(message.sample_info.source_timestamp)
            wall_ns = stamp.sec * 1_000_000_000 + stamp.nanosec or sent_ns  # a stamp of 0 is none
            sample = wall_ns - self._clock.offset_ns
            known = abs(now - sample) < MOST_AGE_S * 1e9 and sample >= 0
            yield ReferenceFrame(
                skin=self._skin,
                stamps={"sample": sample if known else now},
                sample_sigma_ns=self._clock.uncertainty_ns,
                valid=known,
                reasons=[] if known else ["clock"],
                force_n=force,
            )


def references(asked: Any, skins: Any, participant: DomainParticipant, clock: WallClock) -> list[RosReference]:
    """Those of the section's `reference`. Raises BridgeError for a skin that is none."""
    for skin in asked:
        if skin not in skins:
            raise BridgeError(f"[ros2.reference] names the skin {skin!r}, expected one of {', '.join(skins)}")
    return [RosReference(skin, how["topic"], how["axis"], participant, clock) for skin, how in asked.items()]
