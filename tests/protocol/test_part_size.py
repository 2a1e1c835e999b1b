"""What parts take on the line, against encoded messages; and how many of them the line carries."""

import numpy as np
import pytest

from protocol import link
from protocol.part_size import BAUD, MOST_LOAD, frame_bytes, line_load, line_s, parts_on_line
from protocol.scan_setting import COHERENT, NAMED, ScanSetting

QUICKEST = ScanSetting(50_000, 32)


@pytest.mark.parametrize("measurements", [1, 7, 12, 60, 120, 512])
def test_a_message_is_as_long_as_it_is_encoded(measurements):
    values = np.random.default_rng(measurements).standard_normal((measurements, 2)).astype("f4").view("c8")[:, 0]
    status = np.zeros(measurements, np.uint8)
    message = link.ScanFrame(2**31 + 1, 2**60 + 1, 4358, 7, values, status, 3, 10)
    found = len(link.encode(message))
    assert frame_bytes(measurements) - found in range(1 + found // 254)  # runs that a 0 ends need no byte


def test_a_part_of_twelve_takes_a_millisecond_and_a_half():
    assert line_s(12, 921_600) == pytest.approx(1.43e-3, rel=0.02)
    assert line_s(12, 2_000_000) == pytest.approx(0.66e-3, rel=0.02)


def test_a_line_that_carries_them_gets_the_most_parts():
    for setting in NAMED.values():
        assert parts_on_line(120, 10, setting, BAUD) == 10
        assert parts_on_line(120, 10, setting, 2_000_000) == 10
    assert parts_on_line(120, 1, COHERENT, BAUD) == 1


def test_a_slow_line_gets_fewer_and_at_last_whole_scans():
    """The quickest setting measures a part of twelve in 1.48 ms, which is the line's time for it."""
    assert line_load(120, 10, QUICKEST, BAUD) > 0.9 and parts_on_line(120, 10, QUICKEST, BAUD) < 10
    assert parts_on_line(120, 10, QUICKEST, 2_000_000) == 10
    found = [parts_on_line(120, 10, COHERENT, baud) for baud in (921_600, 400_000, 350_000, 320_000, 9_600)]
    assert found == sorted(found, reverse=True) and found[0] == 10 and found[-1] == 1 and len(set(found)) > 2
    for baud, parts in zip((921_600, 400_000, 350_000), found, strict=False):
        assert line_load(120, parts, COHERENT, baud) <= MOST_LOAD
