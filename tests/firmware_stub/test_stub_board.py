"""The board over its link, in simulated time: commands, timing, noise, physics; it measures as its CONFIG says."""

import numpy as np
import pytest

from firmware_stub.analog import four_terminal
from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from models.mismatch import MismatchedSheet, named
from models.patterns import pattern
from models.scan_response import noise, sine_left
from models.shapes import Shape
from protocol import link
from protocol.scan_setting import COHERENT, NAMED, PAPER, ScanSetting
from tests import needs
from tests.firmware_stub.conftest import PAIRS, middles, shared_sheet

PAIR_S = 2e-6 * ((20 * 128 + 25) / 16 + 20)  # one measurement of 128 points: voltage and current


def test_commands_are_answered_and_refused_with_the_reason(host):
    board = host()
    ident = board.ask(link.Hello(schema_hash=link.SCHEMA_HASH))
    assert (ident.schema_hash, ident.chip_id, ident.electrodes) == (link.SCHEMA_HASH, link.CHIP_ID, 16)
    assert "stub" in ident.firmware and board.ask(link.Start(7)).reason == link.NakReason.NOT_CONFIGURED
    for wrong in ([0, 16, 0, 1], [3, 3, 0, 1]):
        assert board.ask(link.Config(1, 128, 80e3, np.array([wrong]))).reason == link.NakReason.BAD_CONFIG
    board.start()
    assert board.ask(link.SelfTest()).reason == link.NakReason.BUSY
    assert board.ask(link.Stop()).of == link.Stop.number
    board.wait(0.1)
    assert board.frames(0.5) == [] and board.ask(link.SelfTest()).value == 0


@pytest.mark.parametrize(("points", "rate"), [(128, 22.9), (512, 6.3)])
def test_the_scan_rate_is_that_of_the_dft_and_a_short_list_is_proportionally_faster(host, points, rate):
    board = host().start(PAIRS, points)
    frames = [m for m in board.wait(4.0, step=0.5) if isinstance(m, link.ScanFrame)]  # it runs ahead in any steps
    assert len(frames) / 4.0 == pytest.approx(rate, rel=0.05) and board.rig.field.solves == 1 and frames[0].seq == 0
    assert frames[0].duration_us == pytest.approx(120 * 2 * ((20 * points + 25) / 16 + 20), abs=1)
    steps = np.diff([frame.device_us for frame in frames])
    assert np.abs(steps - frames[0].duration_us).max() < 3
    board.send(link.Config(2, points, 80e3, PAIRS[:12]))
    board.send(link.Start(2))
    more = board.frames(0.5)
    short = [f for f in more if f.config == 2]
    assert len(short) > 20 and short[0].duration_us * 10 == pytest.approx(frames[0].duration_us, rel=1e-3)
    assert [f.seq for f in more] == list(range(frames[-1].seq + 1, frames[-1].seq + 1 + len(more)))


def test_the_clock_is_off_by_its_crystal_and_the_board_says_what_it_shows_unless_its_firmware_cannot(host):
    board = host(crystal_ppm=200.0)
    assert board.ask(link.Hello()).capabilities & link.Capability.TIME
    board.start(PAIRS[:30])
    frames = board.frames(6.0)
    true_us = 30 * 1e6 * PAIR_S * (frames[-1].seq - frames[0].seq)
    assert 1e6 * ((frames[-1].device_us - frames[0].device_us) / true_us - 1) == pytest.approx(200, abs=1)
    for nonce in (7, 2**32 - 1):
        asked = board.now + 0.02  # `ask` waits so long
        answer = board.ask(link.TimeAsk(nonce))
        assert isinstance(answer, link.Time) and answer.nonce == nonce
        assert asked <= answer.device_us / (1 + 200e-6) * 1e-6 + 1e-6 and answer.device_us * 1e-6 < board.now
    assert board.ask(link.Start(1)).device_us * 1e-6 == pytest.approx(board.now - 0.05, abs=0.01)
    old = host(answers_time=False)
    assert not old.ask(link.Hello()).capabilities & link.Capability.TIME
    assert old.ask(link.TimeAsk(1)).reason == link.NakReason.UNKNOWN


def test_the_link_is_paced_and_scans_beyond_it_are_lost_and_counted(host):
    board = host().start()
    begin = board.now
    while not board.decoder.counts["good"] > 3:  # boot event and two answers came before
        board.wait(0.0005, 0.0005)
    assert 0.0436 + 0.0105 < board.now - begin + 0.05 < 0.0436 + 0.0135 + 0.05
    forced = host(rate_hz=200.0).start()
    frames = forced.frames(2.0)
    assert 80 < len(frames) / 2.0 < 90 and forced.decoder.bad == 0
    assert forced.rig.line.dropped > 130 and frames[-1].seq - frames[0].seq > 260


def test_an_untouched_skin_measures_as_eidors_says(host):
    reference = np.load(needs.reference("eidors_reference.npz"))
    for name in ("pairs", "adjacent"):
        z = host(snr_db=110.0).start(pattern(name).astype("u1")).z(0.5).mean(0)
        assert np.abs(z / np.abs(reference[f"impedance_{name}"][0]) - 1).max() < 0.01


def test_a_mismatched_sheet_is_measured_as_it_is_not_as_its_file_says():
    real = MismatchedSheet("square16", named("mild"), mesh="inverse")
    sheets = Sheet("square16", "mild"), shared_sheet()
    press = Touch("circle", 0.02, -0.01, 0.01, 0.3)
    for world, touches in ((World(), ()), (World(touches=(press,)), (Shape("circle", 0.4, -0.2, 0.2, 0.3),))):
        z = np.abs(real.solve(touches).impedances())
        mild, plain = (np.abs(four_terminal(sheet.transfer(world), sheet.skin.pattern)) for sheet in sheets)
        assert np.abs(mild / z - 1).max() < 0.01 and np.abs(plain / z - 1).max() > 0.05  # two meshes


def test_a_press_and_a_release_are_felt_from_their_instant_on(host):
    """Within the scan under way too; what was measured before stays what it was."""
    board = host(snr_db=160.0).start()
    press = {"x": 0.02, "y": -0.01, "force": 3.0}
    board.frames(0.3)
    before, untouched = board.z(0.1)[-1], None
    for command in (lambda at: board.rig.press(press, at), board.rig.release):
        board.wait(0.0127)
        at = board.now
        command(at)
        frames, after = board.frames(0.2), board.z(0.1)[-1]
        truth = {scan.seq: (scan, len(world.touches)) for scan, world, _ in board.rig.scans}
        shares = []
        for frame in frames:
            scan, touches = truth[frame.seq]
            instants = middles(scan)
            assert np.abs(np.abs(frame.z) / np.where(instants >= at, after, before) - 1).max() < 3e-5
            assert touches == (((scan.start + scan.end) / 2 >= at) == (untouched is None))
            shares.append(np.mean(instants >= at))
        assert sum(0.0 < share < 1.0 for share in shares) == 1, "the scan under way is partly touched"
        before, untouched = after, untouched if untouched is not None else before
    assert np.abs(after / untouched - 1).max() < 3e-5
    board.rig.press(press | {"seconds": 0.3}, board.now)
    assert np.abs(board.z(0.25)[-1] / untouched - 1).max() > 3e-3
    board.wait(0.2)
    assert np.abs(board.z(0.1)[-1] / untouched - 1).max() < 3e-5, "gone after its seconds"


def test_ramps_within_a_scan_are_felt_where_they_are(host, tmp_path):
    keys = "{ t = 0.52, force = 0 }, { t = 0.57, force = 2 }, { t = 0.8, force = 2 }, { t = 0.83, force = 0 }"
    scene = tmp_path / "step.toml"
    scene.write_text(f"duration = 2.0\n[[touch]]\nradius = 0.01\nx = 0.01\ny = 0.0\nkeys = [{keys}]\n")
    board = host(snr_db=160.0).start()
    board.z(0.2)
    board.rig.play(str(scene), board.now + 0.1)
    frames, rig, seen = {frame.seq: frame for frame in board.frames(1.2)}, board.rig, 0
    for scan, _, _ in list(rig.scans):
        worlds = [rig.field.timeline.at(t) for t in middles(scan)]
        if len({len(world.touches) for world in worlds}) > 1:
            seen += 1
            for k in range(0, 120, 17):
                z = np.abs(four_terminal(rig.sheet.transfer(worlds[k]), PAIRS[k : k + 1].astype(int)))[0]
                assert abs(abs(frames[scan.seq].z[k]) / z - 1) < 3e-5, f"measurement {k}"
    assert seen == 2 and rig.field.solves <= 9


def test_a_finger_moves_and_lifts_alone_and_is_felt_by_every_scan(host):
    """What a page that is pressed by pointer sends: the next press of a finger takes the place of the one before."""
    board = host().start()
    rig, untouched, began = board.rig, board.z(0.3)[-1], board.now
    for k in range(12):
        rig.press({"x": -0.02 + 0.002 * k, "y": 0.01, "force": 2.0, "finger": "one"}, board.now)
        board.wait(0.0613)
    assert {len(world.touches) for scan, world, _ in rig.scans if scan.start > began} == {1}
    assert np.abs(board.z(0.1)[-1] / untouched - 1).max() > 3e-3
    rig.press({"x": -0.02, "y": 0.0, "force": 1.0, "finger": "two"}, board.now)
    assert [touch.x for touch in rig.field.timeline.at(board.now + 0.1).touches] == pytest.approx([0.002, -0.02])
    for after_s, finger, left in ((0.1, ("one",), [-0.02]), (0.2, (), [])):
        assert rig.release(board.now + after_s, *finger)["released"] == 1
        assert [touch.x for touch in rig.field.timeline.at(board.now + after_s + 0.1).touches] == left


def test_presses_no_skin_could_feel_are_refused(host):
    rig = host().rig
    rows = [("x", 0.2, "not on the skin"), ("force", 200.0, "expected 0 to .* N on this patch"), ("x", "left", "left")]
    rows += [("x", None, "found no x, expected x and y, in metres")]
    rows += [("force", -1.0, "expected 0"), ("force", float("nan"), "expected 0"), ("seconds", 0.0, "s: expected")]
    for key, value, says in rows:
        with pytest.raises(ValueError, match=says):
            rig.press({"x": 0.0, "y": 0.0, "force": 1.0, key: value}, 0.0)


NO_WINDOW = ScanSetting(50_000, 64, window="none")


def start(board, setting, scan=PAIRS):
    return board.started(link.Config.of(setting, config=1, rtia_ohm=80e3, scan=scan))


@pytest.mark.parametrize("setting", [*NAMED.values(), NO_WINDOW, ScanSetting(50_000, 32, 2, "none", 60e-6)], ids=str)
def test_a_scan_takes_the_time_and_has_the_noise_of_the_setting_that_its_config_carries(host, setting):
    board = start(host(snr_db=70.0), setting, PAIRS[:20])
    frames = board.frames(4.0)
    assert frames[0].duration_us == pytest.approx(20 * 1e6 * setting.pair_s, abs=1)
    assert len(frames) * 20 * setting.pair_s == pytest.approx(4.0, rel=0.05)
    z = np.abs([frame.z for frame in frames])
    assert (z.std(0) / z.mean(0)).mean() == pytest.approx(10 ** (-70 / 20) * noise(setting), rel=0.06)


def test_a_bad_setting_is_refused_with_its_reason_and_the_board_goes_on(host):
    board = host().start()
    for given, says in (
        ({"dft_points": 100}, "100 DFT points: a power of two from 4 to 16384"),
        ({"window": 7}, "window 'of number 7': expected one of none, hanning, fit"),
        ({"dft_points": 16}, "1 cycles in 16 points at 50000 Hz: at least 2"),
    ):
        answer = board.ask(link.Config(**{"config": 2, "dft_points": 128, "rtia_ohm": 80e3, "scan": PAIRS} | given))
        assert isinstance(answer, link.Nak) and answer.reason == link.NakReason.BAD_CONFIG and says in answer.text
    assert {frame.config for frame in board.frames(0.3)} == {1}


def test_offsets_and_mains_are_left_as_the_setting_leaves_them(host):
    """Steady ones move values and never change them: their transient is the same in every scan, which a tare takes."""

    def spread(setting, **volts):
        z = start(host(snr_db=120.0, **volts), setting).z(2.0)
        return float((z.std(0) / z.mean(0)).mean())

    plain = start(host(snr_db=120.0), NO_WINDOW).z(1.0).mean(0)
    moved = start(host(snr_db=120.0, offset_v=0.01), NO_WINDOW).z(1.1)[3:]
    assert np.abs(moved.mean(0) / plain - 1).max() > 1e-3 and (moved.std(0) / plain).max() < 1e-5
    left = {s: spread(s, wander_v=0.3) for s in (PAPER, COHERENT, NO_WINDOW, NAMED["fit"])}
    assert left[NO_WINDOW] > 4 * left[PAPER] > 12 * left[COHERENT] and left[PAPER] > 3 * left[NAMED["fit"]]
    left = {s: spread(s, mains_v=0.2) for s in (PAPER, COHERENT, NO_WINDOW)}
    assert left[PAPER] / left[NO_WINDOW] == pytest.approx(sine_left(PAPER, 50.0) / sine_left(NO_WINDOW, 50.0), rel=0.5)
    assert left[COHERENT] < left[PAPER] / 30
