"""What a board is to scan, and whether a board can."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol import link


@dataclass(frozen=True)
class Scanning:
    """What the board is to do: scan list (K, 4) of electrodes, DFT points, gain resistor."""

    pattern: NDArray[np.integer]
    dft_points: int
    rtia_ohm: float

    @property
    def config(self) -> int:
        """Id of this configuration on the board: from its content, so that one of an earlier session is never taken
        for it.
        """
        text = self.pattern.astype("u1").tobytes() + f"{self.dft_points} {self.rtia_ohm:g}".encode()
        return zlib.crc32(text) & 0xFFFF


def unfit(ident: link.Ident, scanning: Scanning) -> str:
    """Why this board cannot scan that, for a person; "" where it can."""
    needed = int(scanning.pattern.max()) + 1
    if ident.schema_hash != link.SCHEMA_HASH or ident.link_version != link.LINK_VERSION:
        found, ours = f"{ident.schema_hash:08x}", f"{link.SCHEMA_HASH:08x}"
        return f"firmware {ident.firmware!r} speaks schema {found}, this program {ours}: flash a matching one"
    if ident.chip_id != link.CHIP_ID:
        found = f"0x{ident.chip_id:04x}"
        return f"the converter says chip id {found}, expected 0x{link.CHIP_ID:04x}: power-cycle the board"
    if ident.electrodes < needed or ident.max_scan < len(scanning.pattern):
        return (
            f"the board has {ident.electrodes} electrodes and takes {ident.max_scan} measurements; "
            f"the bundle needs {needed} and {len(scanning.pattern)}"
        )
    return ""
