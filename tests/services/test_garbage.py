"""Whatever a board sends: no exception, no NaN out, never valid on what no skin made, nothing left behind."""

from functools import cache

import numpy as np
import pytest

from models.bundle import Bundle
from models.forward import shared
from models.shapes import Shape
from protocol.frames import STATUS_OPEN, pack, unpack
from services.estimation.initialisation.baseline import Baseline, take
from services.pipeline import Pipeline
from services.recordings.reconstruction import baseline_of
from services.runtime.config import Skin
from simulation.host import LATE_S, SimulatedHost
from simulation.scenes import DiscPress, script
from tests.services.stub_skin import whole_scan

TOUCH = Shape("circle", 0.4, 0.3, 0.25, 0.3)  # 3 N
CENTRE_MM = 50 * TOUCH.centroid


def bits(z0, rng):
    words = rng.integers(0, 2**32, 2 * len(z0), dtype=np.uint32).view(np.float32)
    return words[0::2] + 1j * words[1::2].astype(complex)


# frames that no skin made: how many are tried (those that cost seconds once), |Z0| and a generator -> Z
FAMILIES = {
    "random bits": (3, bits),
    "magnitude": (3, lambda z0, rng: 10.0 ** rng.uniform(-30, 30, 120) * np.exp(2j * np.pi * rng.random(120))),
    "exchanged": (1, lambda z0, rng: rng.permutation(z0)),
    "x e^N(0, 0.3)": (1, lambda z0, rng: z0 * np.exp(0.3 * rng.standard_normal(120))),
    "one factor": (3, lambda z0, rng: z0 * 10.0 ** (rng.choice([-1, 1]) * rng.uniform(0.05, 3))),
    "status": (3, lambda z0, rng: z0),
}


@cache
def solved():
    """|Z| (120,) touched and untouched, on the coarsest mesh."""
    model = shared("square16", "inverse")
    return [np.abs(model.solve(sheet).impedances()) for sheet in (model.touched([TOUCH]), 1.0)]


def noisy(z, rng, *n):
    return z * (1 + 1e-4 * rng.standard_normal((*n, *z.shape)))  # 80 dB


def made(family, rng):
    with np.errstate(all="ignore"):
        z = np.asarray(FAMILIES[family][1](solved()[1], rng), complex)
    return z, rng.integers(0, 16, 120) if family == "status" else None


class Stages:
    def __init__(self):
        self.pipeline, self.scan = Pipeline(Skin(port="stub", bundle="square16", network="full")), 0

    def tare(self, z0):
        return take(noisy(z0, np.random.default_rng(0), 64), self.pipeline.pre.pre, "bench")

    def begin(self, baseline):
        """Forget everything; this baseline from now on."""
        self.pipeline.reset()
        self.pipeline.pre.set_baseline(Baseline(**baseline.to_dict() | {"z0": baseline.z0.copy()}))

    def see(self, z, status=None):
        """The contact frame, once nothing that is no number has left a stage."""
        self.scan += 1
        with np.errstate(all="ignore"):
            status = None if status is None else status.astype("u1")
            result = self.pipeline.run(whole_scan(np.asarray(z), self.scan, status, skin="skin", board="bench"))
        delta, image, contact = result.delta, result.image, result.contact
        for array in (delta.difference, [delta.score, delta.threshold], image.image, image.sigma, image.classes):
            assert np.isfinite(array).all()
        assert not np.isnan(delta.sigma).any()  # infinity says that a measurement is not used
        assert "non_finite" not in set(unpack(pack(contact)).reasons) - set(contact.reasons)
        return contact

    def once(self, baseline, z, status=None):
        """One frame by itself, without memory of the one before."""
        self.begin(baseline)
        return self.see(z, status)


@pytest.fixture
def stages():
    return Stages()


@pytest.fixture
def baseline(stages):
    return stages.tare(solved()[1])


def place_mm(contact):
    return 1e3 * np.array(contact.contacts[0].position[:2])


def off_mm(contact):
    return np.hypot(*(place_mm(contact) - CENTRE_MM))


@pytest.mark.parametrize("exponent", [-9, 9])
def test_the_unit_of_the_measurements_divides_out(stages, exponent):
    touched, z0 = solved()
    z = noisy(touched, np.random.default_rng(1))
    a, b = (stages.once(stages.tare(scale * z0), scale * z) for scale in (1.0, 10.0**exponent))
    assert a.valid and b.valid and np.linalg.norm(place_mm(a) - place_mm(b)) < 0.05
    assert a.contacts[0].force_n == pytest.approx(b.contacts[0].force_n, rel=0.01)


@pytest.mark.parametrize("family", FAMILIES)
def test_frames_that_no_skin_made_are_never_valid_nor_anything_against_a_tare_of_them(stages, baseline, family):
    """Such untouched rows of a file are in doubt. (Another gain alone is another skin, and a good one.)"""
    rng = np.random.default_rng(4)
    for _ in range(FAMILIES[family][0]):
        assert not stages.once(baseline, *made(family, rng)).valid
    if family == "one factor":
        return
    with np.errstate(all="ignore"):
        z, status = made(family, rng)
        frames = np.abs(z) * (1 + 1e-4 * rng.standard_normal((64, 120)))
        of_it = baseline_of(frames, stages.pipeline.pre.pre, print, frames)
    assert not stages.once(of_it, frames[0], status).valid


def test_a_stream_of_garbage_leaves_nothing_behind(stages, baseline):
    (touched, z0), rng = solved(), np.random.default_rng(5)
    stages.begin(baseline)
    for family, (count, _) in FAMILIES.items():
        if count > 1:
            stages.see(*made(family, rng))
    contact = [stages.see(noisy(z0, rng)) for _ in range(12)][-1]
    assert contact.valid and all(c.state == "end" for c in contact.contacts)
    contact = [stages.see(noisy(touched, rng)) for _ in range(3)][-1]
    assert contact.valid and off_mm(contact) < 2


@pytest.mark.many
@pytest.mark.parametrize("value", [np.nan, -np.inf, 0.0, 1e-41, 1e6, 1e20, 3.4e38])
@pytest.mark.parametrize("dead", [1, 2, 3, 8, 16])
def test_dead_electrodes_cost_accuracy_or_validity_never_truth(stages, baseline, dead, value):
    """No number at all, or next to no current and flagged so."""
    rng = np.random.default_rng(dead)
    for _ in range(2):
        lost = np.isin(np.asarray(Bundle.load("square16").pattern), rng.permutation(16)[:dead]).any(axis=1)
        z = np.where(lost, value, noisy(solved()[0], rng))
        contact = stages.once(baseline, z, np.where(lost, STATUS_OPEN, 0) if value == 1e6 else None)
        assert contact.valid == (dead <= 2) and (not contact.valid or off_mm(contact) < 10)


TAPS, PRESSED_S, PAUSE_S = 110, 0.3, 0.3
BEGINS = 6.0 + np.arange(TAPS) * (PRESSED_S + PAUSE_S + 0.013)  # at every phase of a scan


@pytest.mark.release
def test_taps_for_a_minute_leave_the_skin_untouched_in_between():
    """Which leave no pause in which the baseline is followed."""
    places = np.random.default_rng(1).uniform(-0.043, 0.043, (20, 2)).tolist()
    taps = [DiscPress(*places[k % 20], t, t + PRESSED_S, 2.0, 0.001, 0.005) for k, t in enumerate(BEGINS.tolist())]
    host = SimulatedHost("full", 80.0, seed=3, script=script(*taps), late_s=LATE_S)
    host.until(BEGINS[-1] + 2.0)
    host.close()
    pauses = []
    for _, frame in host.contacts:
        t = frame.stamps["sample"] * 1e-9
        if t > 6.0 and all(t < b - 0.03 or t >= b + PRESSED_S + 0.15 for b in BEGINS):  # no touch in a part of the scan
            pauses.append(frame)
    assert len(pauses) > 2 * TAPS and all(frame.valid and not frame.contacts for frame in pauses)
