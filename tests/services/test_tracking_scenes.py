"""Id switches in scenes of touches that slide, cross, pass and meet: scans of the stub's sheet in, contacts out."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from firmware_stub import scene as scenes
from models.shapes import KINDS, Shape
from services.runtime.config import Skin
from simulation.host import SimulatedHost
from tests.services.stub_skin import METRES, SCAN_S, StubSkin, lasting, present, transfer

GATE_M = 0.015  # further away a contact is not the touch's
LOST = 0.02  # share of frames that do not arrive


def touches(rng):
    radius, drop = rng.uniform(0.14, 0.22, 2), rng.uniform(0.2, 0.45, 2)
    kind = [KINDS[k] for k in rng.choice([0, 1, 3, 5], 2)]  # round, triangular, square
    return lambda n, at: Shape(kind[n], float(at[0]), float(at[1]), float(radius[n]), float(drop[n]))


def direction(angle):
    return np.array([math.cos(angle), math.sin(angle)])


def crossing(rng):
    """Two slide through the same place at an angle."""
    make, first, speed = touches(rng), rng.uniform(0, 6), rng.uniform(0.5, 1.1)
    second = first + rng.uniform(0.7, math.pi)
    for t in np.arange(-0.65 / speed, 0.65 / speed, SCAN_S):
        yield [make(n, direction(a) * speed * t) for n, a in enumerate((first, second))]


def meeting(rng):
    """Two slide towards each other until they touch, and back."""
    make, angle, speed = touches(rng), rng.uniform(0, 6), rng.uniform(0.4, 0.8)
    least = (make(0, np.zeros(2)).radius + make(1, np.zeros(2)).radius) / 2
    for t in np.arange(-0.9 / speed, 0.9 / speed, SCAN_S):
        half = least + speed * abs(t) / 2
        yield [make(0, -direction(angle) * half), make(1, direction(angle) * half)]


def switches(skin, scene, rng):
    """(changes of a true touch's id, ids given)."""
    ids: dict[int, int] = {}
    given: set[int] = set()
    count = 0
    for shapes in scene:
        if rng.random() < LOST:
            skin.scan += 1
            continue
        out = skin.see(transfer(tuple(shapes))).contact
        pressing = {c.id: np.array(c.position[:2]) for c in lasting(out)}
        given |= set(pressing)
        truth = {n: s.centroid * METRES for n, s in enumerate(shapes)}
        near = {n: i for n, i in ids.items() if i in pressing and np.linalg.norm(pressing[i] - truth[n]) < GATE_M}
        open_, free = [n for n in truth if n not in near], [i for i in pressing if i not in near.values()]
        if open_ and free:
            away = np.array([[np.linalg.norm(pressing[i] - truth[n]) for i in free] for n in open_])
            for row, column in zip(*optimize.linear_sum_assignment(away), strict=True):
                if away[row, column] < GATE_M:
                    count += ids.get(open_[row], free[column]) != free[column]
                    ids[open_[row]] = free[column]
    return count, len(given)


@pytest.mark.release
def test_a_large_tip_that_presses_slowly_in_parts_is_one_contact_all_along():
    """Its first parts may be two touches; what was shown must not end while it is asked."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.until(6.0)
    for x, y, radius, ramp in ((-0.013, -0.02, 0.02, 0.1), (0.012, 0.018, 0.02, 0.3), (0.006, -0.013, 0.022, 0.2)):
        start = host.now
        press = {"t": 0.1, "x": x, "y": y, "force": 4.0, "radius": radius, "seconds": 0.8, "ramp": ramp}
        host.play(scenes.parse({"press": [press]}))
        host.until(start + 1.5)
        pressed = [lasting(frame) for t, frame in host.contacts if start + 0.1 < t < start + 0.9 - ramp]
        shown = [frame for frame in pressed if frame]
        assert shown == pressed[-len(shown) :] and len(shown) > 50
        assert len({contact.id for frame in shown for contact in frame}) == 1


NO_NETWORK = Skin(port="stub", bundle="square16", frame_id="palm", network="none")


@pytest.mark.parametrize("kind", [crossing, meeting])
def test_ids_are_kept(kind):
    """Where touches inside a patch are not followed, every crossing has a switch."""
    skin, changed, made = StubSkin(skin=NO_NETWORK), 0, 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        count, given = switches(skin, list(kind(rng)), rng)
        changed, made = changed + count, made + given
        skin.rest(20)
    assert changed == 0 and made == 4


@pytest.mark.parametrize("lifted", [0, 1])
@pytest.mark.parametrize("away", [0.15, 0.3])  # of their middles, in model units, when one of them ends
def test_one_that_ends_while_two_overlap_is_gone(lifted, away):
    """It is not kept for having come as one of two, and what stays has its own force and place again."""
    skin = StubSkin(skin=NO_NETWORK)
    strong, weak = Shape(KINDS[0], -0.5, 0.05, 0.2, 0.4), Shape(KINDS[0], 0.0, 0.05, 0.17, 0.3)
    for at in np.arange(-0.6, -away, 0.035):
        before = skin.feel((replace(strong, x=float(at)), weak)).contact
    pair = (replace(strong, x=-away), weak)
    stays = pair[1 - lifted]
    assert len(lasting(before)) == 2
    place = stays.centroid * METRES
    same = min(before.contacts, key=lambda c: float(np.linalg.norm(np.array(c.position[:2]) - place))).id
    for _ in range(4):
        skin.feel(pair)
    for _ in range(6):
        skin.feel((stays,))
    found = skin.feel((stays,)).contact
    assert found.valid
    (contact,) = lasting(found)
    assert contact.id == same and np.linalg.norm(np.array(contact.position[:2]) - place) < 3e-3
    assert not present(skin.rest(6))
