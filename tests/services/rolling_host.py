"""A skin whose scans come in parts, on the stub's board, link and clock in simulated time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bench.speed.simulated_host import SimulatedHost
from protocol.frames import pack, unpack


@contextmanager
def rolling_host(seed: int) -> Iterator[SimulatedHost]:
    """After five seconds untouched. `raws`: the raw frames that were handed on, as they were then."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=seed)
    host.raws = []
    hand_on = host.source.handed_on

    def kept(*args):
        frame = hand_on(*args)
        host.raws += [unpack(pack(frame))] if frame else []
        return frame

    host.source.handed_on = kept
    host.until(5.0)
    yield host
    host.rig.close()
