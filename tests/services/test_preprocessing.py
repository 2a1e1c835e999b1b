"""Preprocessing: tare, touch decision, hold, electrodes, and what survives a crash."""

from __future__ import annotations

import dataclasses
import hashlib
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA, DeltaFrame, RawFrame, pack, unpack
from services.describe import EVERY_S, MOVED
from services.estimation.faults import checks
from services.estimation.faults.wires import WireFault, WireKind, WireMaps
from services.estimation.first.baseline import Baseline, NoBaseline, disagreement, take
from services.preprocessing import Preprocessing
from services.runtime.config import Skin
from services.runtime.stage import Refused
from tests.services.conftest import FRAME_NS, Board

WANTED = frozenset({"delta"})


@pytest.fixture
def stage(skin: Skin, bundle: Bundle) -> Preprocessing:
    return Preprocessing("palm", skin, bundle)


def run(stage: Preprocessing, frame: RawFrame) -> DeltaFrame:
    (out,) = stage.everything(frame, WANTED)
    assert isinstance(out, DeltaFrame)
    assert np.isfinite(out.difference).all()
    return out


def received(frame: RawFrame) -> RawFrame:
    """As a reader of the topic has it."""
    back = unpack(pack(frame))
    assert isinstance(back, RawFrame)
    return back


def tared(stage: Preprocessing, board: Board) -> Preprocessing:
    for _ in range(72):
        out = run(stage, board.frame())
    assert out.valid and not out.touched
    return stage


def test_frames_are_not_valid_before_the_baseline(stage: Preprocessing, board: Board) -> None:
    outs = [run(stage, board.frame()) for _ in range(80)]
    assert all(not o.valid and o.reasons == ["stale_baseline"] for o in outs[:60])
    assert outs[-1].valid


def test_a_touch_during_the_first_frames_is_no_baseline(stage: Preprocessing, board: Board) -> None:
    touch = board.disc(0.3, 0.0, 0.2, 0.3)
    for n in range(72):
        out = run(stage, board.frame(touch if n > 40 else 0.0))
    assert not out.valid
    assert "disagree" in stage.health().messages[0]
    for _ in range(72):
        out = run(stage, board.frame())
    assert out.valid


def test_a_touch_at_the_start_is_named_and_ends_without_a_command(stage: Preprocessing, board: Board) -> None:
    """Touched all the time: the frames agree, so the bundle's prediction must tell."""
    touch = 3 * board.disc(0.5, -0.3, 0.3, 0.5)
    for _ in range(80):
        out = run(stage, board.frame(touch))
    assert not out.valid and out.reasons == ["touched_at_start"]
    assert "skin tare" in stage.health().messages[0]
    outs = [run(stage, board.frame()) for _ in range(96)]
    assert outs[-1].valid and not outs[-1].touched and stage.health().level == "OK"


def test_a_tare_under_a_touch_that_the_start_found_is_refused_and_ends_by_another(
    stage: Preprocessing, board: Board
) -> None:
    """Its frames would be valid and hide the touch. Who forces it is believed, and needs no force to be rid of it.
    What comes then is refused after two scans that may be a touch that changes.
    """
    touch = 3 * board.disc(0.5, -0.3, 0.3, 0.5)
    for _ in range(80):
        run(stage, board.frame(touch))
    with pytest.raises(Refused, match="free it"):
        stage.command("tare", {})
    assert run(stage, board.frame(touch)).reasons == ["touched_at_start"]
    stage.command("tare", {"force": True})
    assert run(stage, board.frame(touch)).valid
    outs = [run(stage, board.frame()) for _ in range(80)]  # no touch lowers an impedance
    assert all(not out.valid and "out_of_distribution" in out.reasons for out in outs[2:])
    assert not any(out.estimates for out in outs) and all("changing" in out.reasons for out in outs[:2])
    stage.command("tare", {})
    out = run(stage, board.frame())
    assert out.valid and not out.touched


def test_a_baseline_that_explains_nothing_does_not_have_a_touch_tared(stage: Preprocessing, board: Board) -> None:
    """Its word against a tare counts for nothing, but then the bundle's does."""
    touch = 3 * board.disc(0.5, -0.3, 0.3, 0.5)
    for _ in range(80):
        run(stage, board.frame(touch))
    stage.command("tare", {"force": True})
    for _ in range(80):
        run(stage, board.frame(3 * board.disc(-0.4, 0.3, 0.3, 0.5)))
    with pytest.raises(Refused, match="free it"):
        stage.command("tare", {})


def test_a_skin_unlike_its_bundle_is_not_valid_until_one_tare(stage: Preprocessing, board: Board) -> None:
    """Every |Z| off in its own way. The tare's word is kept, and is enough for the next start."""
    odd = 0.01 * np.random.default_rng(1).standard_normal(len(board.m.z0))
    for _ in range(80):
        out = run(stage, board.frame(odd))
    assert not out.valid and out.reasons == ["stale_baseline"]
    assert any("skin tare" in message for message in stage.health().messages)
    stage.command("tare", {})
    assert run(stage, board.frame(odd)).valid
    saved = stage.saved()
    assert saved is not None
    stage.reset()
    with pytest.raises(Refused, match="held against it"):
        stage.restore(saved, 1e5)
    outs = [run(stage, board.frame(odd)) for _ in range(80)]
    assert outs[-1].valid and not outs[-1].touched


def test_a_touch_at_the_start_is_a_contact_where_an_old_baseline_is_trusted(stage: Preprocessing, board: Board) -> None:
    for _ in range(80):
        run(stage, board.frame())
    saved = stage.saved()
    assert saved is not None
    stage.reset()
    with pytest.raises(Refused, match="held against it"):
        stage.restore(saved, 1e5)
    touch = board.disc(0.5, -0.3, 0.2, 0.3)
    outs = [run(stage, board.frame(touch)) for _ in range(80)]
    assert not any(out.valid for out in outs[:60])
    assert outs[-1].valid and outs[-1].touched
    assert not [run(stage, board.frame()) for _ in range(10)][-1].touched


def test_who_goes_on_from_a_state_knows_the_old_baseline_by_which_it_starts(
    stage: Preprocessing, board: Board, skin: Skin, bundle: Bundle
) -> None:
    saved = tared(stage, board).saved()
    assert saved is not None
    stage.reset()
    with pytest.raises(Refused, match="held against it"):
        stage.restore(saved, 1e5)
    other, touch = Preprocessing("palm", skin, bundle), board.disc(0.5, -0.3, 0.2, 0.3)
    frames = [board.frame(touch) for _ in range(80)]
    for frame in frames[:20]:
        run(stage, frame)
    other.load(deepcopy(stage.state()))
    first = run(stage, frames[20]), run(other, frames[20])
    assert first[1].after == 0 and np.array_equal(first[0].difference, first[1].difference)
    for frame in frames[21:]:
        assert pack(run(stage, frame)) == pack(run(other, frame))
    assert stage.baseline is not None and other.baseline is not None and other.baseline.restored
    assert str(stage.baseline.to_dict()) == str(other.baseline.to_dict())


def test_steps_of_the_gain_are_counted_by_who_saw_them(
    stage: Preprocessing, board: Board, skin: Skin, bundle: Bundle
) -> None:
    tared(stage, board)
    for _ in range(20):
        run(stage, board.frame(0.02))
    assert stage.health().counters["gain_steps"] == 1
    other = Preprocessing("palm", skin, bundle)
    other.load(stage.state())
    run(other, board.frame(0.02))
    assert other.health().counters.get("gain_steps", 0) == 0


def test_identical_frames_tell_no_noise(stage: Preprocessing, board: Board, bundle: Bundle) -> None:
    """Without noise of its own a skin would be touched by anything."""
    z = np.asarray(board.m.z0, dtype=float)
    baseline = take(np.tile(z, (64, 1)), bundle.prereconstructor(), "b1", 0)
    assert "identical" in baseline.doubt
    assert baseline.sigma == pytest.approx(1e-3 * z)
    stage.set_baseline(dataclasses.replace(baseline, sigma=np.zeros(len(z)), doubt=""))
    assert not any(run(stage, board.frame()).touched for _ in range(20))
    assert run(stage, board.frame(board.disc(0.3, 0.0, 0.2, 0.4))).touched


def test_frames_nearly_without_noise_are_a_tare(board: Board, bundle: Bundle) -> None:
    z = np.asarray(board.m.z0, dtype=float)
    for relative in (1e-9, 1e-6, 1e-4):
        frames = z * (1 + relative * np.random.default_rng(0).standard_normal((64, len(z))))
        baseline = take(frames, bundle.prereconstructor(), "b1", 0)
        assert not baseline.doubt
        assert np.median(baseline.sigma / z) == pytest.approx(max(relative, 2e-6), rel=0.1)


def test_presses_that_come_and_go_are_no_baseline(stage: Preprocessing, board: Board) -> None:
    """Each quarter of the frames holds some of them, so the quarters' own scatter would hide them."""
    touch = board.disc(0.05, 0.0, 0.2, 0.3)
    for n in range(200):
        out = run(stage, board.frame(touch if n % 27 < 18 else 0.0))
    assert not out.valid and "disagree" in stage.health().messages[0]


def test_a_measurement_that_failed_in_the_tare_is_left_out(board: Board, bundle: Bundle) -> None:
    frames = np.asarray(board.m.z0) * (1 + 1e-4 * np.random.default_rng(0).standard_normal((64, 120)))
    frames[5, 3] = np.nan
    sigma = take(frames, bundle.prereconstructor(), "b1", 0).sigma
    assert np.flatnonzero(~np.isfinite(sigma)).tolist() == [3]


def test_disagreement_keeps_its_false_alarm_rate(board: Board) -> None:
    noise = np.random.default_rng(5)
    ratios = []
    for _ in range(300):
        found, limit = disagreement(1 + 1e-3 * noise.standard_normal((64, 120)))
        ratios.append(found / limit)
    assert max(ratios) < 1
    assert max(ratios) > 0.6  # the limit is not so far away that nothing would be noticed


def not_believed(frame: RawFrame, reason: str) -> RawFrame:
    """As acquisition sends it on."""
    frame.valid, frame.reasons = False, [reason]
    return received(frame)


def test_what_a_scan_teaches_waits_until_its_frame_has_left(skin: Skin, bundle: Bundle, board: Board) -> None:
    """And a stage that is never left the time learns the same with the next scan."""
    hurried, other = (tared(Preprocessing("palm", skin, bundle), each) for each in (board, deepcopy(board)))
    for frame in [received(board.frame()) for _ in range(8)]:
        (first,) = hurried.process(frame, WANTED)
        assert other.estimator.skin is not None
        was = other.estimator.skin.drift.now.at_s
        (second,) = other.process(frame, WANTED)
        assert other.estimator.skin.drift.now.at_s == was
        other.beside(WANTED)
        assert other.estimator.skin.drift.now.at_s > was
        assert pack(first) == pack(second)


@pytest.mark.parametrize("reason", ["frozen", "clock"])
def test_frames_that_acquisition_does_not_believe_are_no_baseline(
    stage: Preprocessing, board: Board, reason: str
) -> None:
    for _ in range(144):
        assert "stale_baseline" in run(stage, not_believed(board.frame(), reason)).reasons
    assert stage.saved() is None
    with pytest.raises(Refused, match="0 of 64 frames"):
        stage.command("tare", {})
    tared(stage, board)


@pytest.mark.parametrize("reason", ["frozen", "clock"])
def test_the_baseline_follows_no_frame_that_acquisition_does_not_believe(
    stage: Preprocessing, board: Board, reason: str
) -> None:
    """Nor does it learn anything else: what comes after them is judged as if they had not been."""
    tared(stage, board)
    learnt = stage.estimator.state()["tared"]
    for k in range(400):
        out = run(stage, not_believed(board.frame(1e-4 * min(1.0, k / 200)), reason))
        assert not out.valid and reason in out.reasons
    after = stage.estimator.state()["tared"]
    assert all(str(learnt[part]) == str(after[part]) for part in ("drift", "noise", "log_z0", "touches"))
    even = [run(stage, board.frame(1e-4)).difference.mean() for _ in range(200)]  # those that it believes are followed
    assert abs(np.mean(even[-20:])) < 0.2e-4 and np.mean(even[:2]) > 0.5e-4


def test_a_held_touch_is_not_averaged_over_frozen_frames(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    touch = board.disc(0.2, 0.1, 0.3, 0.3)
    for _ in range(3):
        run(stage, board.frame(touch))
    again = board.frame(touch)
    for _ in range(40):
        frozen = dataclasses.replace(again, scan=again.scan)
        run(stage, not_believed(frozen, "frozen"))
    single = tared(Preprocessing("palm", stage.config, stage.bundle), Board(stage.bundle))
    alone = run(single, Board(stage.bundle, seed=9).frame(touch)).sigma
    out = run(stage, board.frame(touch))
    assert out.valid and out.touched
    assert out.held or np.allclose(out.sigma, alone, rtol=0.3)  # of one scan, or of two


def test_no_false_touch_and_the_lightest_touch_is_seen(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    assert not any(run(stage, board.frame()).touched for _ in range(300))
    light = board.disc(0.0, 0.0, 0.1, 0.1)  # 1 N of the 10 mm indenter at the centre
    assert all(run(stage, board.frame(light)).touched for _ in range(5))
    run(stage, board.frame())
    assert not run(stage, board.frame()).touched


def test_untouched_frames_are_not_reconstructed(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    assert run(stage, board.frame()).averaged == 0
    stage.always_reconstruct = True
    assert run(stage, board.frame()).averaged == 1


def test_a_frame_to_be_reconstructed_is_small(stage: Preprocessing, board: Board) -> None:
    """What inference forms of it is not carried: nine images are ten times as much."""
    tared(stage, board)
    delta = run(stage, board.frame(board.disc(0.2, 0.1, 0.2, 0.3)))
    assert delta.averaged == 1 and len(pack(delta)) < 8192


def test_an_unchanged_touch_is_held_and_averaged(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    touch = board.disc(0.2, 0.1, 0.2, 0.3)
    outs = [run(stage, board.frame(touch)) for _ in range(40)]
    reconstructed = [i + 1 for i, o in enumerate(outs) if not o.held]
    assert reconstructed == [1, 2, 4, 8, 16, 32]
    assert [o.averaged for o in outs if o.averaged] == [1, 2, 4, 8, 16, 16]
    assert all((o.averaged > 0) == (not o.held) for o in outs)
    scans = [o.scan for o in outs]
    assert [o.reconstructed for o in outs[7:10]] == [scans[7]] * 3
    expected = touch * np.asarray(board.m.z0) / stage.pre.normaliser(np.asarray(board.m.z0, float))
    error = [np.sqrt(np.mean((outs[i - 1].difference - expected) ** 2)) for i in (1, 16)]
    assert error[1] < 0.6 * error[0]  # 16 frames averaged; the tare's own noise remains


def test_creep_is_seen(stage: Preprocessing, board: Board) -> None:
    """Each step is far below the noise, their sum is not."""
    tared(stage, board)
    start = board.disc(0.2, 0.1, 0.2, 0.30)
    end = board.disc(0.2, 0.1, 0.2, 0.33)
    run(stage, board.frame(start))
    last = None
    for n in range(100):
        out = run(stage, board.frame(start + (end - start) * n / 100))
        last = last if out.held else out
    assert last is not None
    truth = (end - start) @ (last.difference - start) / ((end - start) @ (end - start))
    assert truth > 0.7


def test_a_dead_electrode_is_left_out(stage: Preprocessing, board: Board, bundle: Bundle) -> None:
    tared(stage, board)
    frame = board.frame()
    uses = (bundle.pattern == 5).any(axis=1)
    frame.z[uses] = np.nan
    frame.status[uses] = STATUS_OPEN
    out = run(stage, received(frame))
    assert out.valid and not out.touched
    assert out.reasons == ["electrode_open"]
    assert list(np.flatnonzero(out.electrodes)) == [5]
    assert not np.isfinite(out.sigma[uses]).any() and np.isfinite(out.sigma[~uses]).all()
    after = [run(stage, board.frame()) for _ in range(4)]
    assert not any(out.electrodes.any() or out.touched for out in after) and all(out.valid for out in after)


@pytest.mark.parametrize("reasons", [[], ["clock"], ["gap", "clock"]])
@pytest.mark.parametrize("valid", [True, False])
def test_failed_measurements_do_not_change_what_the_producer_says(
    stage: Preprocessing, board: Board, valid: bool, reasons: list[str]
) -> None:
    tared(stage, board)
    frame = board.frame()
    frame.z[7] = np.nan
    frame.valid, frame.reasons = valid, reasons
    heard = received(frame)
    assert not heard.valid and heard.reasons == [*reasons, "non_finite"]
    out = run(stage, heard)
    assert (out.valid, out.reasons) == (valid, reasons)
    assert np.flatnonzero(~np.isfinite(out.sigma)).tolist() == [7]
    assert run(stage, board.frame()).valid


def test_a_short_between_two_electrodes_is_named(stage: Preprocessing, board: Board, bundle: Bundle) -> None:
    tared(stage, board)
    frame = board.frame(board.disc(0.0, 0.0, 0.2, 0.3))
    shorted = WireMaps(bundle.pattern).one(WireFault(WireKind.SHORT, (2, 3)), np.abs(frame.z.astype(complex)))
    frame.z = shorted.values.astype(np.complex64)
    out = run(stage, frame)
    assert out.valid and out.touched and out.reasons == ["electrode_short", "degraded"]
    assert list(np.flatnonzero(out.electrodes == 2)) == [2, 3]


def test_more_than_two_dead_electrodes_make_a_frame_invalid(stage: Preprocessing, board: Board, bundle: Bundle) -> None:
    tared(stage, board)
    frame = board.frame()
    frame.status[np.isin(bundle.pattern, (1, 6, 11)).any(axis=1)] = STATUS_OPEN
    out = run(stage, frame)
    assert not out.valid and "electrode_open" in out.reasons


def test_frames_of_another_skin_are_refused(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    frame = board.frame()
    frame.z, frame.status = frame.z[:64], frame.status[:64]
    out = run(stage, frame)
    assert not out.valid and out.reasons == ["out_of_distribution"]
    assert "64 measurements" in stage.health().messages[0]


def test_tare_is_refused_while_touched(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    for _ in range(70):
        run(stage, board.frame(board.disc(0.0, 0.0, 0.2, 0.3)))
    with pytest.raises(Refused, match="touched"):
        stage.command("tare", {})
    for _ in range(10):
        run(stage, board.frame())
    with pytest.raises(Refused, match="of 64 untouched frames"):
        stage.command("tare", {})
    for _ in range(70):
        run(stage, board.frame())
    assert stage.command("tare", {})["snr_db"] == pytest.approx(80, abs=1)


def test_the_baseline_survives_a_crash_but_not_another_board(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board
) -> None:
    tared(stage, board)
    saved = stage.saved()
    assert saved is not None and stage.saved() is None
    again = Preprocessing("palm", skin, bundle)
    again.restore(saved, 60.0)
    assert run(again, board.frame()).valid
    assert not run(again, board.frame(board="b2")).valid
    with pytest.raises(Refused, match="old"):
        Preprocessing("palm", skin, bundle).restore(saved, 1e6)
    with pytest.raises(Refused, match="another bundle"):
        Preprocessing("palm", skin, bundle).restore(saved | {"bundle": "x"}, 1.0)


def test_slow_drift_is_followed_while_untouched(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    board.frame_ns = 1_000_000_000
    impedances = board.m.contact @ np.random.default_rng(2).uniform(-0.02, 0.02, 16)  # of the electrodes' contacts
    outs = [run(stage, board.frame((2e-3 + impedances) * n / 600)) for n in range(600)]
    assert not any(o.touched for o in outs)
    assert np.abs(outs[-1].difference).mean() < 0.1 * np.abs(2e-3 + impedances).mean()


def test_state_continues_bit_by_bit(stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board) -> None:
    tared(stage, board)
    touch = board.disc(-0.3, 0.4, 0.2, 0.2)
    for _ in range(5):
        run(stage, board.frame(touch))
    twin = Preprocessing("palm", skin, bundle)
    twin.load(stage.state())
    for n in range(20):
        frame = board.frame(touch if n < 15 else 0.0)
        a, b = run(stage, frame), run(twin, frame)
        assert a.averaged == b.averaged and a.score == b.score and a.held == b.held
        assert a.difference.tobytes() == b.difference.tobytes()


def test_a_state_of_an_earlier_layout_gives_its_baseline(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board
) -> None:
    state = tared(stage, board).state()
    state["estimator"]["layout"] -= 1
    later = Preprocessing("palm", skin, bundle)
    later.load(state)
    assert run(later, board.frame()).valid and later.baseline is not None
    assert later.baseline.z0.tobytes() == state["baseline"]["z0"].tobytes()


@pytest.mark.parametrize(
    ("key", "value"),
    [("z0", np.nan), ("z0", -1.0), ("z0", np.inf), ("sigma", 0.0), ("sigma", -1e-3), ("sigma", np.nan)],
)
def test_an_impossible_baseline_is_refused(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board, key: str, value: float
) -> None:
    state = tared(stage, board).state()
    state["baseline"][key] = np.where(np.arange(120) == 7, value, state["baseline"][key])
    with pytest.raises(Refused, match="not possible"):
        Preprocessing("palm", skin, bundle).load(state)
    with pytest.raises(Refused, match="not possible"):
        Preprocessing("palm", skin, bundle).restore({"bundle": bundle.hash, "baseline": state["baseline"]}, 1.0)
    with pytest.raises(Refused):
        Preprocessing("palm", skin, bundle).restore({"bundle": bundle.hash}, 1.0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tared.log_z0", np.ones(7)),
        ("tared.log_z0", np.full(120, np.nan)),
        ("tared.scatter", np.ones((3, 7))),
        ("scans.said", [1]),
        ("parts", [1, 2, 3]),
        ("references", {"row": []}),
        ("bundle", None),
        ("hold", {"reference": np.ones(7), "recent": np.zeros((0, 120)), "averaged": 1, "count": 1, "scan": 1}),
    ],
)
def test_a_state_of_another_shape_is_refused(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board, key: str, value: object
) -> None:
    """And nothing changes of the stage that refuses it."""
    twin = Preprocessing("palm", skin, bundle)
    twin.load(tared(stage, board).state())
    stage.load(stage.state())
    state = stage.state()
    part, _, name = key.rpartition(".")
    if part:
        state["estimator"][part] |= {name: value}
    elif value is None:
        del state[key]
    else:
        state[key] = value
    with pytest.raises(Refused, match="saved"):
        twin.load(state)
    touch = board.disc(0.0, 0.0, 0.2, 0.3)
    for frame in (board.frame(), board.frame(touch), board.frame(touch)):
        assert pack(run(stage, frame)) == pack(run(twin, frame))


def test_a_measurement_without_a_baseline_is_taken_over(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board
) -> None:
    state = tared(stage, board).state()
    state["baseline"]["z0"][3], state["baseline"]["sigma"][3] = 0.0, np.inf
    twin = Preprocessing("palm", skin, bundle)
    twin.load(state)
    assert np.flatnonzero(~np.isfinite(run(twin, board.frame()).sigma)).tolist() == [3]


def test_a_recording_never_meets_the_boards_baseline(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    assert not run(stage, board.frame(source="replay")).valid
    assert stage.saved() is None


def test_reference_frames_are_the_baseline(stage: Preprocessing, board: Board) -> None:
    for _ in range(72):
        run(stage, board.frame(source="replay"))
    shifted = 0.01 * np.cos(np.arange(120))
    frame = board.frame(shifted, source="replay")
    frame.kind = "reference"
    run(stage, frame)
    assert not run(stage, board.frame(shifted, source="replay")).touched
    assert run(stage, board.frame(shifted + board.disc(0.0, 0.3, 0.2, 0.3), source="replay")).touched


def test_more_noise_than_networks_were_trained_with_is_never_valid(skin: Skin, bundle: Bundle) -> None:
    """Not even after a tare on command: looking at the skin does not mend it."""
    for snr_db, valid in ((50.0, True), (40.0, False), (30.0, False)):
        stage, board = Preprocessing("palm", skin, bundle), Board(bundle, snr_db)
        for _ in range(80):
            found = run(stage, board.frame())
        assert found.valid == valid and not found.touched
        assert valid == (not stage.health().messages)
        stage.command("tare", {"force": True})
        assert run(stage, board.frame()).valid == valid
        if not valid:
            assert "trained for 0.56 %" in stage.health().messages[0]


def test_take_refuses_noise_and_missing_measurements(bundle: Bundle) -> None:
    pre, rng = bundle.prereconstructor(), np.random.default_rng(0)
    with pytest.raises(NoBaseline, match="scatter"):
        take(bundle.z0 * (1 + 0.2 * rng.standard_normal((64, 120))), pre, "", 0)
    half = np.where(np.arange(120) < 70, np.nan, bundle.z0 * np.ones((64, 120)))
    with pytest.raises(NoBaseline, match="measurements give values"):
        take(half, pre, "", 0)


def test_info_says_what_frames_are_compared_with(stage: Preprocessing, board: Board) -> None:
    """Its hash is that of its arrays, drift is told as it is followed, and nothing that was told changes."""
    tared(stage, board)
    first, truth = stage.info(), np.asarray(board.m.z0, float)
    assert first is not None
    told, copies, per_scan = [first], [first["baseline"].copy()], 2e-5
    for n in range(1, 600):
        run(stage, board.frame(per_scan * n))
        if (info := stage.info()) is not None:
            told.append(info)
            copies.append(info["baseline"].copy())
        off = np.abs(truth * (1 + per_scan * n) / told[-1]["baseline"] - 1)
        assert np.median(off) < 1.5 * per_scan * EVERY_S * 1e9 / FRAME_NS + MOVED
    seconds = 600 * FRAME_NS * 1e-9
    assert seconds / EVERY_S / 2 <= len(told) <= 1 + seconds / EVERY_S
    for info, copy in zip(told, copies, strict=True):
        assert np.array_equal(info["baseline"], copy)
        expected = hashlib.sha256(info["baseline"].tobytes() + info["baseline_sigma"].tobytes()).hexdigest()
        assert info["baseline_hash"] == expected
    revisions = [info["baseline_revision"] for info in told]
    assert revisions == sorted(set(revisions)) and len({info["baseline_hash"] for info in told}) == len(told)
    assert len({info["tare_sample_ns"] for info in told}) == 1


def test_a_tare_is_told_at_once_and_a_still_baseline_once(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    infos = [stage.info()]
    for _ in range(300):
        run(stage, board.frame())
        infos.append(stage.info())
    assert infos[0] is not None and not any(infos[1:])
    stage.command("tare", {})
    again = stage.info()
    assert again is not None and again["baseline_hash"] != infos[0]["baseline_hash"]
    assert again["baseline_revision"] > infos[0]["baseline_revision"] and stage.info() is None


def test_a_baseline_is_its_own(bundle: Bundle) -> None:
    """Neither who made it nor who was given it changes it: its hash stays true."""
    z0 = np.asarray(bundle.z0, dtype=float).copy()
    baseline = Baseline(z0, 1e-4 * z0, 64, "b1", 0)
    before = baseline.hash
    z0 *= 2
    assert baseline.hash == before
    with pytest.raises(ValueError, match="read-only"):
        baseline.z0[0] = 0.0


@pytest.mark.parametrize(
    ("bit", "reason"), [(STATUS_CLIPPED, "saturated"), (STATUS_RTIA, "saturated"), (STATUS_FIFO, "fifo")]
)
def test_a_measurement_that_the_board_doubts_is_left_out_by_name(
    stage: Preprocessing, board: Board, bit: int, reason: str
) -> None:
    tared(stage, board)
    frame = board.frame()
    frame.status[[7, 30]] = bit
    frame.z[30] *= 1.5  # a number, but another measurement's
    out = run(stage, frame)
    assert out.valid and not out.touched and out.reasons == [reason]
    assert np.flatnonzero(~np.isfinite(out.sigma)).tolist() == [7, 30]
    frame = board.frame()
    frame.status[:] = bit
    out = run(stage, frame)
    assert not out.valid and reason in out.reasons


@pytest.mark.parametrize("lost", [12, 33])
def test_a_frame_that_lacks_a_run_of_measurements_knows_where_it_sees_less(
    stage: Preprocessing, board: Board, lost: int
) -> None:
    """Touches are what they are within their sigma, which grows by what is missing: pairs of the last electrodes."""
    tared(stage, board)
    sigmas = []
    for missing in (0, lost):
        for x, y in ((0.0, 0.0), (-0.6, 0.5), (-0.2, 0.7), (0.5, -0.3)):
            for _ in range(3):
                frame = board.frame(board.disc(x, y, 0.2, 0.3))
                frame.status[len(frame.status) - missing :] = STATUS_FIFO
                out = run(stage, frame)
            assert out.valid and set(out.reasons) <= {"fifo"}
            (touch,) = out.estimates
            metres = stage.bundle.metres_per_unit
            off_m = np.hypot(touch.position[0] - metres * x, touch.position[1] - metres * y)
            assert off_m < 4 * touch.sigma[0] + 3e-4
            sigmas.append(touch.sigma[0])
            while run(stage, board.frame()).touched:
                pass
    assert sum(sigmas[4:]) > sum(sigmas[:4])


def test_a_frame_that_lacks_more_than_half_of_its_measurements_is_not_valid(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    frame = board.frame()
    frame.status[-66:] = STATUS_FIFO
    out = run(stage, frame)
    assert not out.valid and "fifo" in out.reasons


def test_what_a_bundle_cannot_tell_is_said_and_is_no_warning(skin: Skin, bundle: Bundle) -> None:
    assert checks.sentence(bundle) == ""
    found = Bundle.load("disc16")
    measured = Preprocessing("disc", skin.model_copy(update={"bundle": "disc16"}), found)
    measured.set_baseline(Baseline(found.z0, 1e-4 * found.z0, 64, "b1", 0))
    assert measured.health().level == "OK"
    (message,) = measured.health().messages
    assert message.startswith("not checked with the bundle disc16")
    assert all(check in message for check in ("shorts", "exchanged wires", "contacts that change", "no touch can make"))


def test_what_a_bundle_cannot_tell_follows_from_its_pattern(bundle: Bundle) -> None:
    """Not from its name: a model of some pairs only, and one whose impedances were measured."""
    assert not checks.skipped(bundle)

    def like(rows: slice, normalisation: str) -> dict[str, str]:
        matrices = SimpleNamespace(normalisation=normalisation)
        return checks.skipped(SimpleNamespace(pattern=bundle.pattern[rows], matrices=matrices))  # type: ignore[arg-type]

    assert list(like(slice(0, None, 2), "model")) == ["exchanged wires and stuck multiplexers"]
    assert list(like(slice(None), "measured")) == [
        "exchanged wires and stuck multiplexers",
        "contacts that change",
        "changes that no touch can make",
        "touches at the first start",
        "drift under a touch",
        "touches that change during a scan",
    ]


def test_a_short_scan_of_an_old_recording_makes_no_contact_and_disturbs_nothing(
    stage: Preprocessing, board: Board, bundle: Bundle
) -> None:
    tared(stage, board)
    before = stage.state()
    frame = board.frame()
    frame.z, frame.status, frame.kind = frame.z[:12], np.zeros(12, np.uint8), "sentinel"
    out = run(stage, frame)
    assert not out.valid and out.reasons == ["coarse"] and not out.touched and np.isinf(out.sigma).all()
    assert str(stage.state()) == str(before)
    assert run(stage, board.frame()).valid
