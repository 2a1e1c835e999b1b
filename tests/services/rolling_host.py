"""A skin whose scans come in parts, in simulated time, after five seconds untouched; `raws`: what was handed on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from simulation.host import SimulatedHost


@contextmanager
def rolling_host(seed: int) -> Iterator[SimulatedHost]:
    host = SimulatedHost("rolling", snr_db=80.0, seed=seed, keep=True)
    host.until(5.0)
    yield host
    host.close()
