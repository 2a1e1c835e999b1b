"""Tracking: ids through crossings, merged patches, lost frames and holds; velocities; state."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest

from services.contacts.merging import MERGED_S
from services.contacts.motion import Motion, Patch, Track
from services.contacts.tracking import FORGOTTEN_S, LOST_FRAMES, Tracker

FRAME_NS = 45_000_000
RADIUS = 0.009  # m, of the touches in here
SIZE = 1e-4  # integrated drop of one


def touch(x: float, y: float = 0.0, size: float = SIZE) -> Patch:
    return Patch(x, y, size, RADIUS)


def image_of(places: list[tuple[float, float]], sizes: list[float]) -> list[Patch]:
    """What a segmentation sees of two discs: one patch while they overlap by more than half."""
    (ax, ay), (bx, by) = places
    apart = math.hypot(ax - bx, ay - by)
    if apart > 1.5 * RADIUS:
        return [touch(*place, size) for place, size in zip(places, sizes, strict=True)]
    total = sum(sizes)
    x, y = ((sizes[0] * a + sizes[1] * b) / total for a, b in zip(*places, strict=True))
    return [Patch(x, y, total, RADIUS + apart / 2)]


def play(tracker: Tracker, frames: list[list[Patch]], start: int = 1) -> tuple[list[list[int]], list[int]]:
    """Ids of each frame's confirmed entries, and of what ended, in order."""
    ids, ended = [], []
    for n, seen in enumerate(frames, start):
        tracks, gone = tracker.update(seen, n * FRAME_NS)
        ids.append([t.id for t in tracks if t is not None])
        ended += [t.id for t in gone]
    return ids, ended


def test_ids_follow_slides_past_each_other_in_any_order() -> None:
    tracker, ids = Tracker(), []
    tracker.update([touch(-0.031, 0.004), touch(0.031, -0.004)], -FRAME_NS)
    for n in range(60):
        x = -0.03 + 0.001 * n
        places = [touch(x, 0.004), touch(-x, -0.004)]
        order = places if n % 2 else places[::-1]
        tracks, _ = tracker.update(order, n * FRAME_NS)
        by_place = dict(zip(order, [t and t.id for t in tracks], strict=True))
        ids.append((by_place[places[0]], by_place[places[1]]))
    assert len(set(ids)) == 1


@pytest.mark.parametrize("degrees", [35, 60, 90, 135, 180])
@pytest.mark.parametrize("speed", [0.02, 0.06])
def test_ids_come_out_of_a_crossing_on_the_other_side(degrees: float, speed: float) -> None:
    """Two equal touches slide through each other and are one patch meanwhile: only their momentum tells them apart."""
    rng = np.random.default_rng(int(degrees))
    directions = [(1.0, 0.0), (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))]
    seconds = np.arange(-0.035 / speed, 0.035 / speed, 0.045)
    frames = []
    for t in seconds:
        noise = 0.0004 * rng.standard_normal((2, 2))
        places = [(speed * t * c + e[0], speed * t * s + e[1]) for (c, s), e in zip(directions, noise, strict=True)]
        frames.append(image_of(places, [SIZE, SIZE]))
    ids, ended = play(Tracker(), frames)
    assert ids[1] == ids[-1] == [1, 2] and not ended
    merged = [i for i in ids[1:] if len(i) == 1]
    assert merged and {i for one in merged for i in one} <= {1, 2}


def test_sizes_tell_two_touches_apart_that_turn_back() -> None:
    """They meet, stand, and go back where they came from: what their momentum says is wrong, their sizes are right."""
    gaps = [*np.linspace(0.03, 0.006, 16), *[0.006] * 6, *np.linspace(0.006, 0.03, 16)]
    frames = [image_of([(-gap / 2, 0), (gap / 2, 0)], [SIZE, 4 * SIZE]) for gap in gaps]
    ids, ended = play(Tracker(), frames)
    assert ids[1] == ids[-1] == [2, 1] and not ended


def test_three_touches_in_one_patch_come_out_with_their_ids() -> None:
    def at(spread: float) -> list[Patch]:
        places = [(spread * math.cos(a), spread * math.sin(a)) for a in (0.0, 2.1, 4.2)]
        if spread > 0.012:
            return [touch(x, y) for x, y in places]
        if spread > 0.008:  # the last two are one patch
            x, y = (places[1][0] + places[2][0]) / 2, (places[1][1] + places[2][1]) / 2
            return [touch(*places[0]), Patch(x, y, 2 * SIZE, RADIUS + spread)]
        return [Patch(0, 0, 3 * SIZE, RADIUS + spread)]

    way_in = np.linspace(0.024, 0.004, 20)
    frames = [at(float(s)) for s in way_in]
    tracker = Tracker()
    ids, _ = play(tracker, frames)
    assert len(ids[-1]) == 1
    for track in tracker.tracks:
        for one in track.inside:
            one.vx = one.vy = 0.0  # they stand: then they come out where they went in
    back, ended = play(tracker, frames[::-1], 21)
    assert back[-1] == ids[1] == [1, 2, 3] and not ended


def test_a_touch_inside_another_ones_patch_is_waited_for_only_so_long() -> None:
    tracker = Tracker()
    together = [Patch(0.0, 0.0, 2 * SIZE, 1.5 * RADIUS)]
    play(tracker, [[touch(-0.008), touch(0.008)], [touch(-0.007), touch(0.007)], together])
    ended = []
    for n in range(4, 4 + math.ceil(2 * MERGED_S / 0.045)):
        tracks, gone = tracker.update(together, n * FRAME_NS)
        ended += [(n, t.id) for t in gone]
    assert [i for _, i in ended] == [{1: 2, 2: 1}[tracks[0].id]]
    assert ended[0][0] * 0.045 == pytest.approx(MERGED_S, abs=0.2)


def test_what_is_inside_ends_with_its_patch() -> None:
    tracker = Tracker()
    _, ended = play(
        tracker, [[touch(-0.007), touch(0.007)]] * 2 + [[Patch(0, 0, 2 * SIZE, 0.015)], *[[]] * (LOST_FRAMES + 1)]
    )
    assert sorted(ended) == [1, 2] and not tracker.tracks


def test_a_touch_that_is_lifted_beside_another_is_not_inside_it() -> None:
    tracker = Tracker()
    frames = [[touch(-0.011), touch(0.011)]] * 4 + [[touch(-0.011)]] * 4
    ids, ended = play(tracker, frames)
    assert ids[-1] == [1] and ended == [2]


def test_a_lost_frame_ends_nothing_and_two_do() -> None:
    tracker = Tracker()
    slide = [[touch(0.001 * n)] for n in range(8)]
    ids, ended = play(tracker, [*slide[:4], [], *slide[5:]])
    assert ids == [[1]] * 4 + [[]] + [[1]] * 3 and not ended
    ids, ended = play(tracker, [[]] * (LOST_FRAMES + 1) + [[touch(0.008)]], 9)
    assert ids[-1] == [2] and ended == [1]


def test_frames_without_news_end_nothing_for_a_while() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0)]] * 3)
    assert tracker.still(4 * FRAME_NS) == []
    later = 4 * FRAME_NS + int(0.5 * FORGOTTEN_S * 1e9)
    assert [t.id for t in tracker.update([touch(0.0)], later)[0]] == [1]
    later += int(1.1 * FORGOTTEN_S * 1e9)  # nobody looked: it may have been lifted and come back
    tracks, ended = tracker.update([touch(0.0)], later)
    assert [t.id for t in tracks] == [2] and [t.id for t in ended] == [1]


def test_frames_that_show_the_same_do_not_count_as_lost_ones() -> None:
    tracker = Tracker()
    play(tracker, [[touch(-0.02), touch(0.02)]] * 3 + [[touch(-0.02)]])
    assert all(tracker.still(n * FRAME_NS) == [] for n in (5, 6, 7))
    assert play(tracker, [[touch(-0.02), touch(0.02)]], 8) == ([[1, 2]], [])


def test_a_touch_that_stood_still_is_looked_for_where_it_stood_however_it_came_there() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0045 * n)] for n in range(5)])
    for n in (6, 7, 8, 9):
        tracker.still(n * FRAME_NS)
    assert play(tracker, [[touch(0.017)]], 10) == ([[1]], [])


def test_a_touch_that_was_not_where_it_was_followed_to_is_itself_again_with_the_next_images() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0)]] * 20)
    tracker.carry({1: Motion(0.003, -0.002, 0.2, -0.1)}, 20 * FRAME_NS + 4_400_000)
    assert play(tracker, [[touch(0.0)]] * 2, 21) == ([[1]] * 2, [])
    assert math.hypot(tracker.tracks[0].x, tracker.tracks[0].y) < 0.001


def test_a_touch_that_doubtful_images_lead_to_another_one_is_itself_again_in_the_first_sure_one() -> None:
    """In the scene of ten minutes a second touch began 30 mm away; its force grew for 0.3 s."""
    tracker = Tracker()
    play(tracker, [[touch(0.035, -0.006)]] * 5)
    for n, place in enumerate([(0.035, -0.007), (0.030, 0.0), (0.0276, 0.0045)], 6):
        tracker.update([touch(*place)], n * FRAME_NS, sure=False)
    assert play(tracker, [[touch(0.0165, 0.0186), touch(0.038, -0.008)]] * 3, 9)[0][-1] == [2, 1]
    assert tracker.tracks[-1].sure == [0.038, -0.008]


def test_a_touch_that_went_on_while_images_were_doubtful_is_not_looked_for_where_it_was_long_before() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0)]])
    for n, x in enumerate((0.01, 0.02, 0.03, 0.038), 2):
        tracker.update([touch(x)], n * FRAME_NS, sure=False)
    tracker.update([], 6 * FRAME_NS)
    assert play(tracker, [[touch(0.001)]], 7)[0] != [[1]]


def test_a_touch_that_moved_on_in_a_frame_without_an_image_of_its_own_is_looked_for_further_on() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0135 * n)] for n in range(5)])
    tracker.still(6 * FRAME_NS, changing=True)
    assert play(tracker, [[touch(0.0135 * 6)]], 7) == ([[1]], [])


@pytest.mark.parametrize(
    ("confidence", "well", "begins"),
    [(0.93, True, 2), (0.9, True, 3), (0.8, True, 0), (0.98, False, 2), (0.93, False, 0)],
)
def test_what_appears_beside_others_begins_later_if_faint(confidence: float, well: bool, begins: int) -> None:
    tracker = Tracker()
    second = touch(0.03)._replace(confidence=confidence)
    shown = [
        [t and t.id for t in tracker.update([touch(0.0, size=2 * SIZE), second], n * FRAME_NS, well=well)[0]][1]
        for n in range(1, 9)
    ]
    assert shown == [None] * (begins - 1) + [2] * (9 - begins) if begins else shown == [None] * 8


def test_a_patch_that_has_long_been_faint_is_no_touch_because_one_image_shows_it_clearly() -> None:
    tracker = Tracker()
    for n, confidence in enumerate([0.8] * 10 + [0.93, 0.8], 1):
        faint = touch(0.03)._replace(confidence=confidence)
        found, _ = tracker.update([touch(0.0, size=2 * SIZE), faint], n * FRAME_NS)
        assert [t and t.id for t in found] == [1, None]


def test_the_state_of_an_earlier_version_is_taken() -> None:
    tracker = Tracker()
    tracker.update([touch(0.0, size=2 * SIZE), touch(0.03)], FRAME_NS)
    state = tracker.state()
    for track in state["tracks"]:
        track["confidence"] = track.pop("confidences")[-1]
    later = Tracker()
    later.load(state)
    again = [touch(0.0, size=2 * SIZE), touch(0.03)]
    assert [t and t.id for t in later.update(again, 2 * FRAME_NS)[0]] == [1, 2]


def test_what_appears_beside_others_or_in_a_bad_image_has_to_appear_twice() -> None:
    tracker = Tracker()
    first, _ = tracker.update([touch(0.0), touch(0.03, size=2 * SIZE)], FRAME_NS)
    assert [t and t.id for t in first] == [None, 1]  # the larger one
    again, _ = tracker.update([touch(0.0), touch(0.03)], 2 * FRAME_NS)
    assert [t and t.id for t in again] == [2, 1]
    once, _ = tracker.update([touch(0.0), touch(0.03), touch(-0.03)], 3 * FRAME_NS)
    assert [t and t.id for t in once] == [2, 1, None]
    assert tracker.update([touch(0.0), touch(0.03)], 4 * FRAME_NS)[1] == []  # it never began, so it does not end

    alone = Tracker()
    assert alone.update([touch(0.0)], FRAME_NS, sure=False)[0] == [None]
    (track,), _ = alone.update([touch(0.001)], 2 * FRAME_NS, sure=False)
    assert track is not None and track.id == 1 and track.age == 1


def test_velocity_starts_at_zero_and_finds_that_of_the_slide() -> None:
    rng, tracker, speeds = np.random.default_rng(1), Tracker(), []
    for n in range(60):
        (track,), _ = tracker.update([touch(0.0015 * n + 0.0003 * rng.standard_normal())], n * FRAME_NS)
        speeds.append(track.vx)
    assert speeds[0] == 0.0
    assert np.mean(speeds[20:]) == pytest.approx(0.0015 / 0.045, rel=0.03)
    assert np.std(speeds[20:]) < 0.0003 / 0.045  # less than of differences of two frames, which is sqrt(2) of this


def test_a_reset_ends_every_touch_once_and_no_id_comes_back() -> None:
    tracker = Tracker()
    three = [touch(-0.007), touch(0.007), touch(0.03)]
    play(tracker, [three, three, [Patch(0, 0, 2 * SIZE, 0.015), touch(0.03)]])
    tracker.reset()
    tracker.reset()
    tracks, ended = tracker.update([touch(0.03)], 4 * FRAME_NS)
    assert [t.id for t in tracks] == [4] and sorted(t.id for t in ended) == [1, 2, 3]


def test_a_state_from_before_brings_no_id_back_that_ended() -> None:
    tracker = Tracker()
    play(tracker, [[touch(0.0)]] * 2)
    before = tracker.state()
    assert play(tracker, [[]] * (LOST_FRAMES + 1), 3)[1] == [1]
    tracker.load(before)
    assert play(tracker, [[touch(0.0)]], LOST_FRAMES + 4)[0] == [[2]]


def test_a_state_of_another_tracker_ends_what_was_there() -> None:
    tracker, other = Tracker(), Tracker()
    play(other, [[touch(0.0)]])
    play(tracker, [[touch(0.0), touch(0.03)]] * 2)
    tracker.load(other.state())
    tracks, ended = tracker.update([touch(0.0)], 3 * FRAME_NS)
    assert [t.id for t in tracks] == [1] and [t.id for t in ended] == [2]


def test_a_track_is_plain_numbers() -> None:
    """What is saved goes through msgpack."""
    values = asdict(Track(1, 0.0, 0.0, 0, SIZE, RADIUS))
    assert all(isinstance(v, int | float | list) for v in values.values())


def test_a_weak_touch_that_drowns_beside_a_strong_one_is_the_same_when_it_comes_out() -> None:
    strong, weak = touch(0.0, size=10 * SIZE), [touch(0.019 - 0.0005 * n) for n in range(8)]
    frames = [[strong, w] for w in weak] + [[strong]] * 10 + [[strong, touch(0.017)]] * 3
    ids, ended = play(Tracker(), frames)
    assert ids[-1] == [1, 2] and not ended
    ids, ended = play(Tracker(), frames[:8] + [[strong]] * 40)  # or it was lifted
    assert ended == [2]


def test_a_patch_that_falls_into_more_parts_than_touches_has_new_ones() -> None:
    tracker = Tracker()
    play(tracker, [[touch(-0.007), touch(0.007)]] * 2 + [[Patch(0, 0, 2 * SIZE, 0.015)]])
    ids, ended = play(tracker, [[touch(-0.01), touch(0.01), touch(0.0, 0.012)]] * 2, 4)
    assert len(ids[0]) == 2 and set(ids[0]) < {1, 2, 3} == set(ids[1]) and not ended


def test_what_a_touch_leaves_of_itself_in_the_image_as_it_ends_is_no_touch() -> None:
    """An image of its release shows it roughly where it was, the next one a faint rest somewhere else."""
    tracker = Tracker()
    play(tracker, [[touch(-0.020, 0.013)]] * 3)
    (changing,), _ = tracker.update([touch(-0.017, 0.009, 1.5 * SIZE)], 4 * FRAME_NS, sure=False)
    (rest,), _ = tracker.update([touch(-0.015, -0.003, 0.1 * SIZE)], 6 * FRAME_NS)
    assert changing is not None and rest is None


def test_a_touch_that_moves_fast_or_lightens_in_its_place_goes_on() -> None:
    tracker = Tracker()
    (first,), _ = tracker.update([touch(0.0)], 0)
    (light,), _ = tracker.update([touch(0.002, size=0.1 * SIZE)], FRAME_NS)
    assert first is not None and light is not None and light.id == first.id
    moved, sure = [], (True, False, False, True)
    for n, believed in enumerate(sure, 2):
        moved += tracker.update([touch(0.002 + 0.01 * (n - 1), size=SIZE)], n * FRAME_NS, sure=believed)[0]
    assert [t and t.id for t in moved] == [first.id] * 4


def updates(tracker: Tracker, *frames: tuple[list[Patch], bool]) -> list[list[int]]:
    """Ids of what each frame's contacts are, (patches, whether the image explains its frame)."""
    found = []
    for n, (seen, sure) in enumerate(frames, 1 + (tracker._looked_ns or 0) // FRAME_NS):
        tracks, _ = tracker.update(seen, n * FRAME_NS, sure)
        found.append([t.id for t in tracks if t is not None])
    return found


def test_what_the_image_of_a_changing_touch_shows_beside_it_begins_nowhere() -> None:
    """The force still rises in the second scan, whose image explains most of it, and shows the same ghost."""
    ghost = touch(-0.02, 0.01, 0.2 * SIZE)
    tracker = Tracker()
    tracker.update([], 0)
    rising = ([touch(0.02, size=0.5 * SIZE), ghost], False), ([touch(0.02), ghost], True)
    assert updates(tracker, *rising, ([touch(0.02)], True)) == [[], [1], [1]]


def test_a_second_touch_begins_beside_one_that_leaves_much_unexplained() -> None:
    """A strong touch at the edge leaves more than a changing one may; but every image is like the one before."""
    held = [touch(-0.036, -0.036, 6 * SIZE), touch(-0.013, 0.016)]
    changing = [touch(-0.04, -0.026, 3 * SIZE), touch(-0.013, 0.007)]
    tracker = Tracker()
    tracker.update([], 0)
    assert updates(tracker, (changing, False), (held, False), (held, False), (held, False))[-1] == [1, 2]


def test_no_second_touch_begins_in_images_that_leave_much_unexplained_however_alike_they_are() -> None:
    """A contact that rose just as the touch began: the image shows the touch, and another one at that electrode."""
    tracker = Tracker()
    tracker.update([], 0)
    shown = [touch(-0.026, -0.001, 4 * SIZE), touch(0.013, -0.048, 3 * SIZE)]
    ids = [[t and t.id for t in tracker.update(shown, n * FRAME_NS, sure=False, near=False)[0]] for n in range(1, 12)]
    assert ids[-1] == [1, None] and all(second is None for _, second in ids)


def test_a_touch_that_only_doubtful_images_showed_does_not_keep_the_true_one_waiting() -> None:
    tracker = Tracker()
    tracker.update([], 0)
    wrong = [touch(0.012, 0.02, k * SIZE) for k in (1, 2, 4)]
    assert updates(tracker, *(([each], False) for each in wrong)) == [[], [], [1]]
    assert updates(tracker, ([touch(0.036, 0.02, 5 * SIZE)], True)) == [[2]]


def test_a_faint_patch_begins_alone_and_not_beside_a_touch() -> None:
    faint = touch(0.0, 0.03)._replace(confidence=0.8)
    tracker = Tracker()
    tracker.update([], 0)
    assert updates(tracker, *[([touch(0.0), faint], True)] * 3) == [[1]] * 3
    alone = Tracker()
    alone.update([], 0)
    assert updates(alone, ([faint], True)) == [[1]]
