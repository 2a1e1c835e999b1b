"""Names as ROS allows them."""

from __future__ import annotations

import re


def topic_base(skin: str) -> str:
    """The beginning of a skin's topics: `/eitskin/palm`. A part of a ROS name has letters, digits and _ alone, and does
    not begin with a digit.
    """
    part = re.sub(r"\W", "_", skin, flags=re.ASCII)
    return f"/eitskin/{'_' if part[:1].isdigit() else ''}{part}"
