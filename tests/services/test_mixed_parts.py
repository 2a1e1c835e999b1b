"""Parts that a relay between board and host sends late, twice, in another order, under another number or of another
configuration: never a valid frame of a mixture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from protocol import link
from tests.services.gap_host import GapHost, Press

Relay = Callable[[link.ScanFrame, list[link.ScanFrame], np.random.Generator], list[link.ScanFrame]]
MOVES_S = 5.0
FROM_S = 4.7


def late(scan, before, rng):
    """Every third part comes two parts late."""
    if scan.seq % 3 == 0:
        return []
    return [scan, before[-2]] if scan.seq % 3 == 2 and len(before) > 1 else [scan]


def twice(scan, before, rng):
    return [scan, scan]


def swapped(scan, before, rng):
    return [scan, before[-1]] if scan.seq % 2 else []


def of_an_earlier_scan(scan, before, rng):
    """Some parts are those of a second ago, under their own numbers or under the present one."""
    old = before[-230] if len(before) > 230 and rng.random() < 0.2 else scan
    return [replace(old, seq=scan.seq) if rng.random() < 0.5 else old]


def wrong_number(scan, before, rng):
    return [replace(scan, seq=scan.seq + int(rng.integers(-12, 13)))] if rng.random() < 0.1 else [scan]


def wrong_part(scan, before, rng):
    return [replace(scan, part=int(rng.integers(0, 10)))] if rng.random() < 0.1 else [scan]


def of_another_configuration(scan, before, rng):
    """Between the parts there are those of a board that was told something else."""
    other = replace(scan, config=scan.config ^ 1, z=scan.z * 2, part=(scan.part + 5) % 10)
    return [other, scan] if rng.random() < 0.3 else [scan]


@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.release) for n in range(2, 4))])
@pytest.mark.parametrize(
    "relay", [late, twice, swapped, of_an_earlier_scan, wrong_number, wrong_part, of_another_configuration]
)
def test_no_frame_of_a_mixture_is_valid(relay: Relay, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.034, -0.01, 2)
    host = GapHost("rolling", seed, [Press(x, y, 4.0, MOVES_S), Press(-x, -y, MOVES_S + 0.3, 20.0)])
    pull, decoder, before = host.rig.pull, link.Decoder(), []

    def relayed(now: float) -> bytes:
        sent = b""
        for message in decoder.feed(pull(now)):
            scan = isinstance(message, link.ScanFrame)
            for each in relay(message, before, rng) if scan and now > FROM_S else [message]:
                sent += link.encode(each)
            before.extend([message] if scan else [])
        return sent

    host.rig.pull = relayed
    host.until(MOVES_S + 0.8)
    raws = [frame for at, frame in host.frames if at > FROM_S]
    host.close()
    assert not host.wrong(FROM_S), "\n".join(map(str, host.wrong(FROM_S)[:5]))
    if relay in (twice, of_another_configuration):
        assert sum(frame.valid for frame in raws) > 0.9 * len(raws) > 30
