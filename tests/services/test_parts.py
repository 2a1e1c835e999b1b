"""Scans in parts: what is handed on, touches followed from part to part, changes within a scan, how many parts."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from firmware_stub.sheet import Sheet
from models.mismatch import Mismatch
from models.shapes import Shape
from protocol import link
from protocol.frames import Contact, RawFrame, StatusFrame, pack, unpack
from services.board.boardlink import BoardLink
from services.board.newest_values import NewestValues
from services.board.parts_or_whole import MOST_WAIT_S, PartsOrWhole
from services.board.remarks import WHOLE, Remarks
from services.contacts.lasting import LASTS_NS, LastingStates
from services.runtime.stage import Health
from simulation.host import SimulatedHost, tared
from simulation.scenes import DiscPress, script
from simulation.truth import SCAN_S, lasting
from tests.services.stub_skin import METRES, StubSkin, present, transfer

PART_HZ = 229
MS = 1_000_000


@pytest.fixture
def host():
    """After six seconds untouched."""
    made = tared("rolling", keep=True)
    yield made
    made.close()


def during(host, seconds):
    """What comes meanwhile, and how long after its beginning."""
    began, first = host.now, len(host.contacts)
    host.until(began + seconds)
    return [(at - began, frame) for at, frame in host.contacts[first:]]


def held(host, x, y, force=2.0, radius=0.01):
    host.press(x=x, y=y, force=force, radius=radius, seconds=60.0, finger="one")


def over(frame):
    """Whether it says that nothing presses any more."""
    return frame.valid and not lasting(frame)


def off_m(frame, x, y):
    (contact,) = frame.contacts
    return float(np.hypot(contact.position[0] - x, contact.position[1] - y))


# what acquisition hands on


def part(seq, of=5, n=2, value=1.0, config=1):
    z = np.full(n, value, np.complex64)
    return link.ScanFrame(seq, 1000 * seq, 900, config, z, np.zeros(n, "u1"), seq % of, of)


HEADER = RawFrame(skin="palm", z=np.zeros(2, "c8"), status=np.zeros(2, "u1"))


def test_the_newest_values_have_their_places_their_ages_and_say_which_are_new():
    order = np.array([3, 0, 9, 4, 1, 2, 5, 6, 8, 7])
    newest = NewestValues(order)
    assert [newest.take(part(seq, value=seq)) for seq in range(6)] == [False] * 4 + [True, True]
    frame = unpack(pack(newest.frame(HEADER, part(5, value=5))))
    assert (frame.part, frame.parts, frame.reasons) == (1, 5, []) and np.flatnonzero(frame.new).tolist() == [0, 3]
    assert frame.z.real[order].tolist() == np.repeat([5, 1, 2, 3, 4], 2).tolist()
    assert frame.age_us[[3, 0, 9, 4]] == pytest.approx([675, 225, 4675, 4225])
    whole = replace(part(6, 1, 10), z=order.astype("c8"))
    frame = newest.take(whole) and newest.frame(HEADER, whole)
    assert frame.z.real.tolist() == [*range(10)] and (-frame.age_us).argsort().tolist() == order.tolist()


def test_after_a_gap_nothing_from_before_it_is_handed_on():
    newest = NewestValues(np.arange(10))
    assert [newest.take(part(seq)) for seq in (0, 1, 2, 3, 4, 6, 7, 8, 9)] == [False] * 4 + [True] + [False] * 4
    for seq, reasons in ((10, ["gap"]), (11, [])):
        assert newest.take(part(seq)) and newest.frame(HEADER, part(seq)).reasons == reasons


def test_a_board_sends_parts_and_whole_scans_are_made_of_them(host):
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


def test_a_board_that_knows_no_parts_scans_whole_and_status_says_so():
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.rig.board.knows_parts = False
    host.until(4.0)
    assert host.link.scanning.parts == 1 and host.contacts[-1][1].valid and host.contacts[-1][1].part == 0
    (remarks := Remarks()).look(host.link, host.now)
    assert WHOLE in remarks.added_to(Health()).messages
    host.close()


def test_frames_of_another_cut_are_foreign(host):
    scanning, cut = host.source.scanning, host.source.scanning.config
    assert scanning.sent(part(0, of=10, n=12, config=cut)) and not BoardLink(scanning, 0.0).knows_no_parts
    assert not any(scanning.sent(part(0, of=of, n=n, config=cut)) for of, n in ((5, 24), (10, 11), (1, 120)))
    assert scanning.whole.sent(part(0, of=1, n=120, config=scanning.whole.config)) and scanning.whole.config != cut


# touches


def test_a_touch_reaches_a_controller_within_three_parts_and_so_does_its_end(host):
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


def test_contacts_of_a_held_and_then_sliding_touch_come_at_the_part_rate(host):
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
def test_a_touch_on_an_electrode_is_not_taken_for_its_contact(host, x, y):
    """By what they show alone two whole scans after its beginning are of a contact that jumped; the first tells."""
    held(host, x, y, radius=0.006)
    frames = during(host, 0.4)
    assert all(f.valid for _, f in frames) and next(t for t, f in frames if f.contacts) < SCAN_S


def test_no_whole_scan_is_made_of_values_from_before_and_after_a_release(host):
    """Of a release within the newest values too: such a scan looks like a contact that jumped, asking takes 20 ms."""
    for k in (0, 7):
        held(host, 0.03, -0.028, radius=0.0075)
        host.until(host.now + 0.3 + 0.0022 * k)
        host.release()
        after = during(host, 0.25)
        assert all(f.valid and "changing" not in f.reasons for _, f in after), k
        assert next(t for t, f in after if over(f)) < 0.02


def test_a_tare_makes_no_contact_and_is_followed_by_touches_again(host):
    """The differences that parts are compared with were to the baseline before."""
    host.until(7.0)
    host.pipeline.pre.command("tare", {"calibrate": False})
    frames = during(host, 0.5)
    assert frames and all(f.valid and not f.contacts for _, f in frames)
    held(host, 0.01, 0.0)
    assert next(t for t, f in during(host, 0.1) if f.valid and f.contacts) < 0.025


def test_a_reader_of_30_hz_misses_neither_begin_nor_end(host):
    host.press(x=0.01, y=0.02, force=2.0, radius=0.01, seconds=0.2)
    seen = during(host, 0.6)
    for phase in np.linspace(0, 1 / 30, 5):
        read = [[f for t, f in seen if t <= look][-1:] for look in np.arange(phase, 0.6, 1 / 30)]
        states = {contact.state for frames in read for f in frames for contact in f.contacts}
        assert {"begin", "hold", "end"} <= states
    for state in ("begin", "end"):
        said = [(f.stamps["sample"], contact.id) for _, f in seen for contact in f.contacts if contact.state == state]
        assert 40e6 < said[-1][0] - said[0][0] < 60e6 and len({number for _, number in said}) == 1


def test_begin_and_end_are_repeated_for_50_ms_and_go_with_a_recording():
    def contact(number, state):
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
def test_parts_of_a_calibrated_skin_stand_on_its_calibration():
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


PLACES = (0.8, 0.4, 0.25, 0.22), (-0.6, -0.5, 0.2, 0.4), (0.1, 0.25, 0.12, 0.3)
TOUCHES = [Shape("circle", *place) for place in PLACES]
RAMP = (0.0, 0.35, 0.79, 1.0)  # share of the force at the ends of the scans that a ramp of 0.1 s is in


def levels(touch, shares):
    return [transfer((replace(touch, drop=share * touch.drop),) if share else ()) for share in shares]


@pytest.fixture
def skin():
    return StubSkin()


@pytest.mark.parametrize("touch", TOUCHES)
def test_a_touch_that_comes_and_goes_is_where_it_is_or_says_changing(skin, touch):
    skin.rest(3)
    up = levels(touch, RAMP)
    begin = [skin.see(*scan) for scan in pairwise(up)]
    held = [skin.see(up[-1]) for _ in range(8)]
    end = [skin.see(*scan) for scan in pairwise(reversed(up))]
    free = [skin.see(up[0]) for _ in range(6)]
    every = [*begin, *held, *end, *free]
    # Two frames in a row may be explained by a change: of an end in three scans the last may be refused.
    assert all(r.contact.valid for r in [*begin, *held, *end[:-1], *free]), [r.contact.reasons for r in every]
    assert not says_changing(held) and not says_changing(free)
    assert says_changing(begin) <= 3 and says_changing(end) <= 2
    whole_n = held[-1].contact.contacts[0].force_n
    middles = [(a + b) / 2 for a, b in pairwise((*RAMP, *[1.0] * 8, *reversed(RAMP[:-1]), *[0.0] * 6))]
    for result, share in zip(every, middles, strict=True):
        rough = "changing" in result.contact.reasons
        for contact in result.contact.contacts:
            off = np.hypot(*(np.array(contact.position[:2]) - METRES * np.array([touch.x, touch.y])))
            assert off < (0.015 if rough else 0.003)
            if not rough and contact.state != "end":  # how strongly it pressed in the middle of the scan
                assert contact.force_n == pytest.approx(share * whole_n, rel=0.15, abs=0.02 * whole_n)
    assert all(len(present(r)) == 1 for r in held) and not present(free[-1])
    # Where it presses in any part of the scan, its contact is there, or the frame says why not, or is not valid.
    assert not any(hides(r) for r in [*begin, *end]), [r.contact.reasons for r in [*begin, *end]]


def hides(result):
    """Whether a person would take the frame for one in which nothing touches."""
    return result.contact.valid and not present(result) and "changing" not in result.contact.reasons


@pytest.mark.parametrize("touch", TOUCHES)
@pytest.mark.parametrize("shares", [(1.0, 0.93, 0.5, 0.06), (1.0, 0.3, 0.0)])
def test_no_frame_hides_a_touch_that_goes_while_it_is_scanned(skin, touch, shares):
    skin.rest(3)
    down = levels(touch, shares)
    for _ in range(6):
        skin.see(down[0])
    going = [skin.see(*scan) for scan in pairwise(down)]
    free = [skin.see(levels(touch, (0.0,))[0]) for _ in range(6)]
    assert [hides(r) for r in going[:-1]] == [False] * (len(going) - 1), [r.contact.reasons for r in going]
    assert not hides(going[-1]) or shares[-2] < 0.2  # what is left of a faint touch may be too little to be seen
    assert says_changing(going) <= 2 and all(r.contact.valid and not present(r) for r in free[2:])


def says_changing(results):
    return sum("changing" in r.contact.reasons for r in results)


class Machine:
    """Skins of which so many fit in parts; each skin of too many loses its share."""

    def __init__(self, skins, fit):
        self.names = [f"skin{n}" for n in range(skins)]
        self.choice, self.fit = PartsOrWhole(self.names), fit
        self.now, self.behind, self.session, self.changes = 0.0, dict.fromkeys(self.names, 0.0), "a", 0

    def run(self, seconds):
        """How many scan in parts, each second."""
        found = []
        for _ in range(int(seconds)):
            self.now += 1.0
            before = [name for name in self.names if not self.choice.whole(name)]
            for name in before:  # where touches begin, some are behind
                self.behind[name] += 229.0 * (0.1 if len(before) <= self.fit else 0.7)
            for name, behind in self.behind.items():
                said = {"process": "preprocessing", "session": self.session, "drops": {"skipped": int(behind)}}
                self.choice.update(StatusFrame(skin=name, **said), self.now)
            found.append(sum(not self.choice.whole(name) for name in self.names))
            self.changes += found[-1] != len(before)
        return found


def test_as_many_stay_as_fit_attempts_grow_rare_and_they_come_back_when_the_load_is_gone():
    assert (all_fit := Machine(4, fit=4.0)).run(60.0) == [4] * 60 and all_fit.changes == 0
    machine = Machine(16, fit=5.5)
    first = machine.run(20.0)
    assert first[-1] <= 5 and min(first) >= 1  # within seconds
    machine.run(3600.0)
    before, hour = machine.changes, machine.run(3600.0)
    assert max(hour) <= 6 and machine.changes - before <= 4 * 3600 / MOST_WAIT_S + 8
    assert np.mean([count <= 5 for count in hour]) > 0.97
    machine = Machine(8, fit=2.0)
    assert machine.run(120.0)[-1] <= 2
    machine.fit = 8.0
    assert machine.run(3 * MOST_WAIT_S + 1)[-1] == 8


def test_parts_that_come_no_sooner_than_whole_scans_are_given_up():
    choice = PartsOrWhole(["palm"])
    for second, p50 in enumerate((5.0, 30.0, 8.0, 30.0, 31.0, 30.0)):
        choice.update(StatusFrame(skin="palm", process="preprocessing", session="a", latency={"p50": p50}), second)
        choice.update(StatusFrame(skin="other", process="preprocessing", drops={"skipped": 200 * second}), second)
        assert choice.whole("palm") == (second >= 4) and not choice.whole("other"), "one slow second is none"


@pytest.mark.parametrize("touched", [False, True])
def test_a_board_goes_from_parts_to_whole_scans_and_back(touched):
    host = SimulatedHost("rolling", snr_db=80.0, seed=7, keep=True)
    host.until(4.0)
    if touched:
        host.press(x=0.02, y=-0.01, force=2.0, radius=0.01, seconds=60.0)
    host.until(5.0)
    baseline = host.pipeline.pre.baseline
    for scanning, part in ((host.source.scanning.whole, 0), (host.source.scanning, 10)):
        since, asked = len(host.contacts), host.now
        host.link.scan_as(scanning, host.now)
        host.newest = host.source.newest()
        host.until(host.now + 2.0)
        seen = host.contacts[since:]
        good = [t for t, frame in seen if frame.valid and len(frame.contacts) == touched]
        assert good[-1] > host.now - 0.06 and good[0] < asked + 0.25 and np.diff(good).max() < 0.15
        assert sum(len(frame.contacts) != touched for _, frame in seen if frame.valid) == 0
        assert len({contact.id for _, frame in seen for contact in frame.contacts}) == touched
        assert {raw.part for raw in host.raws[-20:]} == ({*range(1, 11)} if part else {0})
        assert {frame.part > 0 for _, frame in seen[len(seen) // 2 :]} == {part > 0}
    assert host.pipeline.pre.baseline is baseline
    host.rig.close()
