"""Preprocessing: touch decision, hold, what is left out, learnt and told; the first baseline, tares, the judge."""

import dataclasses
import hashlib

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.forward import shared
from models.measurement.tables import skin_tables, tables_of
from models.mismatch import MismatchedSheet, named
from models.shapes import Shape
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_RTIA, JudgementsFrame, RawFrame, pack, unpack
from services.describe import EVERY_S, MOVED
from services.estimation.faults import advice
from services.estimation.initialisation.baseline import Baseline, NoBaseline, agreement, take
from services.estimation.initialisation.start import JudgedStart, StartSays, judge_start
from services.estimation.initialisation.tare import without_drift
from services.preprocessing import Preprocessing
from services.runtime.config import Skin, TareConfig
from services.runtime.stage import Refused
from tests.services.conftest import FRAME_NS, Board, Fed


def received(frame: RawFrame) -> RawFrame:
    """As a reader of the topic has it."""
    back = unpack(pack(frame))
    assert isinstance(back, RawFrame)
    return back


def not_believed(frame: RawFrame, reason: str) -> RawFrame:
    """As acquisition sends it on."""
    frame.valid, frame.reasons = False, [reason]
    return received(frame)


def left_out(sigma: np.ndarray) -> list[int]:
    return np.flatnonzero(~np.isfinite(sigma)).tolist()


def test_a_calibration_may_be_ready_before_the_first_scan_of_a_kept_baseline(tared: Fed) -> None:
    preprocessing = tared.stage
    preprocessing.set_baseline(preprocessing.baseline, age_s=600.0)
    preprocessing.estimator.use(skin_tables(preprocessing.bundle))
    assert all(out.valid and not out.touched for out in tared.feel(scans=5))


def test_no_false_touch_and_the_lightest_touch_is_seen(tared: Fed, board: Board) -> None:
    assert not any(out.touched for out in tared.feel(scans=300))
    light = board.disc(0.0, 0.0, 0.1, 0.1)  # 1 N of the indenter 10 mm across at the centre
    assert all(out.touched for out in tared.feel(light, 5))
    assert not tared.feel(scans=2)[-1].touched


def test_an_unchanged_touch_is_held_and_averaged(tared: Fed, board: Board) -> None:
    """What inference forms of a frame is not carried: nine images are ten times as much."""
    assert tared.feel()[0].averaged == 0
    touch = board.disc(0.2, 0.1, 0.2, 0.3)
    outs = tared.feel(touch, 40)
    assert len(pack(outs[0])) < 8192
    assert [i + 1 for i, o in enumerate(outs) if not o.held] == [1, 2, 4, 8, 16, 32]
    assert [o.averaged for o in outs if o.averaged] == [1, 2, 4, 8, 16, 16]
    assert all((o.averaged > 0) == (not o.held) for o in outs)
    assert [o.reconstructed for o in outs[7:10]] == [outs[7].scan] * 3
    expected = touch * np.asarray(board.m.z0) / tared.stage.pre.normaliser(np.asarray(board.m.z0, float))
    error = [np.sqrt(np.mean((outs[i - 1].difference - expected) ** 2)) for i in (1, 16)]
    assert error[1] < 0.6 * error[0]  # 16 frames averaged; the tare's own noise remains


def test_creep_is_seen(tared: Fed, board: Board) -> None:
    """Each step is far below the noise, their sum is not."""
    start, end = (board.disc(0.2, 0.1, 0.2, drop) for drop in (0.30, 0.33))
    tared.feel(start)
    last = [out for n in range(100) for out in tared.feel(start + (end - start) * n / 100) if not out.held][-1]
    assert (end - start) @ (last.difference - start) / ((end - start) @ (end - start)) > 0.7


def test_a_held_touch_is_not_averaged_over_frozen_frames(tared: Fed, board: Board) -> None:
    """A mean of the same scan again and again is no surer."""
    touch = board.disc(0.2, 0.1, 0.3, 0.3)
    alone, *_ = tared.feel(touch, 3)
    again = board.frame(touch)
    frozen = [tared.run(not_believed(dataclasses.replace(again), "frozen")) for _ in range(40)]
    assert all(not out.held and out.averaged == 1 and np.allclose(out.sigma, alone.sigma, rtol=0.3) for out in frozen)
    (out,) = tared.feel(touch)
    assert out.valid and out.touched and out.averaged <= 2


# what is learnt


@pytest.mark.parametrize("reason", ["frozen", "clock"])
def test_nothing_is_learnt_from_frames_that_acquisition_does_not_believe(tared: Fed, board: Board, reason: str) -> None:
    """What comes after them is judged as if they had not been; those that it believes are followed."""
    learnt = tared.stage.estimator.state()["tared"]
    for k in range(100):
        out = tared.run(not_believed(board.frame(1e-4 * min(1.0, k / 50)), reason))
        assert not out.valid and reason in out.reasons
    after = tared.stage.estimator.state()["tared"]
    assert all(str(learnt[part]) == str(after[part]) for part in ("drift", "noise", "baseline", "touches"))
    even = [out.difference.mean() for out in tared.feel(1e-4, 200)]
    assert abs(np.mean(even[-20:])) < 0.2e-4 and np.mean(even[:2]) > 0.5e-4


# what is left out of a scan


@pytest.mark.parametrize(("valid", "reasons"), [(True, []), (False, []), (True, ["gap", "clock"]), (False, ["clock"])])
def test_failed_measurements_do_not_change_what_the_producer_says(tared, board, valid, reasons) -> None:
    frame = board.frame()
    frame.z[7], frame.valid, frame.reasons = np.nan, valid, reasons
    heard = received(frame)
    assert not heard.valid and heard.reasons == [*reasons, "non_finite"]
    out = tared.run(heard)
    assert (out.valid, out.reasons, left_out(out.sigma)) == (valid, reasons, [7])


@pytest.mark.parametrize(
    ("bit", "reason"), [(STATUS_CLIPPED, "saturated"), (STATUS_RTIA, "saturated"), (STATUS_FIFO, "fifo")]
)
def test_measurements_that_the_board_doubts_are_left_out_and_more_than_half_refuse_it(tared, board, bit, reason):
    frame = board.frame()
    frame.status[[7, 30]] = bit
    frame.z[30] *= 1.5  # a number, but another measurement's
    out = tared.run(frame)
    assert out.valid and not out.touched and out.reasons == [reason] and left_out(out.sigma) == [7, 30]
    for since in (0, 54):
        frame = board.frame()
        frame.status[since:] = bit
        out = tared.run(frame)
        assert not out.valid and reason in out.reasons


def test_a_frame_that_lacks_a_run_of_measurements_knows_where_it_sees_less(tared: Fed, board: Board) -> None:
    """Touches are what they are within their sigma, which grows by what is missing: pairs of the last electrodes."""
    sigmas, metres = [], tared.stage.bundle.metres_per_unit
    for missing in (0, 12, 33):
        sigmas.append(0.0)
        for x, y in ((0.0, 0.0), (-0.6, 0.5), (-0.2, 0.7), (0.5, -0.3)):
            for _ in range(3):
                frame = board.frame(board.disc(x, y, 0.2, 0.3))
                frame.status[len(frame.status) - missing :] = STATUS_FIFO
                out = tared.run(frame)
            assert out.valid and set(out.reasons) <= {"fifo"}
            (touch,) = out.estimates
            off_m = np.hypot(touch.position[0] - metres * x, touch.position[1] - metres * y)
            assert off_m < 4 * touch.sigma[0] + 3e-4
            sigmas[-1] += touch.sigma[0]
            tared.feel(scans=6)
    assert sigmas[0] < sigmas[1] < sigmas[2]


def test_frames_of_another_skin_are_refused_and_short_ones_disturb_nothing(tared: Fed, board: Board) -> None:
    before, frame = tared.stage.state(), board.frame()
    frame.z, frame.status, frame.kind = frame.z[:12], np.zeros(12, np.uint8), "sentinel"  # of an old recording
    out = tared.run(frame)
    assert not out.valid and out.reasons == ["coarse"] and not out.touched and np.isinf(out.sigma).all()
    assert str(tared.stage.state()) == str(before) and tared.feel()[0].valid
    frame = board.frame()
    frame.z, frame.status = frame.z[:64], frame.status[:64]
    out = tared.run(frame)
    assert not out.valid and out.reasons == ["out_of_distribution"] and "64 measurements" in tared.problem


def test_what_a_bundle_cannot_tell_is_said(skin: Skin, bundle: Bundle) -> None:
    """It is no warning."""
    assert advice.unchecked(bundle) == "" and not advice.skipped(bundle)
    found = Bundle.load("disc16")
    measured = Preprocessing("disc", skin.model_copy(update={"bundle": "disc16"}), found)
    measured.set_baseline(Baseline(found.z0, 1e-4 * found.z0, 64, "b1", 0))
    assert measured.health().level == "OK"
    (message,) = measured.health().messages
    assert message.startswith("not checked with the bundle disc16")
    assert all(check in message for check in ("shorts", "exchanged wires", "contacts that change", "no touch can make"))


# info


def test_info_says_what_frames_are_compared_with(tared: Fed) -> None:
    """Its hash is that of its arrays, drift is told as it is followed, a still baseline once, a tare at once."""
    first, truth, per_scan = tared.stage.info(), np.asarray(tared.board.m.z0, float), 2e-5
    assert first is not None
    told, copies = [first], [first["baseline"].copy()]
    for n in range(1, 500):
        tared.feel(per_scan * n)
        if (info := tared.stage.info()) is not None:
            told.append(info)
            copies.append(info["baseline"].copy())
        off = np.abs(truth * (1 + per_scan * n) / told[-1]["baseline"] - 1)
        assert np.median(off) < 1.5 * per_scan * EVERY_S * 1e9 / FRAME_NS + MOVED
    seconds = 500 * FRAME_NS * 1e-9
    assert seconds / EVERY_S / 2 <= len(told) <= 1 + seconds / EVERY_S
    for info, copy in zip(told, copies, strict=True):
        assert np.array_equal(info["baseline"], copy), "nothing that was told changes"
        expected = hashlib.sha256(info["baseline"].tobytes() + info["baseline_sigma"].tobytes()).hexdigest()
        assert info["baseline_hash"] == expected
    revisions = [info["baseline_revision"] for info in told]
    assert revisions == sorted(set(revisions)) and len({info["baseline_hash"] for info in told}) == len(told)
    assert len({info["tare_sample_ns"] for info in told}) == 1
    tared.feel(per_scan * 500, 64)
    tared.tare()
    again = tared.stage.info()
    assert again is not None and again["baseline_hash"] != told[-1]["baseline_hash"]
    assert again["baseline_revision"] > revisions[-1] and tared.stage.info() is None
    assert not any(tared.feel(per_scan * 500) and tared.stage.info() for _ in range(150))


Array = NDArray[np.float64]
NOISE, SCANS = 1e-4, 64  # 80 dB


def hand(board: Board) -> Array:
    return np.asarray(3 * board.disc(0.5, -0.3, 0.3, 0.5))


def refusal(fed: Fed) -> str:
    with pytest.raises(Refused) as why:
        fed.tare()
    return str(why.value)


def too_old(fed: Fed) -> Fed:
    """As after a day: what was its baseline is only held against the first scans."""
    saved = fed.stage.saved()
    assert saved is not None
    fed.stage.reset()
    with pytest.raises(Refused, match="held against it"):
        fed.stage.restore(saved, 1e5)
    return fed


def test_nothing_is_valid_before_the_baseline_nor_with_a_touch_in_its_scans(fed: Fed, board: Board) -> None:
    """Nor with presses that come and go: each quarter of the scans holds some."""
    come_and_go = board.disc(0.05, 0.0, 0.2, 0.3)
    found = [fed.feel(come_and_go if k % 27 < 18 else 0.0)[0] for k in range(120)]
    assert not any(each.valid for each in found) and "disagree" in fed.problem
    assert all(each.reasons == ["stale_baseline"] for each in found[:60])
    fed.feel(scans=41)
    assert not fed.feel(board.disc(0.3, 0.0, 0.2, 0.3), 31)[-1].valid and "disagree" in fed.problem
    found = fed.feel(scans=72)
    assert found[-1].valid and not found[-1].touched


def test_a_touch_at_the_start_is_named_and_ends_without_a_command(fed: Fed, board: Board) -> None:
    """Touched all the time: the scans agree, so the bundle's prediction must tell."""
    found = fed.feel(hand(board), 80)[-1]
    assert not found.valid and found.reasons == ["touched_at_start"] and "skin tare" in fed.problem
    _, said = fed.stage.everything(board.frame(hand(board)), frozenset({"delta", "judgements"}))
    assert isinstance(said, JudgementsFrame)
    row = said.names.index("start")
    assert said.verdicts[row] == "refuse" and said.ratios[row] > 1
    found = fed.feel(scans=96)[-1]
    assert found.valid and not found.touched and fed.stage.health().level == "OK"


def test_a_tare_under_a_touch_that_the_start_found_needs_force_and_ends_by_another(skin, bundle, board) -> None:
    """Who forces it is believed. What comes then is refused after two scans that may be a touch that changes."""
    fed = Fed(skin.model_copy(update={"tare": TareConfig(frames=12, calibrate=False)}), bundle, board)
    fed.feel(hand(board), 20)
    assert "free it" in refusal(fed) and "--force" in refusal(fed)
    assert fed.feel(hand(board))[0].reasons == ["touched_at_start"]
    fed.tare(force=True)
    assert fed.feel(hand(board))[0].valid
    outs = fed.feel(scans=14)  # no touch lowers an impedance
    assert all(not out.valid and "out_of_distribution" in out.reasons for out in outs[2:])
    assert not any(out.estimates for out in outs) and all("changing" in out.reasons for out in outs[:2])
    fed.feel(3 * board.disc(-0.4, 0.3, 0.3, 0.5), 14)  # such a baseline has no word against a tare, the bundle has
    assert "free it" in refusal(fed)
    fed.feel(scans=14)
    fed.tare()
    (out,) = fed.feel()
    assert out.valid and not out.touched


def test_a_skin_unlike_its_bundle_is_not_valid_until_one_tare(fed: Fed) -> None:
    """Every |Z| off in its own way. The tare's word is kept, and is enough for the next start."""
    odd = 0.01 * np.random.default_rng(1).standard_normal(120)
    out = fed.feel(odd, 80)[-1]
    assert not out.valid and out.reasons == ["stale_baseline"]
    assert any("skin tare" in message for message in fed.stage.health().messages)
    fed.tare()
    assert fed.feel(odd)[0].valid
    out = too_old(fed).feel(odd, 80)[-1]
    assert out.valid and not out.touched


def test_a_touch_at_the_start_is_a_contact_where_an_old_baseline_is_trusted(fed: Fed, board: Board) -> None:
    outs = too_old(fed.tared()).feel(board.disc(0.5, -0.3, 0.2, 0.3), 80)
    assert not any(out.valid for out in outs[:60]) and outs[-1].valid and outs[-1].touched
    assert not fed.feel(scans=10)[-1].touched


def test_a_tare_waits_for_scans_and_for_the_touch_to_end(fed: Fed, board: Board) -> None:
    fed.feel(scans=20)
    assert "only 20 of 64 frames came so far: wait" in refusal(fed)
    fed.feel(scans=52)
    fed.feel(board.disc(0.0, 0.0, 0.2, 0.3), 10)
    assert "the skin is touched" in refusal(fed)
    fed.feel(scans=30)
    assert "of 64 untouched frames since the last touch: wait" in refusal(fed)
    fed.feel(scans=64)
    assert fed.tare()["snr_db"] == pytest.approx(80, abs=1)
    assert fed.feel()[0].valid


@pytest.mark.parametrize(
    ("snr_db", "words"), [(400.0, "identical"), (30.0, "trained for 0.56 %"), (40.0, "scatter by 1.0 %"), (50.0, "")]
)
def test_scans_that_are_the_same_or_too_noisy_are_doubted(skin, bundle, snr_db, words) -> None:
    """Not even after a tare on command are they valid: looking at the skin does not mend it."""
    fed = Fed(skin, bundle, Board(bundle, snr_db))
    found = fed.feel(scans=80)[-1]
    assert found.valid == (not words) == (not fed.problem) and not found.touched and words in fed.problem
    if snr_db < 100:
        fed.tare(force=True)
        assert fed.feel()[0].valid == (not words)


@pytest.mark.parametrize("reason", ["frozen", "clock"])
def test_frames_that_acquisition_does_not_believe_are_no_baseline(fed: Fed, board: Board, reason: str) -> None:
    for _ in range(80):
        assert "stale_baseline" in fed.run(not_believed(board.frame(), reason)).reasons
    assert fed.stage.saved() is None and "0 of 64 frames" in refusal(fed)


def test_what_failed_in_the_tare_counts_no_more_until_the_next(fed: Fed, board: Board) -> None:
    for k in range(80):
        frame = board.frame()
        frame.z[3] = np.nan if k == 40 else frame.z[3]
        found = fed.run(frame)
    assert found.valid and np.flatnonzero(~np.isfinite(found.sigma)).tolist() == [3]
    touched = fed.feel(board.disc(0.3, 0.0, 0.2, 0.3), 8)[-1]
    assert touched.touched and not np.isfinite(touched.sigma[3])
    fed.feel(scans=90)
    fed.tare()
    assert np.isfinite(fed.feel(scans=4)[-1].sigma).all()


def test_the_baseline_survives_a_crash_but_not_another_board_bundle_or_day(tared: Fed, board: Board) -> None:
    saved = tared.stage.saved()
    assert saved is not None and tared.stage.saved() is None
    again = tared.again()
    again.stage.restore(saved, 60.0)
    assert again.feel()[0].valid
    out = again.run(board.frame(board="b2"))
    assert not out.valid and "stale_baseline" in out.reasons and "board b1" in again.problem
    for what, age_s, words in (
        (saved, 1e6, "h old"),
        (saved | {"bundle": "x"}, 1.0, "another bundle"),
        ({"bundle": tared.bundle.hash}, 1.0, None),
    ):
        with pytest.raises(Refused, match=words):
            tared.again().stage.restore(what, age_s)


def test_recordings_and_their_reference_frames(tared: Fed, board: Board) -> None:
    """A recording never meets the board's baseline; of it a reference frame is one."""
    assert not tared.feel(source="replay")[0].valid and tared.stage.saved() is None
    tared.feel(source="replay", scans=72)
    shifted = 0.01 * np.cos(np.arange(120))
    frame = board.frame(shifted, source="replay")
    frame.kind = "reference"
    tared.run(frame)
    assert not tared.feel(shifted, source="replay")[0].touched
    assert tared.feel(shifted + board.disc(0.0, 0.3, 0.2, 0.3), source="replay")[0].touched


def test_noise_of_a_baseline(bundle: Bundle) -> None:
    """Identical frames tell none: without noise of its own a skin would be touched by anything."""
    z, pre, rng = np.asarray(bundle.z0, float), bundle.prereconstructor(), np.random.default_rng(0)
    same = take(np.tile(z, (64, 1)), pre, "b1")
    assert "identical" in same.doubt and same.sigma == pytest.approx(1e-3 * z)
    for relative in (1e-9, 1e-4):
        frames = z * (1 + relative * rng.standard_normal((64, len(z))))
        frames[5, 3] = np.nan
        found = take(frames, pre, "b1")
        assert not found.doubt and np.flatnonzero(~np.isfinite(found.sigma)).tolist() == [3]
        assert np.median(found.sigma / z) == pytest.approx(max(relative, 2e-6), rel=0.1)
    with pytest.raises(NoBaseline, match="scatter"):
        take(z * (1 + 0.2 * rng.standard_normal((64, 120))), pre, "")
    with pytest.raises(NoBaseline, match="measurements give values"):
        take(np.where(np.arange(120) < 70, np.nan, z * np.ones((64, 120))), pre, "")


def test_a_skin_that_warms_is_tared_and_one_that_is_pressed_slowly_is_not(bundle: Bundle) -> None:
    """Limits of agreement are so far away that noise stays below, and so near that a press is noticed."""
    field, rng = tables_of(bundle).field[:, :3], np.random.default_rng(5)
    quiet = [1e-3 * rng.standard_normal((SCANS, 120)) for _ in range(300)]
    of_field = [np.divide(*agreement(without_drift(each, field))) for each in quiet]
    of_all = [np.divide(*agreement(np.log(1 + each))) for each in quiet]
    assert 0.6 < max(of_field) < 1 and 0.6 < max(of_all) < 1
    slope, noise = np.linspace(-0.5, 0.5, SCANS)[:, None], NOISE * rng.standard_normal((SCANS, 120))
    warming = agreement(without_drift(slope * 1e-3 * field[:, 0] + noise, field))
    pressed = agreement(without_drift(slope * Board(bundle).disc(0.3, 0.0, 0.2, 0.05) + noise, field))
    assert warming.statistic < warming.limit and pressed.statistic > pressed.limit


# the start, on the stub's own mesh


def solved(*shapes: Shape, background: float = 1.0, contact: Array | float = 1.0) -> Array:
    model = shared("square16", "stub")
    conductivity = model.touched(list(shapes), background) if shapes else background
    return np.asarray(np.abs(model.solve(conductivity, model.contact_impedance * contact).impedances()))


def judged(z: Array, rng: np.random.Generator) -> JudgedStart:
    sigma = NOISE / np.sqrt(SCANS)
    mean = np.log(z) + sigma * rng.standard_normal(len(z))
    return judge_start(tables_of(Bundle.load("square16")), mean, np.full(len(z), sigma**2), np.ones(len(z), bool), None)


def any_skin(rng: np.random.Generator) -> dict[str, Array | float]:
    """Contact impedances +- 30 %, background +- 5 %."""
    return {"contact": 1 + 0.3 * rng.uniform(-1, 1, 16), "background": 1 + 0.05 * rng.uniform(-1, 1)}


@pytest.mark.many
@pytest.mark.parametrize("touches", [
    (),
    (Shape("circle", 0.0, 0.0, 0.1, 0.1),),
    (Shape("circle", 0.4, -0.2, 0.2, 0.1),),
    (Shape("circle", -0.6, 0.6, 0.2, 0.5),),
    (Shape("circle", 0.85, 0.1, 0.1, 0.3),),
    (Shape("L", 0.1, 0.5, 0.4, 0.5, 0.7),),
    (Shape("circle", -0.4, -0.4, 0.2, 0.4), Shape("circle", 0.5, 0.5, 0.2, 0.3)),
])  # fmt: skip
def test_a_touch_at_the_start_is_told_on_any_skin(touches: tuple[Shape, ...]) -> None:
    for seed in range(3):
        rng = np.random.default_rng([8, seed])
        found = judged(1.7 * solved(*touches, **any_skin(rng)), rng)  # its gain is unknown
        assert found.says is (StartSays.TOUCHED if touches else StartSays.UNTOUCHED)
        assert not touches or found.sure or touches[0].kind == "L"
        assert not touches or (found.fit is not None and len(found.fit) == len(touches))
        for touch in touches if touches and touches[0].kind == "circle" else ():
            assert np.hypot(*(found.fit.states[:, :2] - [touch.x, touch.y]).T).min() < 0.1  # type: ignore[union-attr]


@pytest.mark.many
@pytest.mark.parametrize("name", ["field10", "anisotropy5", "contacts"])
def test_a_skin_that_is_not_as_in_its_file_is_never_said_to_be_untouched(name: str) -> None:
    """Bare or under a hand; nor is one that is bare surely touched, so that its first tare needs no force."""
    sheet, rng = MismatchedSheet("square16", named(name).seeded(1), "stub"), np.random.default_rng(1)
    bare = judged(np.abs(sheet.solve().impedances()), rng)
    touched = judged(np.abs(sheet.solve([Shape("circle", 0.3, -0.2, 0.1, 0.3)]).impedances()), rng)
    assert bare.says is not StartSays.UNTOUCHED and not bare.sure and touched.says is not StartSays.UNTOUCHED
