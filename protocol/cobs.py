"""Consistent overhead byte stuffing: bytes without any 0, so that 0 can end a frame (Cheshire and Baker, 1999).

Costs one byte in 254 and one more; a receiver is back in step at the next 0, whatever it missed.
"""

from __future__ import annotations


def cobs_encode(data: bytes) -> bytes:
    """`data` with its zeros stuffed away; the ending 0 is not added."""
    out = bytearray()
    parts = data.split(b"\0")
    last = len(parts) - 1
    for i, part in enumerate(parts):
        while len(part) >= 254:
            out.append(255)
            out += part[:254]
            part = part[254:]
            if i == last and not part:
                return bytes(out)
        out.append(len(part) + 1)
        out += part
    return bytes(out)


def cobs_decode(stuffed: bytes) -> bytes:
    """What `cobs_encode` was given. Raises ValueError where no encoder makes such bytes: a 0 inside, or a block cut
    short.
    """
    out = bytearray()
    at, end = 0, len(stuffed)
    while at < end:
        code = stuffed[at]
        if code == 0 or at + code > end:
            raise ValueError(f"block of {code} bytes at {at} of {end}")
        block = stuffed[at + 1 : at + code]
        if 0 in block:
            raise ValueError(f"a 0 inside the block at {at}")
        out += block
        at += code
        if code < 255 and at < end:
            out.append(0)
    return bytes(out)
