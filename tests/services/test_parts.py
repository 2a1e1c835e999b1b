"""Scans in parts, bytes in, in simulated time: what is handed on, and touches followed from part to part."""

from collections.abc import Iterator

import numpy as np
import pytest

from firmware_stub.sheet import Sheet
from models.mismatch import Mismatch
from protocol import link
from protocol.frames import Contact, ContactFrame, RawFrame, pack, unpack
from services.board.boardlink import BoardLink
from services.board.newest_values import NewestValues
from services.board.remarks import WHOLE, Remarks
from services.contacts.lasting import LASTS_NS, LastingStates
from services.runtime.stage import Health
from simulation.host import SimulatedHost, tared
from simulation.scenes import DiscPress, script
from simulation.truth import SCAN_S, lasting

PART_HZ = 229
MS = 1_000_000


@pytest.fixture
def host() -> Iterator[SimulatedHost]:
    """After six seconds untouched."""
    made = tared("rolling", keep=True)
    yield made
    made.close()


def during(host: SimulatedHost, seconds: float) -> list[tuple[float, ContactFrame]]:
    """What comes meanwhile, and how long after its beginning."""
    began, first = host.now, len(host.contacts)
    host.until(began + seconds)
    return [(at - began, frame) for at, frame in host.contacts[first:]]


def held(host: SimulatedHost, x: float, y: float, force: float = 2.0, radius: float = 0.01) -> None:
    host.press(x=x, y=y, force=force, radius=radius, seconds=60.0, finger="one")


def over(frame: ContactFrame) -> bool:
    """Whether it says that nothing presses any more."""
    return frame.valid and not lasting(frame)


def off_m(frame: ContactFrame, x: float, y: float) -> float:
    (contact,) = frame.contacts
    return float(np.hypot(contact.position[0] - x, contact.position[1] - y))


# what acquisition hands on


def part(seq: int, of: int = 5, n: int = 2, value: float = 1.0, config: int = 1) -> link.ScanFrame:
    z = np.full(n, value, np.complex64)
    return link.ScanFrame(seq, 1000 * seq, 900, config, z, np.zeros(n, "u1"), seq % of, of)


HEADER = RawFrame(skin="palm", z=np.zeros(2, "c8"), status=np.zeros(2, "u1"))


def test_the_newest_values_have_their_places_their_ages_and_say_which_are_new() -> None:
    order = np.array([3, 0, 9, 4, 1, 2, 5, 6, 8, 7])
    newest = NewestValues(order)
    assert [newest.take(part(seq, value=seq)) for seq in range(6)] == [False] * 4 + [True, True]
    frame = unpack(pack(newest.frame(HEADER, part(5, value=5))))
    assert (frame.part, frame.parts, frame.reasons) == (1, 5, [])
    assert np.flatnonzero(frame.new).tolist() == [0, 3]
    assert frame.z.real[order].tolist() == np.repeat([5, 1, 2, 3, 4], 2).tolist()
    assert frame.age_us[[3, 0, 9, 4]] == pytest.approx([675, 225, 4675, 4225])


def test_after_a_gap_nothing_from_before_it_is_handed_on() -> None:
    newest = NewestValues(np.arange(10))
    taken = [newest.take(part(seq)) for seq in (0, 1, 2, 3, 4, 6, 7, 8, 9)]
    assert taken == [False] * 4 + [True] + [False] * 4
    for seq, reasons in ((10, ["gap"]), (11, [])):
        assert newest.take(part(seq)) and newest.frame(HEADER, part(seq)).reasons == reasons


def test_a_board_sends_parts_and_whole_scans_are_made_of_them(host: SimulatedHost) -> None:
    """While nothing touches, a part makes no frame: contacts come at the rate of whole scans."""
    raw, frames = len(host.raws), [frame for _, frame in during(host, 2.0)]
    raws = host.raws[raw:]
    assert host.link.scanning.parts == 10 and len(raws) / 2.0 == pytest.approx(PART_HZ, rel=0.03)
    assert all(len(f.z) == 120 and f.new.sum() == 12 for f in raws)
    assert all(b.part == a.part % 10 + 1 for a, b in zip(raws, raws[1:], strict=False))
    assert max(float(f.age_us.max()) for f in raws) < 44_000
    assert np.diff([f.stamps["sample"] for f in raws]) * 1e-6 == pytest.approx(4.36, abs=0.5)
    assert len(frames) / 2.0 == pytest.approx(22.9, rel=0.05) and all(f.valid and not f.contacts for f in frames)
    at = {f.scan: f.stamps["sample"] for f in raws}
    assert all(at[f.scan] == f.stamps["sample"] for f in frames), "it stands for the instant of its newest part"


def test_a_board_that_knows_no_parts_scans_whole_and_status_says_so() -> None:
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.rig.board.knows_parts = False
    host.until(4.0)
    assert host.link.scanning.parts == 1 and host.contacts[-1][1].valid and host.contacts[-1][1].part == 0
    (remarks := Remarks()).look(host.link, host.now)
    assert WHOLE in remarks.added_to(Health()).messages
    host.close()


def test_frames_of_another_cut_are_foreign(host: SimulatedHost) -> None:
    scanning, cut = host.source.scanning, host.source.scanning.config
    assert scanning.sent(part(0, of=10, n=12, config=cut)) and not BoardLink(scanning, 0.0).knows_no_parts
    assert not any(scanning.sent(part(0, of=of, n=n, config=cut)) for of, n in ((5, 24), (10, 11), (1, 120)))
    assert scanning.whole.sent(part(0, of=1, n=120, config=scanning.whole.config)) and scanning.whole.config != cut


# touches


def test_a_touch_reaches_a_controller_within_three_parts_and_so_does_its_end(host: SimulatedHost) -> None:
    for x, y in ((0.02, -0.01), (-0.025, 0.02)):
        held(host, x, y)
        seen = [(t, f) for t, f in during(host, 0.25) if f.valid and f.contacts]
        assert seen[0][0] < 0.025 and len({c.id for _, f in seen for c in f.contacts}) == 1
        assert not any("changing" in f.reasons for _, f in seen) and off_m(seen[-1][1], x, y) < 1e-3
        for _, frame in seen:
            assert off_m(frame, x, y) < 3e-3
            if frame.part and "coarse" not in frame.reasons and frame.contacts[0].position_sigma:
                assert off_m(frame, x, y) < 3 * frame.contacts[0].position_sigma[0]
        host.release()
        after = during(host, 0.3)
        gone = next(t for t, f in after if over(f))
        assert gone < 0.025 and all(over(f) for t, f in after if t > gone), "it does not come back"
        host.until(host.now + 0.3)
    samples = [f.stamps["sample"] for _, f in host.contacts]
    assert samples == sorted(samples)


def test_contacts_of_a_held_and_then_sliding_touch_come_at_the_part_rate(host: SimulatedHost) -> None:
    held(host, -0.02, 0.01)
    host.until(host.now + 0.2)
    frames = during(host, 0.3)
    began = host.now - 0.3
    assert len(frames) / 0.3 == pytest.approx(PART_HZ, rel=0.05)
    assert all(f.valid and not f.reasons and off_m(f, -0.02, 0.01) < 1e-3 for _, f in frames)
    assert all(f.contacts[0].velocity == [0, 0, 0] for _, f in frames[20:])
    samples = np.array([f.stamps["sample"] for _, f in frames])
    assert np.diff(samples).min() > 0, "each stands for its own part"
    assert np.median([(began + t) * 1e9 - f.stamps["sample"] for t, f in frames]) < 8e6
    began = host.now
    host.press(x=-0.02, y=0.01, force=2.0, radius=0.01, seconds=0.2, to_x=0.02, to_y=0.01, finger="one")
    slid = [f for _, f in during(host, 0.2)]
    assert all(f.valid and "changing" not in f.reasons for f in slid) and len({f.contacts[0].id for f in slid}) == 1
    late = [(f, f.stamps["sample"] * 1e-9 - began) for f in slid if f.stamps["sample"] * 1e-9 - began > 0.03]
    errors = [off_m(f, -0.02 + 0.2 * t, 0.01) for f, t in late]
    assert np.median(errors) < 1e-3 and max(errors) < 3e-3
    assert np.median([f.contacts[0].velocity[0] for f, _ in late]) == pytest.approx(0.2, rel=0.1)
    assert next(t for t, f in during(host, 0.3) if over(f)) < 0.025


@pytest.mark.parametrize("x, y", [(0.037, -0.044), (-0.0137, 0.0436)])
def test_a_touch_on_an_electrode_is_not_taken_for_its_contact(host: SimulatedHost, x: float, y: float) -> None:
    """The two whole scans after its beginning are of a contact that jumped, by what they show alone. A whole scan
    tells them apart: the first one after the beginning.
    """
    held(host, x, y, radius=0.006)
    frames = during(host, 0.4)
    assert all(f.valid for _, f in frames) and next(t for t, f in frames if f.contacts) < SCAN_S


def test_no_whole_scan_is_made_of_values_from_before_and_after_a_release(host: SimulatedHost) -> None:
    """Of a release within the newest values too: such a scan looks like a contact that jumped, asking takes 20 ms."""
    for k in (0, 7):
        held(host, 0.03, -0.028, radius=0.0075)
        host.until(host.now + 0.3 + 0.0022 * k)
        host.release()
        after = during(host, 0.25)
        assert all(f.valid and "changing" not in f.reasons for _, f in after), k
        assert next(t for t, f in after if over(f)) < 0.02


def test_a_tare_makes_no_contact_and_is_followed_by_touches_again(host: SimulatedHost) -> None:
    """The differences that parts are compared with were to the baseline before."""
    host.until(7.0)
    host.pipeline.pre.command("tare", {"calibrate": False})
    frames = during(host, 0.5)
    assert frames and all(f.valid and not f.contacts for _, f in frames)
    held(host, 0.01, 0.0)
    assert next(t for t, f in during(host, 0.1) if f.valid and f.contacts) < 0.025


# begin and end stay long enough for a reader that takes the newest frame now and then


def test_a_reader_of_30_hz_misses_neither_begin_nor_end(host: SimulatedHost) -> None:
    host.press(x=0.01, y=0.02, force=2.0, radius=0.01, seconds=0.2)
    seen = during(host, 0.6)
    for phase in np.linspace(0, 1 / 30, 5):
        read = [[f for t, f in seen if t <= look][-1:] for look in np.arange(phase, 0.6, 1 / 30)]
        states = {contact.state for frames in read for f in frames for contact in f.contacts}
        assert {"begin", "hold", "end"} <= states
    for state in ("begin", "end"):
        said = [(f.stamps["sample"], contact.id) for _, f in seen for contact in f.contacts if contact.state == state]
        assert 40e6 < said[-1][0] - said[0][0] < 60e6 and len({number for _, number in said}) == 1


def test_begin_and_end_are_repeated_for_50_ms_and_go_with_a_recording() -> None:
    def contact(number: int, state: str) -> Contact:
        return Contact(id=number, state=state, position=[0.0, 0.0, 0.0])

    lasting = LastingStates()
    for contacts, at_ns, expected in (
        ({1: "begin"}, 0, {1: "begin"}),
        ({1: "hold"}, LASTS_NS - 1, {1: "begin"}),
        ({1: "hold"}, LASTS_NS, {1: "hold"}),
        ({1: "end"}, 60 * MS, {1: "end"}),
        ({2: "begin"}, 80 * MS, {1: "end", 2: "begin"}),
        ({2: "hold"}, 111 * MS, {2: "begin"}),
        ({2: "end"}, 140 * MS, {2: "end"}),
        ({2: "hold"}, 145 * MS, {2: "hold"}),  # it is there again: it has not ended
    ):
        twin = LastingStates()
        twin.load(lasting.state())
        made = [each([contact(*c) for c in contacts.items()], at_ns) for each in (lasting, twin)]
        assert [{c.id: c.state for c in found} for found in made] == [expected, expected]


@pytest.mark.release
def test_parts_of_a_calibrated_skin_stand_on_its_calibration() -> None:
    """Mounted wrong, after a tare that calibrates: a slide is followed with every part, as on its bundle's skin."""
    wrong = Mismatch(anisotropy=0.15, angle=0.6, field=0.1, shift=0.06, contact_spread=0.3, seed=2)
    host = SimulatedHost("rolling", 80.0, 3, sheet=Sheet("square16", wrong, mesh="world"))
    host.until(5.0)
    assert host.tare()
    slide = DiscPress(-0.03, -0.02, 7.0, 8.2, ramp=0.05, radius=0.008, to=(0.03, -0.02))
    host.rig.field.play(host.rig.timeline(script(slide), 0.0), host.now)
    host.until(8.3)
    host.close()
    assert len([f for _, f in host.valid(7.1) if 7.35e9 < f.stamps["sample"] < 7.85e9 and f.contacts]) > 90
