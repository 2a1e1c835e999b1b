"""The frames of the service's four hops, of the sizes that a moving touch makes."""

from __future__ import annotations

import numpy as np

from protocol.frames import Contact, ContactFrame, DeltaFrame, Frame, ImageFrame, RawFrame, pack

HOPS = (("acquisition", "raw"), ("preprocessing", "delta"), ("inference", "image"), ("publisher", "contact"))
"""Who sends, and what."""

STAMPS = ("sample", "read", "preprocess", "infer", "publish")
K, N, PIXELS, CLASSES = 120, 24, 96, 5


def hop(n: int) -> Frame:
    """A frame of hop n."""
    of = np.float32
    made: Frame
    if n == 0:
        made = RawFrame(skin="palm", z=np.ones(K, np.complex64), status=np.zeros(K, np.uint8), board="relay")
    elif n == 1:
        made = DeltaFrame(skin="palm", difference=np.zeros(K, of), sigma=np.ones(K, of), touched=True)
    elif n == 2:
        made = ImageFrame(skin="palm", image=np.zeros((PIXELS, PIXELS), of), touched=True)
        made.sigma, made.classes = np.ones((PIXELS, PIXELS), of), np.zeros((CLASSES, N, N), of)
    else:
        contact = Contact(id=1, state="hold", position=[0.0, 0.0, 0.0], force_n=3.0, confidence=1.0)
        made = ContactFrame(skin="palm", contacts=[contact])
    made.valid, made.stamps = True, dict.fromkeys(STAMPS[: n + 2], 1)
    return made


def sizes() -> list[int]:
    """Bytes of each hop's message."""
    return [len(pack(hop(n))) for n in range(len(HOPS))]
