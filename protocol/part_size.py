"""What a scan takes on the serial line, and how many parts of it the line carries."""

from __future__ import annotations

from .link_messages import PARTS
from .scan_setting import ScanSetting

BAUD = 921_600
"""Bits a second of the line where skin.toml says nothing: the fastest that every USB bridge has."""
FASTEST_BAUD = 12_000_000
"""USB at full speed; a serial bridge is slower."""
SLOWEST_BAUD = 9_600
BITS_A_BYTE = 10
"""8N1: a start bit, eight, a stop bit."""
MOST_LOAD = 0.8
"""Share of the time that parts may take on the line: what comes beside them (TIME, EVENT) and a slower crystal need
some of the rest. Our choice."""
FRAME_HEAD = 23
"""Bytes of a FRAME before its values: number, seq, device_us, duration_us, config, part, parts, n."""
FRAMING = 4 + 2
"""CRC-32 and two delimiters."""
STUFFED = 254
"""COBS adds a byte, and one more for each run of so many without a 0."""


def frame_bytes(measurements: int) -> int:
    """Bytes that a FRAME of so many measurements takes on the line, at most."""
    body = FRAME_HEAD + 8 * measurements + (measurements + 1) // 2
    return body + FRAMING + (body + 4) // STUFFED + 1


def line_s(measurements: int, baud: int) -> float:
    """Seconds that a FRAME takes on the line."""
    return frame_bytes(measurements) * BITS_A_BYTE / baud


def line_load(measurements: int, parts: int, setting: ScanSetting, baud: int) -> float:
    """Share of the time in which a scan of so many measurements, in so many parts, occupies the line."""
    return line_s(measurements // parts, baud) * parts / setting.scan_s(measurements)


def parts_on_line(measurements: int, at_most: int, setting: ScanSetting, baud: int) -> int:
    """Into how many parts a scan is cut: at_most, or a divisor of it, by which parts join and their order stays. The
    more parts, the sooner each value is known; but each has a head of its own, which the line has to carry.
    """
    fits = [n for n in PARTS if at_most % n == 0 and line_load(measurements, n, setting, baud) <= MOST_LOAD]
    return max(fits, default=1)
