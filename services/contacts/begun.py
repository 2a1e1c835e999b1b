"""A touch that began since the last whole scan, as the parts since then tell of it, beside what images show."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from protocol.frames import BegunTouch, ImageFrame, LocatedTouch, PartFrame
from services.contacts.motion import Patch
from services.contacts.segmentation import Segment
from services.runtime.stage import inherited


def without_image(part: PartFrame, metres_per_pixel: float, origin: list[float]) -> ImageFrame:
    """The image frame of a part in which a touch began: no image shows it yet."""
    out = ImageFrame(**inherited(part), touched=True, reconstructed=part.scan)
    out.metres_per_pixel, out.origin = metres_per_pixel, origin
    out.residual = None if part.began is None else part.began.unexplained
    return out


def possible(touch: BegunTouch, metres_per_pixel: float, origin: Sequence[float], size: int) -> bool:
    """Whether it is one that an image of size x size pixels could show."""
    side = size * metres_per_pixel
    inside = all(low <= at <= low + side for at, low in zip(touch.position, origin, strict=True))
    return inside and touch.drop > 0 and touch.integral <= touch.drop * side**2


def begun(
    touch: BegunTouch, metres_per_pixel: float, origin: Sequence[float], size: int
) -> tuple[list[Segment], list[Patch], list[LocatedTouch]]:
    """What an image of size x size pixels would show of it: a disc of its place, drop and area."""
    m, (x, y) = metres_per_pixel, touch.position
    area = touch.integral / max(touch.drop, 1e-12)
    radius = math.sqrt(area / math.pi)
    column, row = (x - origin[0]) / m - 0.5, (y - origin[1]) / m - 0.5
    mask = np.hypot(np.arange(size)[None, :] - column, np.arange(size)[:, None] - row) <= max(radius / m, 1.0)
    drawn = Segment(
        mask=mask,
        peak=touch.drop,
        peak_sigma=touch.drop_sigma,
        volume=touch.integral / m**2,
        x=column,
        y=row,
        area=area / m**2,
        orientation=0.0,
        reach=radius / m,
        whole=touch.integral / m**2,
    )
    seen = Patch(x, y, touch.integral, radius)
    return [drawn], [seen], [LocatedTouch(position=touch.position, sigma=touch.sigma, amplitude=touch.integral)]
