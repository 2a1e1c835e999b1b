"""Bytes in, contact frames out, after a time in which nothing was measured, and of parts that a relay mixed."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from protocol import link
from protocol.frames import ImageFrame, PartFrame, pack, unpack
from services.runtime.config import ScanMode
from simulation.host import LATE_S, SimulatedHost, tared
from simulation.scenes import DiscPress, script
from simulation.truth import FAR_M, SCAN_S, lasting

PART_S = SCAN_S / 10
HELD = -0.03, 0.03
TOUCHED_S, GAP_S, OVER_S = 6.1, 6.6, 60.0
BOTH = pytest.mark.parametrize("scan", ["full", "rolling"])


def host_of(scan: ScanMode, seed: int, *presses: DiscPress) -> SimulatedHost:
    host = tared(scan, seed=seed % 3, halting=True, late_s=LATE_S)
    host.rig.field.play(host.rig.timeline(script(*presses), 0.0), host.now)
    return host


def right(host: SimulatedHost, since: float = GAP_S) -> SimulatedHost:
    host.close()
    wrong = host.wrong(since)
    assert not wrong, "\n".join(map(str, wrong[:5]))
    return host


def elsewhere(rng: np.random.Generator) -> tuple[float, float]:
    x, y = HELD
    while np.hypot(x - HELD[0], y - HELD[1]) < 0.03:
        x, y = rng.uniform(-0.034, 0.034, 2).tolist()
    return x, y


def presses(what: str, start: float, end: float, rng: np.random.Generator) -> list[DiscPress]:
    """A touch that is held, and what becomes of it in a gap."""
    changed, place = start + rng.uniform(0.1, 0.8) * (end - start), elsewhere(rng)
    gone, stays = DiscPress(*HELD, TOUCHED_S, changed), DiscPress(*HELD, TOUCHED_S, OVER_S)
    return {
        "elsewhere": [gone, DiscPress(*place, changed, OVER_S)],
        "beside": [stays, DiscPress(*place, changed, OVER_S)],
        "released": [gone],
        "begins": [DiscPress(*place, changed, OVER_S)],
        "held": [stays],
    }[what]


def after_a_gap(scan: ScanMode, how: str, seconds: float, what: str, seed: int) -> SimulatedHost:
    """A gap at any phase of a scan; half a second more, or longer where the board is to be found again."""
    rng = np.random.default_rng([seed, round(1e4 * seconds)])
    start = GAP_S + SCAN_S * float(rng.random())
    host = host_of(scan, seed, *presses(what, start, start + seconds, rng))
    host.outage(start, seconds, how)
    again = 1.2 if how == "unplug" or (how == "hang" and seconds > 0.5) else 0.0
    host.until(start + seconds + 0.5 + again)
    assert host.valid(start + seconds)
    return right(host, start)


@pytest.mark.many
@pytest.mark.parametrize(("how", "seconds", "what"), [
    ("lost", 0.3, "elsewhere"),
    ("hang", 0.8, "beside"),
    ("unplug", 0.3, "released"),
    ("Preprocessing", 0.1, "elsewhere"),
    ("Inference", 0.5, "begins"),
    ("Publishing", 0.8, "elsewhere"),
])  # fmt: skip
@BOTH
def test_nothing_is_hidden_behind_a_gap(scan: ScanMode, how: str, seconds: float, what: str) -> None:
    after_a_gap(scan, how, seconds, what, seed=1)


@pytest.mark.parametrize("seconds", [2 * PART_S, 0.8])
@BOTH
def test_a_touch_that_is_held_over_a_gap_is_valid_again_with_its_first_scan(scan: ScanMode, seconds: float) -> None:
    """And in parts it is followed at the full rate soon after."""
    host = after_a_gap(scan, "lost", seconds, "held", seed=4)
    whole = [f for _, f in host.contacts if f.stamps["sample"] * 1e-9 > GAP_S + SCAN_S + seconds]
    assert all(f.valid for f in whole) and {c.id for f in whole for c in f.contacts} == {1}
    assert scan == "full" or len(host.valid(host.now - 0.3)) / 0.3 > 200


@BOTH
def test_single_lost_scans_make_no_frame_of_a_held_touch_invalid(scan: ScanMode) -> None:
    host = host_of(scan, 6, DiscPress(*HELD, TOUCHED_S, OVER_S))
    host.until(GAP_S)
    host.rig.fault("sequence_gaps", {"fraction": 0.2 if scan == "full" else 0.02}, GAP_S, 5.0)
    host.until(GAP_S + 1.5)
    frames = [frame for at, frame in right(host).contacts if at > GAP_S]
    assert any("gap" in frame.reasons for frame in frames) and all(frame.valid for frame in frames)


def shows_alone(host: SimulatedHost, press: DiscPress) -> None:
    (contact,) = lasting(host.contacts[-1][1])
    assert host.contacts[-1][1].valid
    assert np.hypot(contact.position[0] - press.x, contact.position[1] - press.y) < FAR_M


@pytest.mark.many
@pytest.mark.parametrize("lag", [0.0, 0.02])
@BOTH
def test_touches_that_change_places_without_a_gap_are_not_hidden(scan: ScanMode, lag: float) -> None:
    rng = np.random.default_rng([1, round(1e3 * lag)])
    swap = GAP_S + SCAN_S * float(rng.random())
    force, radius = float(rng.uniform(1.0, 4.0)), float(rng.uniform(0.006, 0.011))
    began = DiscPress(*elsewhere(rng), swap + lag, OVER_S, force, radius=radius)
    host = host_of(scan, 1, DiscPress(*HELD, TOUCHED_S, swap), began)
    host.until(swap + 0.3)
    shows_alone(right(host), began)


# parts that a relay between board and host sends late, twice, in another order, under another number or configuration

Relay = Callable[[link.ScanFrame, list[link.ScanFrame], np.random.Generator], list[link.ScanFrame]]


def late(scan, before, rng):
    """Every third part comes two parts late."""
    if scan.seq % 3 == 0:
        return []
    return [scan, before[-2]] if scan.seq % 3 == 2 and len(before) > 1 else [scan]


def of_an_earlier_scan(scan, before, rng):
    """Some parts are those of a second ago, under their own numbers or under the present one."""
    old = before[-230] if len(before) > 230 and rng.random() < 0.2 else scan
    return [replace(old, seq=scan.seq) if rng.random() < 0.5 else old]


def of_another_configuration(scan, before, rng):
    other = replace(scan, config=scan.config ^ 1, z=scan.z * 2, part=(scan.part + 5) % 10)
    return [other, scan] if rng.random() < 0.3 else [scan]


RELAYS: dict[str, Relay] = {
    "late": late,
    "twice": lambda scan, before, rng: [scan, scan],
    "swapped": lambda scan, before, rng: [scan, before[-1]] if scan.seq % 2 else [],
    "of an earlier scan": of_an_earlier_scan,
    "wrong number": lambda s, before, rng: [replace(s, seq=s.seq + int(rng.integers(-12, 13) * (rng.random() < 0.1)))],
    "wrong part": lambda s, before, rng: [replace(s, part=int(rng.integers(0, 10)) if rng.random() < 0.1 else s.part)],
    "of another configuration": of_another_configuration,
}


@pytest.mark.many
@pytest.mark.parametrize("relay", RELAYS)
def test_no_frame_of_a_mixture_of_parts_is_valid(relay: str) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.034, -0.01, 2).tolist()
    host = host_of("rolling", 1, DiscPress(x, y, 6.05, 7.35), DiscPress(-x, -y, 7.5, OVER_S))
    pull, decoder, before = host.rig.pull, link.Decoder(), []

    def relayed(now: float) -> bytes:
        sent = b""
        for message in decoder.feed(pull(now)):
            scan = isinstance(message, link.ScanFrame)
            for each in RELAYS[relay](message, before, rng) if scan and now > GAP_S else [message]:
                sent += link.encode(each)
            before.extend([message] if scan else [])
        return sent

    host.rig.pull = relayed  # type: ignore[method-assign]
    host.until(7.9)
    frames = [frame for at, frame in right(host).contacts if at > GAP_S]
    if relay in ("twice", "of another configuration"):
        assert sum(frame.valid for frame in frames) > 0.9 * len(frames) > 30


# a part is judged by its own estimate

REFUSED = ("stale_baseline", "saturated", "gain", "electrode_drift", "electrode_open", "frozen", "clock", "non_finite")


def test_what_preprocessing_refused_of_a_part_shows_no_contact_as_valid() -> None:
    """And says why. Of an image that was refused or late a part may be valid still: it has an estimate of its own."""
    host, seen = host_of("rolling", 3, DiscPress(0.02, -0.01, TOUCHED_S, OVER_S)), list[ImageFrame | PartFrame]()
    stage = host.pipeline.publishing
    process = stage.process
    stage.process = lambda frame, wanted: seen.append(frame) or process(frame, wanted)  # type: ignore[assignment, func-returns-value]
    host.until(6.5)
    host.close()
    image = [frame for frame in seen if isinstance(frame, ImageFrame) and frame.estimates and frame.valid][-1]
    part = [frame for frame in seen if isinstance(frame, PartFrame) and frame.estimates][-1]
    ok, none = (True, list[str]()), list[str]()
    cases = [(of_image, (False, [r])) for r in (*REFUSED, "out_of_distribution") for of_image in (ok, (False, [r]))]
    cases += [((valid, reasons), ok) for valid, reasons in ((True, none), (False, ["late"]), (False, ["saturated"]))]
    for k, said in enumerate(cases):
        for n, (frame, (valid, reasons)) in enumerate(zip((image, part), said, strict=True)):
            copy = unpack(pack(frame))
            copy.valid, copy.reasons, copy.scan = valid, list(reasons), image.scan + 10 + 2 * k + n
            copy.stamps["sample"] = image.stamps["sample"] + round(PART_S * 1e9) * (10 + 2 * k + n)
            (contact,) = process(copy, frozenset({"contact"}))
            assert contact.valid == valid and set(reasons) <= set(contact.reasons)
            assert n == 0 or not (valid and set(said[0][1]) & set(contact.reasons))
            if n and valid:
                assert lasting(contact)[0].position[:2] == pytest.approx([0.02, -0.01], abs=2e-3)
