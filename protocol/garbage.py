"""Garbage collection that does not hold up a process which must be quick.

With the modules of a service or a bridge a full collection walks some hundred thousand objects: 15 to 60 ms in which no
frame is handled.
"""

from __future__ import annotations

import gc


def settle() -> None:
    """Take all living objects to be permanent: the garbage collector never walks them again, and the others seldom. The
    first call takes some ten milliseconds, later ones a fraction of that.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 50, 50)
