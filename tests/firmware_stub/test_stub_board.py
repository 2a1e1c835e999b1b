"""The board over its link, in simulated time: commands, timing, noise, the physics of what it measures."""

import numpy as np
import pytest

from firmware_stub.analog import four_terminal
from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from models.mismatch import MismatchedSheet, named
from models.patterns import pattern
from models.shapes import Shape
from protocol import link
from tests import needs

PAIRS = pattern("pairs").astype("u1")
RAMP = "{ t = 0.52, force = 0 }, { t = 0.57, force = 2 }, { t = 0.8, force = 2 }, { t = 0.83, force = 0 }"


def test_hello_is_answered_with_who_it_is(host):
    ident = host().ask(link.Hello(schema_hash=link.SCHEMA_HASH))
    assert isinstance(ident, link.Ident)
    assert (ident.schema_hash, ident.chip_id, ident.electrodes) == (link.SCHEMA_HASH, link.CHIP_ID, 16)
    assert "stub" in ident.firmware


def test_commands_out_of_order_are_refused_with_the_reason(host):
    board = host()
    assert board.ask(link.Start(7)).reason == link.NakReason.NOT_CONFIGURED
    assert board.ask(link.Config(1, 100, 80e3, PAIRS)).reason == link.NakReason.BAD_CONFIG
    assert board.ask(link.Config(1, 128, 80e3, np.array([[0, 16, 0, 1]]))).reason == link.NakReason.BAD_CONFIG
    assert board.ask(link.Config(1, 128, 80e3, np.array([[3, 3, 0, 1]]))).reason == link.NakReason.BAD_CONFIG
    board.start()
    assert board.ask(link.SelfTest()).reason == link.NakReason.BUSY
    assert board.ask(link.Stop()).of == link.Stop.number
    board.wait(0.1)
    assert board.frames(0.5) == []
    assert board.ask(link.SelfTest()).value == 0


@pytest.mark.parametrize(("points", "rate"), [(128, 22.9), (256, 12.2), (512, 6.3)])
def test_the_scan_rate_is_that_of_the_dft(host, points, rate):
    board = host()
    board.start(points=points)
    frames = board.frames(4.0)
    assert len(frames) / 4.0 == pytest.approx(rate, rel=0.05)
    assert frames[0].duration_us == pytest.approx(120 * 2 * ((20 * points + 25) / 16 + 20), abs=1)
    steps = np.diff([frame.device_us for frame in frames])
    assert np.abs(steps - frames[0].duration_us).max() < 3


def test_a_short_list_scans_proportionally_faster_and_numbers_go_on(host):
    board = host()
    board.start()
    last = board.frames(0.5)[-1]
    board.send(link.Config(2, 128, 80e3, PAIRS[:12]))
    board.send(link.Start(2))
    frames = board.frames(0.5)
    short = [f for f in frames if f.config == 2]
    assert len(short) > 80
    assert short[0].duration_us * 10 == pytest.approx(last.duration_us, rel=1e-3)
    assert [f.seq for f in frames] == list(range(last.seq + 1, last.seq + 1 + len(frames)))


def test_the_device_clock_is_off_by_its_crystal(host):
    board = host(crystal_ppm=200.0)
    board.start(PAIRS[:30])
    frames = board.frames(20.0)
    true_us = 30 * 2 * ((20 * 128 + 25) / 16 + 20) * (frames[-1].seq - frames[0].seq)
    measured = (frames[-1].device_us - frames[0].device_us) / true_us - 1
    assert measured * 1e6 == pytest.approx(200, abs=1)


def test_the_board_says_what_its_clock_shows_unless_its_firmware_cannot(host):
    board = host(crystal_ppm=200.0)
    assert board.ask(link.Hello()).capabilities & link.Capability.TIME
    board.start()
    for nonce in (7, 2**32 - 1):
        asked = board.now + 0.02  # `ask` waits so long
        answer = board.ask(link.TimeAsk(nonce))
        assert isinstance(answer, link.Time) and answer.nonce == nonce
        assert asked <= answer.device_us / (1 + 200e-6) * 1e-6 + 1e-6 and answer.device_us * 1e-6 < board.now
    assert board.ask(link.Start(1)).device_us * 1e-6 == pytest.approx(board.now - 0.05, abs=0.01)
    old = host(answers_time=False)
    assert not old.ask(link.Hello()).capabilities & link.Capability.TIME
    assert old.ask(link.TimeAsk(1)).reason == link.NakReason.UNKNOWN


def test_noise_is_what_was_asked_for_and_falls_with_the_points(host):
    scatter = {}
    for points in (128, 512):
        board = host(snr_db=70.0)
        board.start(PAIRS[:20], points)
        z = board.z(3.0)
        scatter[points] = (z.std(0) / z.mean(0)).mean()
    assert scatter[128] == pytest.approx(10 ** (-70 / 20), rel=0.05)
    assert scatter[128] / scatter[512] == pytest.approx(2.0, rel=0.1)


def test_the_link_is_paced(host):
    """A full frame of 1.05 kB takes 11 ms at 921 600 baud."""
    board = host()
    board.start()
    first = 0.0
    begin = board.now
    while not board.decoder.counts["good"] > 3:  # boot event and two answers came before
        board.wait(0.0005, 0.0005)
        first = board.now - begin
    assert 0.0436 + 0.0105 < first + 0.05 < 0.0436 + 0.0135 + 0.05


def test_forced_rates_beyond_the_link_lose_scans_that_are_counted(host):
    board = host(rate_hz=200.0)
    board.start()
    frames = board.frames(3.0)
    assert 80 < len(frames) / 3.0 < 90
    assert board.decoder.bad == 0
    assert board.rig.line.dropped > 200
    assert frames[-1].seq - frames[0].seq > 400


@pytest.mark.parametrize("name", ["pairs", "adjacent"])
def test_an_untouched_skin_measures_as_eidors_says(host, name):
    reference = np.load(needs.reference("eidors_reference.npz"))
    board = host(snr_db=110.0)
    board.start(pattern(name).astype("u1"))
    z = board.z(0.5).mean(0)
    assert np.abs(z / np.abs(reference[f"impedance_{name}"][0]) - 1).max() < 0.01


def test_a_mismatched_sheet_is_measured_as_it_is_not_as_its_file_says():
    real = MismatchedSheet("square16", named("mild"), mesh="inverse")
    press = Touch("circle", 0.02, -0.01, 0.01, 0.3)
    for world, touches in ((World(), ()), (World(touches=(press,)), (Shape("circle", 0.4, -0.2, 0.2, 0.3),))):
        z = np.abs(real.solve(touches).impedances())
        mild, plain = (
            np.abs(read(sheet.transfer(world), sheet.skin.pattern))
            for sheet in (Sheet("square16", "mild"), Sheet("square16"))
        )
        assert np.abs(mild / z - 1).max() < 0.01  # two meshes
        assert np.abs(plain / z - 1).max() > 0.05
    with pytest.raises(ValueError, match="no mismatch 'wild': expected one of none"):
        Sheet("square16", "wild")


def read(transfer, pairs):
    """Impedances that a board reads of a transfer matrix."""
    t = transfer[pairs[:, 0]] - transfer[pairs[:, 1]]
    rows = np.arange(len(pairs))
    return t[rows, pairs[:, 2]] - t[rows, pairs[:, 3]]


def test_a_press_is_felt_from_its_instant_on_and_gone_after_its_seconds(host):
    board = host(snr_db=100.0)
    board.start()
    before = board.z(0.3).mean(0)
    at = board.now
    board.rig.press({"x": 0.02, "y": -0.01, "force": 3.0, "seconds": 1.0}, at)
    scans, frames = [], board.frames(0.2)
    truth = {scan.seq: (scan, len(world.touches)) for scan, world, _ in board.rig.scans}
    still = board.z(0.2).mean(0)
    for frame in frames:
        scan, touches = truth[frame.seq]
        instants = scan.start + (np.arange(120) + 0.5) / 120 * (scan.end - scan.start)
        expected = np.where(instants >= at, still, before)
        assert np.abs(np.abs(frame.z) / expected - 1).max() < 1e-4
        assert touches == ((scan.start + scan.end) / 2 >= at)
        scans.append(np.mean(instants >= at))
    assert sum(0.0 < share < 1.0 for share in scans) == 1, "the scan under way is partly touched"
    board.wait(1.0)
    assert np.abs(board.z(0.2)[-1] / before - 1).max() < 1e-4
    assert len(board.rig.scans[-1][1].touches) == 0


@pytest.mark.parametrize(("keys", "most"), [("{ t = 0.52, force = 2 }, { t = 0.83, force = 2 }", 3), (RAMP, 9)])
def test_jumps_and_ramps_within_a_scan_are_felt_where_they_are(host, tmp_path, keys, most):
    scene = tmp_path / "step.toml"
    scene.write_text(f"duration = 2.0\n[[touch]]\nradius = 0.01\nx = 0.01\ny = 0.0\nkeys = [{keys}]\n")
    board = host(snr_db=160.0)
    board.start()
    untouched = board.z(0.2).mean(0)
    begin = board.now + 0.1
    board.rig.play(str(scene), begin)
    board.frames(1.5)
    rig, sheet = board.rig, board.rig.sheet
    seen = 0
    for scan, _, _ in list(rig.scans):
        instants = scan.start + (np.arange(120) + 0.5) / 120 * (scan.end - scan.start)
        worlds = [rig.field.timeline.at(t) for t in instants]
        if len({len(world.touches) for world in worlds}) < 2:
            continue
        seen += 1
        (frame,) = (m for m in board.messages if isinstance(m, link.ScanFrame) and m.seq == scan.seq)
        for k in range(0, 120, 7):
            z = np.abs(four_terminal(sheet.transfer(worlds[k]), PAIRS[k : k + 1].astype(int)))[0]
            assert abs(abs(frame.z[k]) / z - 1) < 3e-5, f"measurement {k}"
            if not worlds[k].touches:
                assert abs(abs(frame.z[k]) / untouched[k] - 1) < 3e-5
    assert seen == 2 and rig.field.solves <= most


def test_poses_are_as_dense_as_a_fast_slide_needs(host, tmp_path):
    scene = tmp_path / "fast.toml"
    keys = "{ t = 0.1, x = -0.03 }, { t = 0.3, x = 0.03 }"  # 0.3 m/s
    scene.write_text(f"duration = 0.4\n[[touch]]\nradius = 0.01\ny = 0.0\nforce = 2.0\nkeys = [{keys}]\n")
    rig = host().rig
    rig.play(str(scene), 0.0)
    sheet, untouched = rig.sheet, rig.sheet.transfer(World())
    pattern = PAIRS.astype(int)
    instants = np.arange(0.11, 0.29, 0.0131)
    transfer, weights = rig.field.over(instants)
    for t, share in zip(instants, weights, strict=True):
        exact = four_terminal(sheet.transfer(rig.field.at(float(t))), pattern)
        felt = four_terminal(np.tensordot(share, transfer, 1), pattern)
        signal = exact - four_terminal(untouched, pattern)
        assert np.linalg.norm(felt - exact) < 0.01 * np.linalg.norm(signal)


def test_what_was_measured_before_a_command_stays_what_it_was(host):
    """The command's instant lies within the scan under way, whose first values have been measured."""
    board = host(snr_db=160.0)
    board.start()
    board.rig.press({"x": 0.02, "y": 0.0, "force": 3.0, "finger": "one"}, board.now)
    board.frames(0.3)
    held = board.z(0.1)[-1]
    at = board.now + 0.02
    board.wait(0.02)
    board.rig.release(at)
    frames = board.frames(0.2)
    free = board.z(0.1)[-1]
    scan = next(scan for scan, _, _ in board.rig.scans if scan.start < at < scan.end)
    (mixed,) = (frame for frame in frames if frame.seq == scan.seq)
    instants = scan.start + (np.arange(120) + 0.5) / 120 * (scan.end - scan.start)
    assert 5 < (instants < at).sum() < 115
    assert np.abs(np.abs(mixed.z) / np.where(instants < at, held, free) - 1).max() < 3e-5


def test_a_finger_moves_and_lifts_alone(host):
    """What a page that is pressed by pointer sends: the next press of a finger takes the place of the one before."""
    rig = host().rig
    for x in (0.0, 0.01, 0.02):
        rig.press({"x": x, "y": 0.0, "force": 2.0, "finger": "one"}, 0.1)
    rig.press({"x": -0.02, "y": 0.0, "force": 1.0, "finger": "two"}, 0.1)
    assert [touch.x for touch in rig.field.timeline.at(0.2).touches] == [0.02, -0.02]
    assert rig.release(0.3, "one")["released"] == 1
    assert [touch.x for touch in rig.field.timeline.at(0.4).touches] == [-0.02]
    assert rig.release(0.5)["released"] == 1 and not rig.field.timeline.at(0.6).touches


def test_a_finger_that_presses_on_is_felt_by_every_scan(host):
    """A page tells a press again several times a second, at any time of a scan."""
    board = host()
    board.start()
    untouched, began = board.z(0.5)[-1], board.now
    measured = []
    for k in range(20):
        board.rig.press({"x": -0.02 + 0.002 * k, "y": 0.01, "force": 2.0, "finger": "one"}, board.now)
        measured += list(board.z(0.0613))
    felt = [len(world.touches) for scan, world, _ in board.rig.scans if scan.start > began]
    assert len(felt) > 20 and set(felt) == {1}
    changes = np.abs(np.array(measured[3:]) / untouched - 1).max(axis=1)  # of the first ones the scan was under way
    assert len(changes) > 20 and changes.min() > 3e-3
    assert board.rig.release(board.now, "one")["released"] == 1
    assert np.abs(board.z(0.5)[-1] / untouched - 1).max() < 2e-3


def test_a_mirrored_press_gives_the_mirrored_measurements(host):
    """The square is its own mirror image: electrode k of the bottom, right, top, left becomes 3 - k (mod 16)."""
    mirror = (3 - np.arange(16)) % 16
    row = {tuple(sorted(pair)): k for k, pair in enumerate(PAIRS[:, :2].tolist())}
    swapped = [row[tuple(sorted((mirror[a], mirror[b])))] for a, b in PAIRS[:, :2]]
    results = []
    for x in (0.02, -0.02):
        board = host(snr_db=120.0)
        board.start()
        untouched = board.z(0.1)[-1]
        board.rig.press({"x": x, "y": 0.01, "force": 4.0}, board.now)
        results.append(board.z(0.2)[-1] / untouched - 1)
    assert np.abs(results[0] - results[1][swapped]).max() < 0.02 * np.abs(results[0]).max()
    assert np.abs(results[0] - results[1]).max() > 0.3 * np.abs(results[0]).max()


def test_presses_no_skin_could_feel_are_refused(host):
    rig = host().rig
    for values, says in (
        ({"x": 0.2, "y": 0.0, "force": 1.0}, "not on the skin"),
        ({"x": 0.0, "y": 0.0, "force": 200.0}, "expected 0 to .* N on this patch"),
        ({"x": 0.0, "y": 0.0, "force": -1.0}, "expected 0"),
        ({"x": 0.0, "y": 0.0, "force": float("nan")}, "expected 0"),
        ({"x": 0.0, "y": 0.0, "force": 1.0, "seconds": 0.0}, "seconds|s: expected"),
        ({"x": 0.0, "y": 0.0, "force": 1.0, "to_x": 0.0, "to_y": 0.06}, "not on the skin"),
    ):
        with pytest.raises(ValueError, match=says):
            rig.press(values, 0.0)


def test_interpolation_between_key_poses_stays_below_the_noise(host):
    rig = host(scene="slide").rig
    worst = 0.0
    instants = np.arange(1.3, 6.0, 0.377)
    transfer, weights = rig.field.over(instants)
    for t, share in zip(instants.tolist(), weights, strict=True):
        exact = rig.sheet.transfer(rig.field.at(t))
        worst = max(worst, np.abs(np.tensordot(share, transfer, 1) - exact)[:15, :15].max() / exact.max())
    assert worst < 3e-5
    assert rig.field.solves < 45


def test_simulated_time_runs_ahead_in_any_steps_and_a_still_scene_is_solved_once(host):
    board = host()
    board.start()
    frames = [m for m in board.wait(30.0, step=0.5) if isinstance(m, link.ScanFrame)]
    assert len(frames) / 30.0 == pytest.approx(22.9, rel=0.02)
    assert frames[-1].seq - frames[0].seq == len(frames) - 1
    assert board.rig.field.solves == 1
