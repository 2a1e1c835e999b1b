"""A part of a scan is judged by its own estimate: what preprocessing refused of it shows no contact as valid."""

from __future__ import annotations

import pytest

from protocol.frames import ContactFrame, ImageFrame, PartFrame, pack, unpack
from services.publisher import Publishing
from tests.services.gap_host import GapHost, Press

TOUCH = Press(0.02, -0.01, 4.0, 20.0)
NEXT_NS = 4_360_000  # a part of a scan


@pytest.fixture(scope="module")
def seen() -> tuple[Publishing, ImageFrame, PartFrame]:
    """An image frame and a part frame of a touch that is held, and the publisher that has seen those before."""
    host = GapHost("rolling", 3, [TOUCH])
    images, parts = list[ImageFrame](), list[PartFrame]()
    process = host.pipeline.publishing.process

    def kept(frame, wanted):
        if isinstance(frame, ImageFrame):
            images.append(frame)
        elif isinstance(frame, PartFrame):
            parts.append(frame)
        return process(frame, wanted)

    host.pipeline.publishing.process = kept
    host.until(4.5)
    host.close()
    touched = [frame for frame in images if frame.touched and frame.estimates and frame.valid]
    return host.pipeline.publishing, touched[-1], [part for part in parts if part.estimates][-1]


def said_of(seen, *, image: tuple[bool, list[str]], part: tuple[bool, list[str]]) -> tuple[ContactFrame, ContactFrame]:
    """What an image and the part after it give, each with this `valid` and these reasons."""
    stage, last, of_part = seen
    found = []
    for k, (frame, (valid, reasons)) in enumerate(((last, image), (of_part, part))):
        copy = unpack(pack(frame))
        copy.valid, copy.reasons, copy.scan = valid, list(reasons), last.scan + 10 + k
        copy.stamps["sample"] = last.stamps["sample"] + NEXT_NS * (10 + k)
        (contact,) = stage.process(copy, frozenset({"contact"}))
        found.append(contact)
    return found[0], found[1]


REFUSED = ("stale_baseline", "saturated", "gain", "electrode_drift", "electrode_open", "frozen", "clock", "non_finite")


@pytest.mark.parametrize("reason", [*REFUSED, "out_of_distribution"])
def test_a_part_that_was_refused_is_not_valid_and_says_why(seen, reason):
    _, part = said_of(seen, image=(True, []), part=(False, [reason]))
    assert not part.valid and reason in part.reasons
    contact, part = said_of(seen, image=(False, [reason]), part=(False, [reason]))
    assert not contact.valid and reason in contact.reasons
    assert not part.valid and reason in part.reasons


def test_a_part_stands_by_itself(seen):
    """Of an image that was refused or late a part may be valid still: it has an estimate of its own."""
    for valid, reasons in ((True, []), (False, ["late"]), (False, ["saturated"]), (True, [])):
        _, part = said_of(seen, image=(valid, reasons), part=(True, []))
        assert part.valid and not set(reasons) & set(part.reasons)
        (contact,) = [c for c in part.contacts if c.state != "end"]
        assert contact.position[:2] == pytest.approx([TOUCH.x, TOUCH.y], abs=2e-3)
