"""What a board is to scan, and whether a board can."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from protocol import link
from protocol.scan_setting import ScanSetting


@dataclass(frozen=True)
class Scanning:
    """What the board is to do: measurements (K, 4) of electrodes, how each is measured, gain resistor. order (K,): of
    the measurements, part after part, so that any share of a scan sees the whole skin; None: the pattern's.
    """

    pattern: NDArray[np.integer]
    setting: ScanSetting
    rtia_ohm: float
    parts: int = 1
    order: NDArray[np.integer] | None = None

    @property
    def scan_list(self) -> NDArray[np.integer]:
        """(K, 4), as the board measures them."""
        return self.pattern if self.order is None else self.pattern[self.order]

    @property
    def whole(self) -> Scanning:
        """The same as whole scans."""
        return replace(self, parts=1)

    @property
    def config(self) -> int:
        """Id of this configuration on the board: from its content, so that one of an earlier session is never taken
        for it.
        """
        text = self.scan_list.astype("u1").tobytes() + f"{self.setting} {self.rtia_ohm:g}".encode()
        text += f" {self.parts}".encode() if self.parts > 1 else b""
        return zlib.crc32(text) & 0xFFFF

    def sent(self, scan: link.ScanFrame) -> bool:
        """Whether a FRAME is one of this list, or of its parts."""
        whole = scan.parts == self.parts and scan.part < self.parts
        return scan.config == self.config and whole and len(scan.z) * self.parts == len(self.pattern)


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
