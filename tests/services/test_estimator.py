"""The new estimator: raw frames in, contact frames out, of a skin solved by finite elements on a mesh of its own."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench.trust.candidate import Today
from firmware_stub import scene as scenes
from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World, pressed
from firmware_stub.worlds import table
from models.bundle import Bundle
from models.measurement.responses.tables import tables_of
from models.mismatch import Mismatch
from models.rolling import order
from protocol.frames import Contact, ContactFrame, RawFrame
from services.estimation.estimator import Estimator
from services.preprocessing import Preprocessing
from services.runtime.config import Skin

SCAN_S, PARTS, NOISE = 0.0437, 10, 1e-4
FREE_S = 3.5  # untouched before anything happens: a baseline takes 64 scans
Curve = Callable[[np.ndarray], np.ndarray]  # seconds (K,) -> |Z| of each measurement at its own instant


@cache
def bundle() -> Bundle:
    return Bundle.load("square16")


@cache
def sheet() -> Sheet:
    return Sheet("square16", Mismatch(), mesh=table.MESH)


@cache
def impedance(*touches: Touch, background: float = 1.0) -> np.ndarray:
    return np.abs(sheet().model.read(sheet().transfer(World(touches, background=background))))


@cache
def turns() -> np.ndarray:
    return np.asarray(order(bundle().matrices, bundle().pattern, PARTS, bundle().half_width))


def between(*points: tuple[float, np.ndarray]) -> Curve:
    """|Z| that runs straight from point to point: (seconds, (K,) ohm)."""
    times, values = np.array([t for t, _ in points]), np.array([z for _, z in points])

    def at(t: np.ndarray) -> np.ndarray:
        return np.array([np.interp(s, times, values[:, k]) for k, s in enumerate(t)])

    return at


class Board:
    """Sends whole scans, or the newest values after each part of one."""

    def __init__(self, curve: Curve, parts: int, seed: int) -> None:
        self.curve, self.parts, self.rng = curve, parts, np.random.default_rng(seed)

    def frames(self, seconds: float) -> Iterator[RawFrame]:
        part_s = SCAN_S / self.parts
        rows = turns().reshape(self.parts, -1) if self.parts > 1 else np.arange(120)[None]
        z, measured = np.zeros(120), np.full(120, -np.inf)
        for number in range(round(seconds / part_s)):
            own = rows[number % self.parts]
            instants = number * part_s + (np.arange(len(own)) + 0.5) / len(own) * part_s
            whole = np.zeros(120)
            whole[own] = instants
            z[own] = (self.curve(whole) * (1 + NOISE * self.rng.standard_normal(120)))[own]
            measured[own] = instants
            if np.isfinite(measured).all():
                yield self._frame(number, (number + 1) * part_s, part_s, z, measured, own)

    def _frame(
        self, number: int, end_s: float, part_s: float, z: np.ndarray, measured: np.ndarray, own: np.ndarray
    ) -> RawFrame:
        frame = RawFrame(skin="palm", scan=number, z=z.astype(np.complex64), status=np.zeros(120, np.uint8))
        frame.valid, frame.device_us = True, round((end_s - part_s) * 1e6)
        frame.stamps = {"sample": round((end_s - part_s / 2) * 1e9)}
        if self.parts > 1:
            frame.parts, frame.part = self.parts, number % self.parts + 1
            frame.age_us = ((end_s - measured) * 1e6).astype(np.float32)
            frame.new = np.zeros(120, np.uint8)
            frame.new[own] = 1
        return frame


def run(curve: Curve, seconds: float, parts: int = 1, seed: int = 1, tare_s: float = 0.0) -> list[ContactFrame]:
    """All contact frames; times are their stamps."""
    candidate = Today(Skin.model_validate({"port": "stub", "bundle": "square16"}), bundle())
    made = [candidate.step(raw) for raw in Board(curve, parts, seed).frames(seconds)]
    return [frame for frame in made if frame is not None]


def estimator_of(candidate: Today) -> Estimator:
    stage = candidate.stages.pre
    assert isinstance(stage, Preprocessing)
    return stage.estimator


def at_s(frame: ContactFrame) -> float:
    return frame.stamps["sample"] * 1e-9


def between_s(frames: list[ContactFrame], begin: float, end: float) -> list[ContactFrame]:
    return [frame for frame in frames if begin <= at_s(frame) < end]


def far_off(contact: Contact, touch: Touch) -> float:
    return float(np.hypot(contact.on_sheet[0] - touch.x, contact.on_sheet[1] - touch.y))


def lasting(frame: ContactFrame) -> int:
    return sum(contact.state != "end" for contact in frame.contacts)


def press(*touches: Touch, ramp_s: float = 0.1, until_s: float = 60.0, left: float = 0.0) -> Curve:
    """From FREE_S on; `left` of it stays in the foam and fades in 20 s."""
    free, full = impedance(), impedance(*touches)
    rest = free + left * (full - free)
    return between(
        (0, free),
        (FREE_S, free),
        (FREE_S + ramp_s, full),
        (until_s, full),
        (until_s + ramp_s, rest),
        (until_s + 20, free),
    )


def held(curve: Curve) -> list[Contact]:
    """The one contact of each whole scan, from 0.3 s after FREE_S on."""
    shown = between_s(run(curve, FREE_S + 0.8), FREE_S + 0.3, 99)
    assert shown and all(frame.valid and lasting(frame) == 1 for frame in shown)
    return [frame.contacts[0] for frame in shown]


@pytest.mark.parametrize("parts", [1, PARTS])
def test_an_untouched_skin_that_warms_stays_untouched(parts: int) -> None:
    """Half a degree a minute: 1 % of the conductivity in a minute."""
    seconds = 25.0 if parts == 1 else 8.0
    warm = between((0, impedance()), (FREE_S, impedance()), (60, impedance(background=1.01)))
    frames = between_s(run(warm, seconds, parts), FREE_S, 99)
    assert len(frames) > 0.9 * (seconds - FREE_S) / SCAN_S  # a part in which nothing touches makes none
    assert all(frame.valid for frame in frames)
    assert not any(frame.contacts for frame in frames)


@pytest.mark.parametrize("parts", [1, PARTS])
@pytest.mark.parametrize(("radius", "force"), [(5e-3, 0.5), (9e-3, 2.0), (20e-3, 6.0)])
def test_a_press_is_shown_where_it_is_and_as_strong_as_it_is(parts: int, radius: float, force: float) -> None:
    touch = pressed("circle", 0.012, -0.018, radius, force)
    frames = run(press(touch), FREE_S + 1.2, parts)
    assert not any(frame.contacts for frame in between_s(frames, 0, FREE_S))
    shown = between_s(frames, FREE_S + 0.3, 99)
    assert all(frame.valid and lasting(frame) == 1 for frame in shown)
    assert len({frame.contacts[0].id for frame in shown}) == 1
    away = list[float]()
    for frame in shown:
        contact = frame.contacts[0]
        assert contact.position_sigma is not None and contact.force_n and contact.force_sigma_n
        away.append(np.hypot(contact.position[0] - 0.012, contact.position[1] + 0.018) / contact.position_sigma[0])
        assert abs(contact.force_n - force) < 3 * contact.force_sigma_n
        assert contact.force_sigma_n < 0.25 * force
        assert contact.position_sigma[0] < (1e-3 if force > 1 else 2e-3)
    assert np.median(away) < 3 and np.max(away) < 6


@pytest.mark.parametrize(("kind", "radius", "force"), [("L", 5e-3, 2.0), ("L", 6e-3, 3.0)])
def test_the_force_of_a_patch_that_is_no_disc_lies_within_its_sigma(kind: str, radius: float, force: float) -> None:
    """How large a patch is that saturates decides its force, and an outline spreads further than a disc of its area."""
    values = {"shape": kind, "x": 0.012, "y": -0.018, "radius": radius, "force": force, "rotation": 0.4}
    touch = scenes.touch({**values, "aspect": 1.0 if kind == "L" else 2.0})
    for contact in held(press(touch)):
        assert contact.force_n and contact.force_sigma_n
        assert abs(contact.force_n - force) < 3 * contact.force_sigma_n


@pytest.mark.parametrize(("radius", "force"), [(4.5e-3, 2.0), (5e-3, 2.5), (8e-3, 3.0), (15e-3, 5.0)])
def test_the_force_on_foam_of_soft_edges_lies_within_its_sigma(radius: float, force: float) -> None:
    soft = table.sheet("soft-3", 1)
    touch = pressed("circle", 0.012, -0.018, radius, force)
    free, full = (np.abs(soft.model.read(soft.transfer(World(touches)))) for touches in ((), (touch,)))
    for contact in held(between((0, free), (FREE_S, free), (FREE_S + 0.1, full), (60, full))):
        assert contact.force_n and contact.force_sigma_n
        assert abs(contact.force_n - force) < 4 * contact.force_sigma_n


def test_a_touch_keeps_its_number_while_nothing_explains_the_scans() -> None:
    """0.09 s of an error in every measurement, beside a touch that is held: frames say `changing`, and go on."""
    touch = pressed("circle", 0.012, -0.018, 9e-3, 3.0)
    steady, wrong_s = press(touch), FREE_S + 0.6
    off = 1 + 8e-4 * np.random.default_rng(5).standard_normal(120)
    frames = run(lambda t: steady(t) * np.where((t > wrong_s) & (t < wrong_s + 0.09), off, 1.0), FREE_S + 1.2, PARTS)
    shown = [frame for frame in between_s(frames, FREE_S + 0.3, 99) if frame.valid]
    changing = [frame for frame in shown if "changing" in frame.reasons]
    assert at_s(changing[-1]) - at_s(changing[0]) > 0.06
    assert {contact.id for frame in shown for contact in frame.contacts} == {shown[0].contacts[0].id}


def test_a_press_that_begins_at_once_is_shown_within_half_a_scan() -> None:
    touch = pressed("circle", 0.012, -0.018, 9e-3, 3.0)
    frames = run(press(touch, ramp_s=0.005), FREE_S + 0.2, PARTS)
    first = next(frame for frame in frames if lasting(frame))
    assert first.contacts[0].state == "begin"
    assert at_s(first) - FREE_S < SCAN_S / 2


@pytest.mark.parametrize("parts", [1, PARTS])
def test_two_touches_are_two(parts: int) -> None:
    both = pressed("circle", -0.02, 0.01, 8e-3, 1.0), pressed("circle", 0.018, -0.012, 8e-3, 3.0)
    shown = between_s(run(press(*both), FREE_S + 1.0, parts), FREE_S + 0.35, 99)
    assert all(frame.valid and lasting(frame) == 2 for frame in shown)
    assert all(len({contact.id for contact in frame.contacts}) == 2 for frame in shown)


@pytest.mark.parametrize("parts", [1, PARTS])
def test_a_light_touch_that_comes_slowly_beside_a_held_one_is_told_from_its_outline(parts: int) -> None:
    """An outline that is learnt while both press explains both."""
    strong, light = pressed("circle", 0.0117, 0.0142, 7e-3, 2.2), pressed("circle", 0.0097, -0.0144, 10e-3, 0.5)
    free, one, both = impedance(), impedance(strong), impedance(strong, light)
    begins_s = FREE_S + 0.2
    curve = between(
        (0, free), (FREE_S, free), (FREE_S + 0.06, one), (begins_s, one), (begins_s + 0.2, both), (99, both)
    )
    shown = between_s(run(curve, begins_s + 1.0, parts), begins_s + 0.5, 99)
    assert shown and all(frame.valid and lasting(frame) == 2 for frame in shown)
    assert all(min(far_off(contact, touch) for touch in (strong, light)) < 4e-3 for contact in shown[-1].contacts)


@pytest.mark.parametrize("parts", [1, PARTS])
def test_three_touches_that_come_one_after_the_other_within_a_scan_are_three(parts: int) -> None:
    """Two discs explain them roughly, the second where nothing is: they are counted again."""
    three = (
        pressed("circle", 0.0047, 0.0223, 8.3e-3, 2.5),
        pressed("circle", -0.0072, -0.019, 23.1e-3, 0.86),
        pressed("circle", -0.0279, 0.0176, 12e-3, 0.46),
    )
    steps = [impedance(*three[:count]) for count in range(4)]
    ramps_s = ((0.0, 0.025), (0.025, 0.013), (0.048, 0.015))
    points = [(0.0, steps[0])]
    for k, (begins_s, ramp_s) in enumerate(ramps_s):
        points += [(FREE_S + begins_s, steps[k]), (FREE_S + begins_s + ramp_s, steps[k + 1])]
    shown = between_s(run(between(*points, (99, steps[3])), FREE_S + 0.8, parts), FREE_S + 0.4, 99)
    assert shown and all(frame.valid and lasting(frame) == 3 for frame in shown)
    assert all(min(far_off(contact, touch) for touch in three) < 5e-3 for contact in shown[-1].contacts)


@pytest.mark.parametrize("parts", [1, PARTS])
def test_a_slide_keeps_its_id_and_its_place(parts: int) -> None:
    instants = np.linspace(0, 1, 13)
    ways = [pressed("circle", -0.02 + 0.04 * u, 0.005, 8e-3, 2.0) for u in instants]
    begin, lasts = FREE_S + 0.5, 0.4  # 0.1 m/s
    points = [(0.0, impedance()), (FREE_S, impedance()), (FREE_S + 0.05, impedance(ways[0]))]
    points += [(begin + lasts * float(u), impedance(way)) for u, way in zip(instants, ways, strict=True)]
    frames = between_s(run(between(*points), begin + lasts + 0.5, parts), FREE_S + 0.3, 99)
    assert all(frame.valid and lasting(frame) == 1 for frame in frames)
    assert len({frame.contacts[0].id for frame in frames}) == 1
    for frame in frames:
        there = -0.02 + 0.04 * min(max((at_s(frame) - begin) / lasts, 0), 1)
        assert abs(frame.contacts[0].position[0] - there) < 3e-3


@pytest.mark.parametrize("parts", [1, pytest.param(PARTS, marks=pytest.mark.release)])
def test_what_a_touch_leaves_in_the_foam_is_no_touch(parts: int) -> None:
    touch = pressed("circle", 0.012, -0.018, 9e-3, 3.0)
    frames = run(press(touch, until_s=FREE_S + 1.0, left=0.03), FREE_S + 3.5, parts)
    gone = between_s(frames, FREE_S + 1.4, 99)
    assert all(frame.valid for frame in gone)
    assert not any(lasting(frame) for frame in gone)


def test_where_a_touch_stayed_before_it_slid_the_foam_remembers_it() -> None:
    """It stays for 2 s, slides 25 mm away in 0.5 s and goes: 3 % stay where it was, and 1 % where it went."""
    instants = np.linspace(0, 1, 9)
    ways = [pressed("circle", -0.006 - 0.025 * u, 0.01, 9e-3, 3.0) for u in instants]
    free, begin = impedance(), FREE_S + 2.0
    points = [(0.0, free), (FREE_S, free), (FREE_S + 0.05, impedance(ways[0]))]
    points += [(begin + 0.5 * float(u), impedance(way)) for u, way in zip(instants, ways, strict=True)]
    rest = free + 0.03 * (impedance(ways[0]) - free) + 0.01 * (impedance(ways[-1]) - free)
    points += [(begin + 0.9, impedance(ways[-1])), (begin + 1.0, rest), (begin + 20.0, free)]
    gone = between_s(run(between(*points), begin + 2.0), begin + 1.2, 99)
    assert all(frame.valid for frame in gone)
    assert not any(lasting(frame) for frame in gone)


def test_what_something_unknown_leaves_in_the_foam_is_no_touch() -> None:
    """For 1.5 s every measurement is wrong in a way that no touch is; of what pressed meanwhile 3 % stay."""
    rng = np.random.default_rng(3)
    free, full = impedance(), impedance(pressed("circle", 0.012, -0.018, 9e-3, 3.0))
    begin = FREE_S + 1.5

    def curve(t: np.ndarray) -> np.ndarray:
        if t.max() < FREE_S:
            return free
        if t.max() < begin:
            return np.asarray(full * (1 + 0.02 * rng.standard_normal(120)))
        return np.asarray(free + 0.03 * np.exp(-(t.max() - begin) / 5) * (full - free))

    frames = run(curve, begin + 1.5)
    wrong = between_s(frames, FREE_S + 0.3, begin)
    assert not any(frame.valid for frame in wrong)
    gone = between_s(frames, begin + 0.2, 99)
    assert all(frame.valid for frame in gone)
    assert not any(lasting(frame) for frame in gone)


def test_a_touch_that_ends_says_so_for_fifty_milliseconds_and_is_gone() -> None:
    touch = pressed("circle", 0.012, -0.018, 9e-3, 3.0)
    frames = run(press(touch, ramp_s=0.02, until_s=FREE_S + 0.6), FREE_S + 1.5, PARTS)
    ended = [at_s(frame) for frame in frames if any(contact.state == "end" for contact in frame.contacts)]
    assert ended and FREE_S + 0.6 < ended[0] < FREE_S + 0.66
    assert 0.03 < ended[-1] - ended[0] < 0.06
    assert not any(frame.contacts for frame in between_s(frames, ended[-1] + 0.01, 99))


@pytest.mark.release
@pytest.mark.parametrize("refused_s", [4.0, 20.0])
def test_after_refused_frames_the_skin_is_valid_again_within_two_seconds(refused_s: float) -> None:
    """Noise that no model has, and meanwhile the sheet has come to conduct 1 % better."""
    rng = np.random.default_rng(9)
    free, after = impedance(), impedance(background=1.01)

    def curve(t: np.ndarray) -> np.ndarray:
        if t.max() < FREE_S:
            return free
        return np.asarray(free * (1 + 0.1 * rng.standard_normal(120)) if t.max() < FREE_S + refused_s else after)

    frames = run(curve, FREE_S + refused_s + 4)
    wrong = between_s(frames, FREE_S + 0.5, FREE_S + refused_s)
    assert sum(frame.valid for frame in wrong) < 0.02 * len(wrong)
    well = between_s(frames, FREE_S + refused_s + 2, 99)
    assert all(frame.valid for frame in well)
    assert not any(frame.contacts for frame in well)


def test_without_a_baseline_nothing_is_valid() -> None:
    frames = between_s(run(press(), 2.0), 0, 2)
    assert frames and not any(frame.valid for frame in frames)
    assert all("stale_baseline" in frame.reasons for frame in frames)


def test_measurements_that_the_board_marks_are_left_out() -> None:
    touch = pressed("circle", 0.012, -0.018, 9e-3, 2.0)
    candidate = Today(Skin.model_validate({"port": "stub", "bundle": "square16"}), bundle())
    shown = []
    for raw in Board(press(touch), 1, 1).frames(FREE_S + 1.0):
        if raw.stamps["sample"] > FREE_S * 1e9:
            raw.status[[3, 40]] = 1
            raw.z[[3, 40]] = np.nan
        frame = candidate.step(raw)
        if frame is not None and at_s(frame) > FREE_S + 0.3:
            shown.append(frame)
    assert all(frame.valid and lasting(frame) == 1 for frame in shown)
    assert all(np.hypot(f.contacts[0].position[0] - 0.012, f.contacts[0].position[1] + 0.018) < 2e-3 for f in shown)


def test_other_tables_of_the_same_skin_change_nothing_of_what_is_expected_untouched() -> None:
    """As a calibration of the mounting gives them, while the sheet warms: then a touch is shown as it is."""
    warm_s, until_s = FREE_S + 1.0, FREE_S + 2.0
    touch = pressed("circle", 0.01, -0.01, 0.01, 2.0)
    warm, full = impedance(background=1.002), impedance(touch, background=1.002)
    curve = between((0, impedance()), (FREE_S, impedance()), (warm_s, warm), (until_s, warm), (until_s + 0.1, full))
    candidate = Today(Skin.model_validate({"port": "stub", "bundle": "square16"}), bundle())
    tables = tables_of(bundle())
    row = np.exp(0.02 * np.random.default_rng(3).standard_normal(120))
    frames = []
    for raw in Board(curve, 1, 1).frames(until_s + 1.0):
        if 0 <= raw.stamps["sample"] * 1e-9 - warm_s < SCAN_S:
            estimator = estimator_of(candidate)
            assert not estimator.touched
            estimator.use(replace(tables, z0=tables.z0 * row))
        if (frame := candidate.step(raw)) is not None:
            frames.append(frame)
    free = between_s(frames, FREE_S, until_s - SCAN_S)
    assert all(frame.valid and not lasting(frame) for frame in free)
    shown = between_s(frames, until_s + 0.3, 99)
    assert shown and all(frame.valid and lasting(frame) == 1 for frame in shown)
    assert all(np.hypot(*np.subtract(frame.contacts[0].position[:2], (0.01, -0.01))) < 2e-3 for frame in shown)
