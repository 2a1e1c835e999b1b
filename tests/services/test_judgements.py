"""How judgements become `valid` and `reasons`, and a scan's times; the forward residual."""

from dataclasses import replace

import numpy as np
import pytest

from models.shapes import Shape, drop_image
from protocol.frame_types import REASONS, VERDICTS
from protocol.frames import STATUS_OPEN, DeltaFrame, JudgementsFrame, PartFrame, RawFrame, pack, unpack
from services.estimation.images import Residual
from services.estimation.track import coasted
from services.estimation.values.estimate import ROWS, TouchEstimate, Verdict, judge, reasons, valid
from services.estimation.values.scan import Scan
from services.inference import Inference
from services.judged import judged
from services.preprocessing import Preprocessing, on_the_wire
from services.publisher import Publishing
from simulation.host import SimulatedHost
from tests.services.stub_skin import StubSkin, present, sheet, transfer

ASKED = frozenset({"delta", "part", "judgements"})
UNASKED = ASKED - {"judgements"}


def run(stage, frame):
    """What is made of a whole scan, the judgements as a subscriber has them."""
    delta, made = stage.everything(frame, ASKED)
    said = unpack(pack(made))
    assert isinstance(delta, DeltaFrame) and isinstance(said, JudgementsFrame)
    header = ("skin", "scan", "part", "stamps", "source", "valid", "reasons", "valid_for_s")
    assert [getattr(said, key) for key in header] == [getattr(delta, key) for key in header]
    return delta, said


def verdicts(said):
    return dict(zip(said.names, said.verdicts, strict=True))


def without(bundle, board, *electrodes):
    """A frame of a skin on which these electrodes have come off."""
    frame = board.frame()
    uses = np.isin(bundle.pattern, electrodes).any(axis=1)
    frame.z[uses], frame.status[uses] = np.nan, STATUS_OPEN
    return frame


def test_nothing_is_wrong_with_an_untouched_or_a_pressed_skin(fed, board):
    assert verdicts(run(fed.stage, board.frame())[1])["baseline"] == "refuse"
    _, said = run(fed.tared().stage, board.frame())
    assert said.valid and not said.reasons
    assert {"believed", "touch", "explained"} <= set(said.names) <= set(ROWS)
    assert set(said.verdicts) <= {"pass", "cannot", "not asked"}
    assert all(ratio < 1 for ratio in said.ratios)
    for _ in range(4):
        delta, said = run(fed.stage, board.frame(board.disc(0.3, 0.0, 0.2, 0.3)))
    assert delta.touched and said.valid and verdicts(said)["touch"] == "note", "a press refuses nothing"


def test_an_electrode_that_comes_off_turns_open_and_the_contact_frame_says_so(tared, skin, bundle, board):
    inference, publishing = Inference("palm", skin, bundle), Publishing("palm", skin, bundle)
    delta, said = run(tared.stage, without(bundle, board, 5))
    (image,) = inference.process(delta, frozenset({"image"}))
    (contact,) = publishing.process(image, frozenset({"contact"}))
    assert verdicts(said)["open"] == "note" and said.where[said.names.index("open")] == 5
    assert said.valid and contact.valid
    assert said.reasons == ["electrode_open"] and "electrode_open" in contact.reasons
    _, said = run(tared.stage, without(bundle, board, 1, 6, 11))
    assert not said.valid and verdicts(said)["too_many"] == "refuse"


def test_nothing_is_made_that_nobody_asked_for_or_that_cannot_be_judged(fed, bundle, board):
    for frame in (*(board.frame() for _ in range(72)), without(bundle, board, 5)):
        (made,) = fed.stage.everything(frame, UNASKED)
        assert isinstance(made, DeltaFrame)
    frame = board.frame()
    frame.z, frame.status = frame.z[:-1], frame.status[:-1]
    (made,) = fed.stage.everything(frame, ASKED)
    assert isinstance(made, DeltaFrame) and made.reasons == ["out_of_distribution"]


def test_every_part_of_a_scan_is_explained_also_where_nothing_touches(skin, bundle):
    """And what other topics say is the same whether somebody asks or not."""
    host = SimulatedHost("rolling", 80.0, 3)
    raws = [raw for _ in iter(lambda: host.now < 5.0, False) for raw, _ in host.acquired()]
    host.close()
    asked, unasked = (Preprocessing("palm", skin, bundle) for _ in range(2))
    whole = parts = 0
    for raw in raws:
        *made, said = asked.everything(raw, ASKED)
        others = unasked.everything(raw, UNASKED)
        assert isinstance(said, JudgementsFrame) and (said.scan, said.part) == (raw.scan, raw.part)
        assert [pack(each) for each in made] == [pack(each) for each in others]
        whole, parts = whole + any(isinstance(each, DeltaFrame) for each in made), parts + (not made)
        assert not any(isinstance(each, PartFrame) for each in made)
    assert whole > 50 and parts > 5 * whole


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_makes_no_frame_invalid(number):
    back = unpack(pack(judged(DeltaFrame(skin="palm", valid=True), [judge("explained", number, 1.0)])))
    assert isinstance(back, JudgementsFrame) and back.valid and not back.reasons
    assert np.isfinite(back.ratios).all() and (back.ratios[0] >= 1) == (back.verdicts == ["refuse"])


TOUCHES = [
    (Shape("circle", 0.2, -0.3, 0.2, 0.15),),
    (Shape("circle", -0.4, 0.1, 0.3, 0.85),),
    (Shape("square", -0.6, 0.6, 0.3, 0.5),),
    (Shape("circle", 0.5, 0.5, 0.2, 0.5), Shape("L", -0.5, 0.4, 0.3, 0.4), Shape("triangle", 0.0, -0.6, 0.25, 0.3)),
]


def clean(bundle, shapes):
    """(K,) |Z| of the stub's sheet."""
    return np.abs(sheet().model.read(transfer(shapes), bundle.pattern))


@pytest.mark.parametrize("shapes", TOUCHES)
@pytest.mark.parametrize("dead", [False, True])
def test_the_true_image_explains_another_meshs_frame(bundle, shapes, dead):
    residual = Residual(bundle, to_scale=True)
    d = (clean(bundle, shapes) / clean(bundle, ()) - 1).astype(np.float32)
    sigma = np.full(len(d), 1e-4, np.float32)
    if dead:
        sigma[(np.asarray(bundle.pattern) == 3).any(axis=1)] = np.inf
        d[~np.isfinite(sigma)] = 0
    image = drop_image(list(shapes), 96).astype(np.float32)
    right = residual(d, sigma, image)
    assert right is not None and right < 0.05
    elsewhere = residual(d, sigma, image[::-1])
    assert elsewhere is not None and elsewhere > 5 * right + 0.1
    nothing = residual(d, sigma, np.zeros_like(image))
    assert nothing == pytest.approx(1, abs=0.1)


def test_what_it_cannot_tell_is_none(bundle):
    residual, image = Residual(bundle, to_scale=True), np.zeros((96, 96), np.float32)
    d, sigma = np.zeros(120, np.float32), np.full(120, 1e-4, np.float32)
    for wrong in ((d, np.full_like(d, np.inf), image), (d[:64], sigma[:64], image), (d, sigma, image[:95])):
        assert residual(*wrong) is None
    assert residual(d, sigma, image) == 0


def test_touches_have_quality_and_random_frames_make_no_valid_contact(bundle):
    """Noise of any size, channels and electrodes exchanged, other skins, one value, clipped, falling."""
    skin = StubSkin()
    for shapes in TOUCHES:
        for contact in (result.contact for result in skin.felt(2, shapes)):
            assert contact.valid and contact.quality is not None and contact.quality > 0.8
        assert skin.rest(4).contact.quality is None
    rng, z0, seen = np.random.default_rng(1), clean(bundle, ()), 0
    place = {frozenset(row[:2]): k for k, row in enumerate(bundle.pattern.tolist())}
    for _ in range(3):
        z = clean(bundle, TOUCHES[rng.integers(len(TOUCHES))])
        d, size, order = z / z0 - 1, 10 ** rng.uniform(-3.0, -0.3), rng.permutation(16)
        electrodes = [place[frozenset(order[row[:2]].tolist())] for row in bundle.pattern]
        for frame in (
            z0 * (1 + size * rng.standard_normal(120)),
            z0 * (1 + rng.permutation(d)),
            z0 * (1 + d[electrodes]),
            z0 * np.exp(0.3 * rng.standard_normal(120)),
            np.full(120, 10 ** rng.uniform(-2, 4)),
            np.minimum(z, np.quantile(z0, rng.uniform(0, 0.6))),
            z0 * (1 - d),
        ):
            noisy = frame * (1 + 1e-4 * rng.standard_normal(120))
            result = skin.run(noisy.astype(np.complex64))
            assert not (result.contact.valid and present(result))
            seen += result.image.residual is not None and result.image.residual > 0.5
            skin.rest(4)
    assert seen > 4  # it is the residual that refuses many of them
    assert skin.rest(3).contact.valid


def test_a_published_reference_is_explained(bundle, reference):
    """EIDORS' frames with the drops that they were made of."""
    data = np.load(reference / "eidors_reference.npz")
    z = np.abs(data["impedance_pairs"])
    order = {tuple(sorted(p)): k for k, p in enumerate((data["pairs"] - 1).tolist())}
    rows = [order[tuple(sorted(row[:2]))] for row in bundle.pattern.tolist()]
    residual, sigma = Residual(bundle, to_scale=True), np.full(120, 1e-4, np.float32)
    shares = []
    for k in range(1, len(z)):
        if (data["conductivity"][k] == 1) and data["drop"][k].max() > 0.05:
            d = (z[k] / z[0] - 1)[rows].astype(np.float32)
            shares.append(residual(d, sigma, data["drop"][k].astype(np.float32)))
    assert len(shares) > 10 and max(s for s in shares if s is not None) < 0.1


PERIOD_US = 43_700


def whole(number):
    values, status = np.full(120, 2.0, np.complex64), np.zeros(120, np.uint8)
    frame = RawFrame(skin="palm", scan=number, device_us=number * PERIOD_US, z=values, status=status)
    frame.valid, frame.stamps = True, {"sample": number * PERIOD_US * 1000 + PERIOD_US * 500}
    return frame


def part(number):
    """The newest values after part `number` of ten, of 4 ms each, measured one after the other."""
    frame = whole(0)
    frame.parts, frame.part, frame.scan, frame.device_us = 10, number % 10 + 1, number, number * 4_000
    place = np.roll(np.arange(10), number + 1 - 10).argsort()  # of each block: 9 is the newest
    age = (9 - place)[:, None] * 4_000 + 4_000 * (1 - (np.arange(12) + 0.5) / 12)
    frame.age_us, frame.new = age.ravel().astype(np.float32), np.repeat(place == 9, 12).astype(np.uint8)
    frame.stamps = {"sample": number * 4_000_000 + 2_000_000}
    return frame


def times_s(scan):
    """(K,) when each value was measured, from `sample` on."""
    return (scan.at_ns - scan.sample_ns) * 1e-9 - scan.ages_s


def test_a_whole_scan_is_new_and_of_parts_what_the_newest_ones_brought():
    second = Scan.of(whole(2), Scan.of(whole(1)))
    assert second.new.all() and second.part == 0 and (np.diff(second.ages_s) < 0).all()
    assert second.duration_s == pytest.approx(PERIOD_US * 1e-6, rel=1e-3)
    assert times_s(second).mean() == pytest.approx(0.0, abs=1e-5)  # `sample` is its middle
    scan = Scan.of(part(21), before := Scan.of(part(20)))
    assert scan.new.sum() == 12 and scan.ages_s[scan.new].max() < scan.ages_s[~scan.new].min()
    assert times_s(scan)[scan.new].mean() == pytest.approx(0.0, abs=1e-5)  # `sample` is the newest part's middle
    assert Scan.of(part(23), before).new.sum() == 36, "what a skipped message brought is new too"
    assert Scan.of(part(30), before).new.all() and Scan.of(part(3), Scan.of(part(2000))).new.all()  # a clock began anew
    assert Scan.of(replace(part(21), stamps={"sample": scan.sample_ns + 10**6}), before).at_ns == scan.at_ns + 4_000
    assert Scan.of(replace(part(3), age_us=np.zeros(120, "f4"))).duration_s > 0, "a board may say that it took no time"


def test_the_ellipse_of_a_place_points_as_its_covariance_says_and_one_not_explained_is_rough_in_x_and_y():
    turn = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    covariance = np.diag([0.0, 0.0, 0.04, 0.01])
    covariance[:2, :2] = turn @ np.diag([0.1**2, 0.02**2]) @ turn.T
    touch = TouchEstimate(1, True, 1.0, 0.1, -0.2, 0.0, 0.0, -2.3, 0.3, covariance, 9.0, 0.1, 0.01, 0.0)
    *axes, angle = on_the_wire(touch, 0.05).sigma
    assert [*axes, angle % np.pi] == pytest.approx([0.005, 0.001, 0.6], rel=0.05)
    more = coasted(touch, 0.045).covariance - covariance
    assert 0 < more[0, 0] == pytest.approx(more[1, 1]) and np.count_nonzero(more) == 2


def test_a_frame_is_valid_unless_a_judgement_refuses_and_says_its_reasons_in_order():
    quiet = [judge("explained", 1.0, 1.6), judge("touch", 12.0, 44.0)]
    assert valid(quiet) and reasons(quiet) == []
    turned = [judge("explained", 3.2, 1.6), judge("baseline", 1.0, 1.0)]
    assert [each.ratio for each in turned] == [2.0, 1.0]
    assert not valid(turned) and reasons(turned) == ["stale_baseline", "out_of_distribution"]
    assert valid([judge("explained", 3.2, 1.6, turned=Verdict.NOTE)])
    assert judge("explained", float("nan"), 1.6).verdict is Verdict.REFUSE


def test_verdicts_and_reasons_are_those_of_the_wire():
    assert tuple(each.value for each in Verdict) == VERDICTS
    assert {row.reason for row in ROWS.values() if row.reason} <= set(REASONS)
