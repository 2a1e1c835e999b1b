"""What really touches, published beside the board's frames so that somebody can keep the score."""

from __future__ import annotations

from protocol.frames import TrueTouch, TruthFrame

from .board import MeasuredScan
from .sheet import Sheet
from .world import Touch, World


def truth_frame(skin: str, sheet: Sheet, scan: MeasuredScan, world: World, stamps: dict[str, int]) -> TruthFrame:
    """The truth at the middle of a scan. stamps [ns] on the host's monotonic clock, where both are exact: `sample`, and
    `publish`, when the scan's last byte had left the board.
    """
    return TruthFrame(
        skin=skin,
        scan=scan.seq,
        stamps=stamps,
        source="stub",
        valid=True,
        touches=[_touch(sheet, touch) for touch in world.touches if touch.drop > 0],
    )


def _touch(sheet: Sheet, touch: Touch) -> TrueTouch:
    return TrueTouch(
        shape=touch.kind,
        x=touch.x,
        y=touch.y,
        radius_m=touch.radius,
        rotation=touch.rotation,
        aspect=touch.aspect,
        drop=touch.drop,
        force_n=touch.force_n,
        outline=sheet.outline(touch).tolist(),
    )
