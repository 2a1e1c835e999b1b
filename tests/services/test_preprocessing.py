"""Preprocessing: touch decision, hold, what is left out of a scan, what the baseline follows, and what info says."""

import dataclasses
import hashlib

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_RTIA, RawFrame, pack, unpack
from services.describe import EVERY_S, MOVED
from services.estimation.faults import checks
from services.estimation.first.baseline import Baseline
from services.preprocessing import Preprocessing
from services.runtime.config import Skin
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
    assert all(str(learnt[part]) == str(after[part]) for part in ("drift", "noise", "log_z0", "touches"))
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
def test_measurements_that_the_board_doubts_are_left_out_by_name_and_more_than_half_refuse_the_frame(
    tared: Fed, board: Board, bit: int, reason: str
) -> None:
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
    assert checks.sentence(bundle) == "" and not checks.skipped(bundle)
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
