"""A part of a scan is worth no more than the image on which it stands."""

from __future__ import annotations

import pytest

from protocol.frames import PartFrame, pack, unpack
from tests.services.gap_host import GapHost, Press

TOUCH = Press(0.02, -0.01, 4.0, 20.0)


@pytest.fixture(scope="module")
def seen():
    """Image frames of a touch that is held, in parts, and the publisher that has seen those before."""
    host = GapHost("rolling", 3, [TOUCH])
    kept = []
    process = host.pipeline.inference.process
    host.pipeline.inference.process = lambda *args: kept.extend(made := process(*args)) or made
    host.until(4.5)
    host.close()
    return host.pipeline.publishing, [frame for frame in kept if frame.touched and frame.image.size][-1]


def said_of(seen, *, valid: bool, reasons: list[str]):
    """What a part frame gives after an image with these reasons."""
    stage, last = seen
    image = unpack(pack(last))
    image.valid, image.reasons = valid, list(reasons)
    image.after = stage.last_image.state()["scan"]
    image.scan = image.reconstructed = image.after + 10
    image.stamps["sample"] = last.stamps["sample"] + 4_360_000 * (image.scan - last.scan)
    (contact,) = stage.process(image, frozenset({"contact"}))
    part = PartFrame(skin="palm", session=image.session, scan=image.scan + 1, part=2, after=image.scan, valid=True)
    part.stamps, part.followed = {"sample": image.stamps["sample"] + 4_000_000}, list(image.followed)
    (found,) = stage.process(unpack(pack(part)), frozenset({"contact"}))
    return contact, found


REFUSED = ("stale_baseline", "saturated", "gain", "electrode_drift", "electrode_open", "frozen", "clock", "non_finite")


@pytest.mark.parametrize("reason", [*REFUSED, "out_of_distribution"])
def test_a_part_of_an_image_that_was_refused_is_not_valid_and_says_why(seen, reason):
    contact, part = said_of(seen, valid=False, reasons=[reason])
    assert not contact.valid and reason in contact.reasons
    assert not part.valid and reason in part.reasons


def test_a_part_of_a_good_image_is_valid_and_of_one_that_was_only_late_too(seen):
    for valid, reasons in ((True, []), (False, ["late"]), (True, [])):
        _, part = said_of(seen, valid=valid, reasons=reasons)
        assert part.valid and part.contacts and "late" not in part.reasons
