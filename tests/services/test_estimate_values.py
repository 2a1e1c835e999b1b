"""A scan's times and what is new in it, how sure a place is, and how judgements become `valid` and `reasons`."""

import numpy as np
import pytest

from protocol.frame_types import REASONS, VERDICTS
from protocol.frames import RawFrame
from services.estimation.touches import roughly
from services.estimation.values.estimate import TouchEstimate
from services.estimation.values.judgement import ROWS, Verdict, judge, reasons, valid
from services.estimation.values.scan import Scan
from services.preprocessing import on_the_wire

PERIOD_US = 43_700


def whole(number: int, z: float = 2.0) -> RawFrame:
    values, status = np.full(120, z, np.complex64), np.zeros(120, np.uint8)
    frame = RawFrame(skin="palm", scan=number, device_us=number * PERIOD_US, z=values, status=status)
    frame.valid, frame.stamps = True, {"sample": number * PERIOD_US * 1000 + PERIOD_US * 500}
    return frame


def part(number: int) -> RawFrame:
    """The newest values after part `number` of ten, of 4 ms each, measured one after the other."""
    frame = whole(0)
    frame.parts, frame.part, frame.scan, frame.device_us = 10, number % 10 + 1, number, number * 4_000
    place = np.roll(np.arange(10), number + 1 - 10).argsort()  # of each block: 9 is the newest
    age = (9 - place)[:, None] * 4_000 + 4_000 * (1 - (np.arange(12) + 0.5) / 12)
    frame.age_us, frame.new = age.ravel().astype(np.float32), np.repeat(place == 9, 12).astype(np.uint8)
    frame.stamps = {"sample": number * 4_000_000 + 2_000_000}
    return frame


def test_a_whole_scan_is_new_and_of_parts_what_the_newest_ones_brought() -> None:
    second = Scan.of(whole(2), Scan.of(whole(1)))
    assert second.complete and second.part == 0 and (np.diff(second.ages_s) < 0).all()
    assert second.duration_s == pytest.approx(PERIOD_US * 1e-6, rel=1e-3)
    assert second.times_s.mean() == pytest.approx(0.0, abs=1e-5)  # `sample` is its middle
    before = Scan.of(part(20))
    scan = Scan.of(part(21), before)
    assert scan.new.sum() == 12 and not scan.complete
    assert scan.ages_s[scan.new].max() < scan.ages_s[~scan.new].min()
    assert scan.times_s[scan.new].mean() == pytest.approx(0.0, abs=1e-5)  # `sample` is the newest part's middle
    assert Scan.of(part(23), before).new.sum() == 36, "what a skipped message brought is new too"
    assert Scan.of(part(30), before).complete
    assert Scan.of(part(3), Scan.of(part(2000))).complete  # the board's clock began anew


def test_the_ellipse_of_a_place_points_as_its_covariance_says_and_one_not_explained_is_rough_in_x_and_y() -> None:
    turn = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    covariance = np.diag([0.0, 0.0, 0.04, 0.01])
    covariance[:2, :2] = turn @ np.diag([0.1**2, 0.02**2]) @ turn.T
    touch = TouchEstimate(1, True, 1.0, 0.1, -0.2, 0.0, 0.0, -2.3, 0.3, covariance, 9.0, 0.1, 0.01, 0.1, 0.01, 0.0)
    *axes, angle = on_the_wire(touch, 0.05).sigma
    assert [*axes, angle % np.pi] == pytest.approx([0.005, 0.001, 0.6], rel=0.05)
    more = roughly(touch, 0.045).covariance - covariance
    assert 0 < more[0, 0] == pytest.approx(more[1, 1]) and np.count_nonzero(more) == 2


def test_a_frame_is_valid_unless_a_judgement_refuses_and_says_its_reasons_in_order() -> None:
    quiet = [judge("explained", 1.0, 1.6), judge("touch", 12.0, 44.0)]
    assert valid(quiet) and reasons(quiet) == []
    turned = [judge("explained", 3.2, 1.6), judge("baseline", 1.0, 1.0)]
    assert [each.ratio for each in turned] == [2.0, 1.0]
    assert not valid(turned) and reasons(turned) == ["stale_baseline", "out_of_distribution"]
    assert valid([judge("explained", 3.2, 1.6, turned=Verdict.NOTE)])
    assert judge("explained", float("nan"), 1.6).verdict is Verdict.REFUSE


def test_verdicts_and_reasons_are_those_of_the_wire() -> None:
    assert tuple(each.value for each in Verdict) == VERDICTS
    assert {row.reason for row in ROWS.values() if row.reason} <= set(REASONS)
