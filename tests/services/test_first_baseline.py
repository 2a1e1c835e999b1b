"""The new estimator's first baseline and its tares: raw frames in, estimates out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.forward import shared
from models.measurement.responses.tables import tables_of
from models.mismatch import MismatchedSheet, named
from models.shapes import Shape
from protocol.frames import RawFrame
from services.estimation.estimator import Estimator
from services.estimation.first.start import EarlierBaseline, JudgedStart, StartJudge, StartSays
from services.estimation.first.tare import TareRefused, agreement
from services.estimation.values.estimate import Estimate
from services.estimation.values.judgement import Verdict
from services.estimation.values.scan import Scan
from tests.services.conftest import FRAME_NS, Board

Array = NDArray[np.float64]
NOISE, SCANS = 1e-4, 64  # 80 dB


class Fed:
    """An estimator and the board that feeds it."""

    def __init__(self, bundle: Bundle, board: Board) -> None:
        self.estimator, self.board = Estimator(tables_of(bundle)), board
        self._before: Scan | None = None

    def step(self, frame: RawFrame) -> Estimate:
        frame.device_us = frame.scan * FRAME_NS // 1000
        scan = Scan.of(frame, self._before)
        self._before = scan
        return self.estimator.step(scan)

    def feel(self, difference: NDArray[np.floating] | float = 0.0, scans: int = 72) -> list[Estimate]:
        return [self.step(self.board.frame(difference)) for _ in range(scans)]

    @property
    def problem(self) -> str:
        return self.estimator.taring.now.problem


@pytest.fixture
def fed(bundle: Bundle, board: Board) -> Fed:
    return Fed(bundle, board)


def refusal(fed: Fed, force: bool = False) -> str:
    with pytest.raises(TareRefused) as why:
        fed.estimator.tare(force)
    return str(why.value)


def test_nothing_is_valid_before_the_baseline(fed: Fed) -> None:
    found = fed.feel(scans=80)
    assert all(not each.valid and each.reasons == ("stale_baseline",) for each in found[:60])
    assert found[-1].valid and not found[-1].touched


def test_a_touch_during_the_first_scans_is_no_baseline(fed: Fed, board: Board) -> None:
    fed.feel(scans=41)
    assert not fed.feel(board.disc(0.3, 0.0, 0.2, 0.3), 31)[-1].valid
    assert "disagree" in fed.problem
    assert fed.feel()[-1].valid


def test_presses_that_come_and_go_are_no_baseline(fed: Fed, board: Board) -> None:
    touch = board.disc(0.05, 0.0, 0.2, 0.3)
    found = [fed.feel(touch if k % 27 < 18 else 0.0, 1)[0] for k in range(200)]
    assert not any(each.valid for each in found) and "disagree" in fed.problem


def test_a_touch_at_the_start_is_named_and_ends_without_a_command(fed: Fed, board: Board) -> None:
    found = fed.feel(3 * board.disc(0.5, -0.3, 0.3, 0.5), 80)
    assert not found[-1].valid and found[-1].reasons == ("touched_at_start",)
    said = next(each for each in found[-1].judgements if each.name == "start")
    assert said.verdict is Verdict.REFUSE
    assert said.ratio == pytest.approx(said.statistic / said.expected) and said.ratio > 1
    assert "skin tare" in fed.problem
    found = fed.feel(scans=96)
    assert found[-1].valid and not found[-1].touched and not fed.problem


def test_a_tare_under_a_touch_that_the_start_found_needs_force(fed: Fed, board: Board) -> None:
    touch = 3 * board.disc(0.5, -0.3, 0.3, 0.5)
    fed.feel(touch, 80)
    assert "free it" in refusal(fed) and "--force" in refusal(fed)
    assert fed.feel(touch, 1)[0].reasons == ("touched_at_start",)
    fed.estimator.tare(force=True)
    assert fed.feel(touch, 8)[-1].valid


def test_a_skin_unlike_its_bundle_needs_one_tare(fed: Fed) -> None:
    odd = 0.01 * np.random.default_rng(1).standard_normal(120)
    found = fed.feel(odd, 80)
    assert not found[-1].valid and found[-1].reasons == ("stale_baseline",)
    assert "skin tare" in fed.problem
    fed.estimator.tare()
    assert fed.feel(odd, 8)[-1].valid and not fed.problem


def test_a_tare_waits_for_scans_and_for_the_touch_to_end(fed: Fed, board: Board) -> None:
    fed.feel(scans=20)
    assert "only 20 of 64 frames came so far: wait" in refusal(fed)
    fed.feel(scans=52)
    fed.feel(board.disc(0.3, 0.0, 0.2, 0.3), 20)
    assert "the skin is touched" in refusal(fed)
    fed.feel(scans=30)
    assert "untouched frames since the last touch: wait" in refusal(fed)
    fed.feel(scans=64)
    fed.estimator.tare()
    assert fed.feel(scans=8)[-1].valid


def test_scans_that_are_the_same_or_too_noisy_are_doubted(bundle: Bundle) -> None:
    for snr_db, row, words in ((400.0, "identical", "identical"), (40.0, "noise_trained", "scatter by 1.0 %")):
        fed = Fed(bundle, Board(bundle, snr_db))
        found = fed.feel(scans=80)[-1]
        assert not found.valid and found.reasons[0] == "stale_baseline"
        assert row in {each.name for each in found.judgements if each.verdict is Verdict.REFUSE}
        assert words in fed.problem


def test_what_failed_in_the_tare_counts_no_more_until_the_next(fed: Fed, board: Board) -> None:
    for k in range(80):
        frame = board.frame()
        if k == 40:
            frame.z[3] = np.nan
        found = fed.step(frame)
    assert found.valid and np.flatnonzero(~found.live).tolist() == [3]
    touched = fed.feel(board.disc(0.3, 0.0, 0.2, 0.3), 8)[-1]
    assert touched.touched and not touched.live[3]
    fed.feel(scans=90)
    fed.estimator.tare()
    assert fed.feel(scans=4)[-1].live.all()


def test_a_skin_that_warms_is_tared_and_one_that_is_pressed_slowly_is_not(bundle: Bundle) -> None:
    field, rng = tables_of(bundle).field[:, :3], np.random.default_rng(5)
    slope = np.linspace(-0.5, 0.5, SCANS)[:, None]
    quiet = [agreement(1e-3 * rng.standard_normal((SCANS, 120)), field) for _ in range(300)]
    ratios = [found.statistic / found.limit for found in quiet]
    assert 0.6 < max(ratios) < 1
    warming = agreement(slope * 1e-3 * field[:, 0] + NOISE * rng.standard_normal((SCANS, 120)), field)
    assert warming.statistic < warming.limit
    press = Board(bundle).disc(0.3, 0.0, 0.2, 0.05)
    pressed = agreement(slope * press + NOISE * rng.standard_normal((SCANS, 120)), field)
    assert pressed.statistic > pressed.limit


# the start, on the stub's own mesh

HANDS = [(0.1, 0.1), (0.3, 0.1), (0.5, 0.1), (0.1, 0.2), (0.3, 0.2), (0.5, 0.2), (0.05, 0.2)]  # drop, radius


@pytest.fixture(scope="module")
def judge() -> StartJudge:
    return StartJudge(tables_of(Bundle.load("square16")))


@pytest.fixture(scope="module")
def solved() -> Callable[..., Array]:
    model = shared("square16", "stub")

    def impedances(*shapes: Shape, background: float = 1.0, contact: Array | float = 1.0) -> Array:
        conductivity = model.touched(list(shapes), background) if shapes else background
        return np.asarray(np.abs(model.solve(conductivity, model.contact_impedance * contact).impedances()))

    return impedances


def judged(
    judge: StartJudge, z: Array, rng: np.random.Generator, earlier: EarlierBaseline | None = None
) -> JudgedStart:
    sigma = NOISE / np.sqrt(SCANS)
    mean = np.log(z) + sigma * rng.standard_normal(len(z))
    return judge(mean, np.full(len(z), sigma**2), np.ones(len(z), bool), earlier)


@pytest.mark.parametrize(("drop", "radius"), HANDS)
def test_a_hand_at_the_start_is_told(
    judge: StartJudge, solved: Callable[..., Array], drop: float, radius: float
) -> None:
    """Contact impedances +- 30 %, background +- 5 %, gain unknown."""
    rng = np.random.default_rng([round(100 * drop), round(100 * radius)])
    for x, y in ((0.0, 0.0), (-0.6, 0.6), (0.4, -0.2)):
        contact, background = 1 + 0.3 * rng.uniform(-1, 1, 16), 1 + 0.05 * rng.uniform(-1, 1)
        z = solved(Shape("circle", x, y, radius, drop), background=background, contact=contact)
        found = judged(judge, 1.7 * z, rng)
        assert found.says is StartSays.TOUCHED and found.sure
        assert found.fit is not None and np.hypot(*(found.fit.states[0, :2] - [x, y])) < 0.1


def test_an_untouched_skin_of_any_contacts_is_untouched(judge: StartJudge, solved: Callable[..., Array]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(6):
        contact, background = 1 + 0.3 * rng.uniform(-1, 1, 16), 1 + 0.05 * rng.uniform(-1, 1)
        assert judged(judge, solved(background=background, contact=contact), rng).says is StartSays.UNTOUCHED


@pytest.mark.parametrize(
    "touches",
    [
        (Shape("circle", 0.85, 0.1, 0.1, 0.3),),
        (Shape("L", 0.1, 0.5, 0.4, 0.5, 0.7),),
        (Shape("circle", -0.4, -0.4, 0.2, 0.4), Shape("circle", 0.5, 0.5, 0.2, 0.3)),
    ],
    ids=lambda touches: "-".join(shape.kind for shape in touches),
)
def test_a_touch_surely_explains_a_start_under_it(
    judge: StartJudge, solved: Callable[..., Array], touches: tuple[Shape, ...]
) -> None:
    rng = np.random.default_rng(8)
    found = judged(judge, solved(*touches, contact=np.exp(0.3 * rng.standard_normal(16))), rng)
    assert found.says is StartSays.TOUCHED and found.sure
    assert found.fit is not None and len(found.fit) == len(touches)


MISMATCHED = ["mild", "field5", "field10", "shift1", "shift3", "anisotropy5", "anisotropy15", "contacts"]


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.release)])
def test_a_skin_that_is_not_as_in_its_file_is_never_said_to_be_untouched(judge: StartJudge, seed: int) -> None:
    """Bare or under a hand; nor is one that is bare surely touched, so that its first tare needs no force."""
    says = Counter[str]()
    for name in MISMATCHED:
        sheet, rng = MismatchedSheet("square16", named(name).seeded(seed), "stub"), np.random.default_rng(seed)
        bare = judged(judge, np.abs(sheet.solve().impedances()), rng)
        hand = judged(judge, np.abs(sheet.solve([Shape("circle", 0.3, -0.2, 0.1, 0.3)]).impedances()), rng)
        assert bare.says is not StartSays.UNTOUCHED and not bare.sure, name
        assert hand.says is not StartSays.UNTOUCHED, name
        says[bare.says.value] += 1
    assert says["unknown"] >= 4  # the sheet's own unevenness is no touch


def test_an_earlier_baseline_tells_where_the_bundle_cannot(judge: StartJudge, solved: Callable[..., Array]) -> None:
    rng = np.random.default_rng(5)
    odd = 1 + 0.01 * rng.standard_normal(120)
    assert judged(judge, solved() * odd, rng).says is StartSays.UNKNOWN
    tables = tables_of(Bundle.load("square16"))
    field = tables.field[:, :3]  # even, along x and y
    drifted = 0.01**2 * field @ field.T + 0.2**2 * tables.contact @ tables.contact.T
    earlier = EarlierBaseline(np.log(solved() * odd), drifted)
    free = judged(judge, solved(background=1.02, contact=1.05) * odd, rng, earlier)
    assert free.says is StartSays.UNTOUCHED
    pressed = solved(Shape("circle", 0.2, 0.1, 0.1, 0.1), background=1.02, contact=1.05) * odd
    assert judged(judge, pressed, rng, earlier).says is StartSays.TOUCHED


def test_a_measured_bundle_cannot_tell() -> None:
    bundle = Bundle.load("disc16")
    z = np.asarray(bundle.z0, float)
    found = StartJudge(tables_of(bundle))(np.log(z), np.full(len(z), 1e-10), np.ones(len(z), bool))
    assert found.says is StartSays.UNKNOWN
    assert found.judgements[0].verdict is Verdict.CANNOT and found.judgements[0].ratio == 0
