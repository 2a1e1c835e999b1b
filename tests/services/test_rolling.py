"""Scans in parts: what acquisition hands on, boards that know none, what preprocessing takes for a whole scan."""

from __future__ import annotations

import numpy as np
import pytest

from bench.speed.simulated_host import SimulatedHost
from models.bundle import Bundle
from protocol import link
from protocol.frames import RawFrame, pack, unpack
from services.board.boardlink import BoardLink
from services.board.newest_values import NewestValues
from services.board.remarks import WHOLE, Remarks
from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.persistence import arrays, plain
from services.runtime.stage import Health
from tests.services.rolling_host import rolling_host

ROLLING = Skin(port="stub", bundle="square16", scan="rolling")


@pytest.fixture(scope="module")
def bundle():
    return Bundle.load("square16")


@pytest.fixture(scope="module")
def host():
    with rolling_host(seed=2) as host:
        yield host


def part(seq, of=5, n=2, value=1.0, config=1):
    z = np.full(n, value, np.complex64)
    return link.ScanFrame(seq, 1000 * seq, 900, config, z, np.zeros(n, "u1"), seq % of, of)


def test_the_newest_values_have_their_places_their_ages_and_say_which_are_new():
    order = np.array([3, 0, 9, 4, 1, 2, 5, 6, 8, 7])
    newest = NewestValues(order)
    assert [newest.take(part(seq, value=seq)) for seq in range(5)] == [False] * 4 + [True]
    assert newest.take(part(5, value=5))
    header = RawFrame(skin="palm", z=np.zeros(2, "c8"), status=np.zeros(2, "u1"))
    frame = unpack(pack(newest.frame(header, part(5, value=5))))
    assert (frame.part, frame.parts, frame.reasons) == (1, 5, [])
    assert np.flatnonzero(frame.new).tolist() == [0, 3]
    by_place = dict(zip(order.tolist(), np.repeat([5, 1, 2, 3, 4], 2), strict=True))
    assert frame.z.real.tolist() == [by_place[k] for k in range(10)]
    assert frame.age_us[3] == pytest.approx(675) and frame.age_us[0] == pytest.approx(225)
    assert frame.age_us[9] == pytest.approx(4675) and frame.age_us[4] == pytest.approx(4225)


def test_after_a_gap_nothing_from_before_it_is_handed_on():
    newest = NewestValues(np.arange(10))
    header = RawFrame(skin="palm", z=np.zeros(2, "c8"), status=np.zeros(2, "u1"))
    taken = [newest.take(part(seq)) for seq in (0, 1, 2, 3, 4, 6, 7, 8, 9)]
    assert taken == [False] * 4 + [True] + [False] * 4
    assert newest.take(part(10))
    assert newest.frame(header, part(10)).reasons == ["gap"]
    assert newest.take(part(11))
    assert newest.frame(header, part(11)).reasons == []


def test_a_board_sends_parts_and_whole_scans_are_made_of_them():
    with rolling_host(seed=2) as host:
        _sends_parts(host)


def _sends_parts(host):
    assert host.link.scanning.parts == 10
    seconds = 1e-9 * (host.raws[-1].stamps["sample"] - host.raws[0].stamps["sample"])
    assert len(host.raws) / seconds == pytest.approx(229, rel=0.03)
    assert all(len(f.z) == 120 and f.new.sum() == 12 for f in host.raws)
    assert [f.part for f in host.raws[:12]] == [10, *range(1, 11), 1]
    assert max(float(f.age_us.max()) for f in host.raws) < 44_000
    steps = np.diff([f.stamps["sample"] for f in host.raws[20:]]) * 1e-6
    assert steps == pytest.approx(4.36, abs=0.5)
    frames = [f for _, f in host.contacts]
    assert len(frames) / seconds == pytest.approx(22.9, rel=0.05), (
        "nothing touches: contacts at the rate of whole scans"
    )
    assert all(f.valid and not f.contacts for f in frames[-20:])
    raws = {f.scan: f.stamps["sample"] for f in host.raws}
    assert all(raws[f.scan] == f.stamps["sample"] for f in frames[-20:]), "it stands for the instant of its newest part"


def test_a_touch_is_where_it_is_and_a_released_one_is_gone(host):
    host.press(x=0.02, y=-0.01, force=2.0, radius=0.01, seconds=60.0)
    host.until(host.now + 0.4)
    frame = host.contacts[-1][1]
    assert frame.valid and "changing" not in frame.reasons
    (contact,) = frame.contacts
    assert np.hypot(contact.position[0] - 0.02, contact.position[1] + 0.01) < 1e-3
    host.release()
    host.until(host.now + 0.3)
    frame = host.contacts[-1][1]
    assert frame.valid and not frame.contacts


def test_an_open_electrode_is_named_in_parts_too():
    host = SimulatedHost("rolling", snr_db=80.0, seed=5)
    host.until(5.0)
    host.rig.fault("electrode_open", {"electrode": 5}, host.now, seconds=100)
    since = len(host.contacts)
    host.until(host.now + 0.5)
    frames = [f for _, f in host.contacts[since:]]
    assert "electrode_open" in frames[-1].reasons
    assert not any(c for f in frames for c in f.contacts if f.valid and c.state != "end")
    host.rig.close()


def test_a_board_that_knows_no_parts_scans_whole_and_status_says_so(bundle):
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.rig.board.knows_parts = False
    host.until(4.0)
    assert host.link.scanning.parts == 1 and host.link.knows_no_parts
    frames = [f for _, f in host.contacts]
    assert len(frames) > 60 and frames[-1].valid and frames[-1].part == 0
    remarks = Remarks()
    remarks.look(host.link, host.now)
    assert WHOLE in remarks.added_to(Health()).messages
    host.rig.close()


def test_frames_of_another_cut_are_foreign(bundle):
    host = SimulatedHost("rolling", seed=4)
    scanning = host.source.scanning
    board = BoardLink(scanning, 0.0)
    assert scanning.sent(part(0, of=10, n=12, config=scanning.config))
    assert not scanning.sent(part(0, of=5, n=24, config=scanning.config))
    assert not scanning.sent(part(0, of=10, n=11, config=scanning.config))
    assert not scanning.sent(part(0, of=1, n=120, config=scanning.config))
    assert scanning.whole.config != scanning.config and scanning.whole.sent(
        part(0, of=1, n=120, config=scanning.whole.config)
    )
    assert not board.knows_no_parts
    host.rig.close()


def test_a_part_makes_no_delta_frame_and_its_state_goes_with_a_recording(host):
    raws = host.raws[-40:]
    first = Pipeline(ROLLING, "palm")
    made = [first.step(raw) is not None for raw in raws[:25]]
    assert made == [k % 10 == 0 for k in range(25)]
    state = [plain(stage.state()) for stage in (first.pre, first.inference, first.publishing)]
    assert first.pre.command("part", {"scan": raws[24].scan}) == {"seen": True, "handed_on": False}
    assert first.pre.command("part", {"scan": raws[20].scan}) == {"seen": False, "handed_on": True}
    second = Pipeline(ROLLING, "palm")
    for stage, kept in zip((second.pre, second.inference, second.publishing), state, strict=True):
        stage.load(arrays(kept))
    for raw in raws[25:]:
        one, other = first.step(raw), second.step(raw)
        assert (one is None) == (other is None)
        assert one is None or (one.scan, one.valid, one.reasons) == (other.scan, other.valid, other.reasons)
