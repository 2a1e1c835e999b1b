"""Touches refined by a fit: what contacts say then, when the image's answer stays, and that no frame waits."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from models.bundle import Bundle
from models.refine import RefineAnswer, RefineJob, Refiner, start_of
from models.shapes import Shape
from models.touch_response import TouchResponse
from protocol.frames import Contact, RefinedTouch
from services.contacts.force.law import Force
from services.contacts.refined import agrees, both, refined_outline, settled
from services.describe import refinement
from services.pipeline import Result
from services.refine_process import RefineHere, RefineProcess
from services.runtime.config import ConfigError, Indenter, Skin, parse
from tests.services.stub_skin import StubSkin, transfer

pytestmark = pytest.mark.live

UNIT = 0.05  # metres
FORCE, SHAPE = frozenset({"contact", "force", "shape"}), ("contact", "force", "shape")


def configured(kind: str = "circle", **more: object) -> Skin:
    return Skin(port="stub", bundle="square16", frame_id="palm", indenter=Indenter(kind=kind, **more))  # type: ignore[arg-type]


def pressed(kind: str, *shapes: Shape, frames: int = 3, snr_db: float = 75.0) -> tuple[StubSkin, Result]:
    stub = StubSkin(snr_db, skin=configured(kind))
    stub.pipeline.inference.fit_by(RefineHere())
    for _ in range(frames):
        found = stub.feel(shapes)
    return stub, found


def the_contact(found: Result) -> Contact:
    (contact,) = found.contact.contacts
    return contact


CIRCLE = Shape("circle", 0.2, -0.1, 0.22, 0.3)


def test_a_round_touch_is_refined_and_its_uncertainties_hold() -> None:
    stub, found = pressed("circle", CIRCLE, snr_db=85.0)
    contact = the_contact(found)
    assert found.contact.valid and contact.refined and contact.kind == "circle" and contact.kind_probability == 1.0
    assert contact.position_sigma is not None and 0 < contact.position_sigma[1] <= contact.position_sigma[0] < 5e-4
    off = np.array(contact.position[:2]) - UNIT * CIRCLE.centroid
    assert np.hypot(*off) < 4 * contact.position_sigma[0]
    assert contact.force_n is not None and contact.force_sigma_n is not None and contact.area_sigma_m2 is not None
    assert abs(contact.force_n - CIRCLE.force(UNIT)) < 4 * contact.force_sigma_n < 1.5
    assert abs(contact.area_m2 - CIRCLE.area * UNIT**2) < 4 * contact.area_sigma_m2
    image = found.image
    assert image.refined is not None and image.refined.scan == found.delta.reconstructed
    contacts, force, shape = stub.pipeline.publishing.everything(image, FORCE)
    assert force.force_n == pytest.approx(contact.force_n) and force.refined and shape.refined  # type: ignore[attr-defined]
    assert force.force_sigma_n == pytest.approx(contact.force_sigma_n)  # type: ignore[attr-defined]
    outline = np.array(shape.outlines[0])  # type: ignore[attr-defined]
    assert np.hypot(*(outline - image.refined.centre).T) == pytest.approx(image.refined.radius_m)
    assert shape.ids == [contacts.contacts[0].id]  # type: ignore[attr-defined]
    image.refined.between_kinds = [0.0, 0.2]  # where the area is the image's, the outline is
    contacts, _, shape = stub.pipeline.publishing.everything(image, FORCE)
    x, y = np.array(shape.outlines[0]).T  # type: ignore[attr-defined]
    area = 0.5 * abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1)))
    assert len(x) != len(outline) and area == pytest.approx(contacts.contacts[0].area_m2, rel=0.05)


def test_a_held_touch_keeps_it_and_a_release_ends_it() -> None:
    stub, found = pressed("circle", CIRCLE, frames=4)
    assert found.delta.held or stub.feel((CIRCLE,)).delta.held
    held = stub.feel((CIRCLE,))
    assert the_contact(held).refined and the_contact(held).state == "hold"
    for _ in range(4):
        free = stub.feel()
    assert free.image.refined is None and not any(c.refined for c in free.contact.contacts)


def test_a_soft_touch_is_told_from_a_hard_one() -> None:
    soft = Shape("hertz", -0.2, 0.15, 0.5, 0.5)
    _, found = pressed("any", soft, frames=4, snr_db=95.0)
    contact = the_contact(found)
    assert contact.refined and contact.kind == "hertz" and contact.shape == "circle"
    assert contact.force_n == pytest.approx(soft.force(UNIT), rel=0.1)


def test_two_touches_keep_the_images_answer() -> None:
    _, found = pressed("circle", Shape("circle", 0.4, 0.4, 0.2, 0.4), Shape("circle", -0.5, -0.4, 0.2, 0.4))
    assert len(found.contact.contacts) == 2 and not any(c.refined for c in found.contact.contacts)


def test_a_shape_that_was_not_declared_keeps_the_images_answer() -> None:
    stub, found = pressed("circle", Shape("rectangle", 0.1, 0.1, 0.45, 0.4, 0.5, 2.6))
    assert not the_contact(found).refined and the_contact(found).kind == ""
    assert stub.pipeline.inference.health().counters["refine_unexplained"] > 0


class LateFits(RefineHere):
    """Answers when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.jobs: list[RefineJob] = []

    def offer(self, job: RefineJob) -> None:
        self.jobs.append(job)

    def answer(self) -> None:
        super().offer(self.jobs[-1])


def test_a_moving_touch_takes_its_answer_along_as_far_as_it_explains_the_frames() -> None:
    stub, fits = StubSkin(80.0, skin=configured()), LateFits()
    stub.pipeline.inference.fit_by(fits)
    for _ in range(2):
        first = stub.feel((CIRCLE,))
    assert not the_contact(first).refined and fits.jobs  # no frame waits
    fits.answer()
    moved = replace(CIRCLE, x=CIRCLE.x + 0.03)
    for n in range(2):
        found = stub.feel((moved,))
        assert the_contact(found).refined, n
    contact = the_contact(found)
    assert contact.position_sigma is not None
    off = np.array(contact.position[:2]) - UNIT * moved.centroid
    assert np.hypot(*off) < 4 * contact.position_sigma[0] < UNIT * 0.03
    assert found.image.refined is not None and found.image.refined.scan < found.delta.scan
    assert fits.jobs[-1].before.keys() == {"circle"}  # the next fit begins where this one is
    far = replace(CIRCLE, x=CIRCLE.x - 0.3)
    for _ in range(2):
        found = stub.feel((far,))
    assert not the_contact(found).refined and not fits.jobs[-1].before


@pytest.mark.parametrize("radius", [0.22, 0.3])
def test_a_touch_that_has_moved_by_millimetres_keeps_its_force(radius: float) -> None:
    """To first order of its way it looked larger and fainter: 13 % less force after 3 mm."""
    stub, fits = StubSkin(95.0, skin=configured()), LateFits()
    stub.pipeline.inference.fit_by(fits)
    touch = replace(CIRCLE, radius=radius)
    for _ in range(3):
        stub.feel((touch,))
    fits.answer()
    before = the_contact(stub.feel((touch,)))
    far = replace(touch, x=touch.x + 0.25 * radius)
    for _ in range(2):
        found = stub.feel((far,))
    contact = the_contact(found)
    assert before.refined and contact.refined
    assert before.force_n and contact.force_n and contact.force_sigma_n and before.force_sigma_n
    assert contact.force_n == pytest.approx(before.force_n, rel=0.06)
    assert contact.force_sigma_n > 1.05 * before.force_sigma_n, "it is less sure than where it was fitted"
    assert contact.area_m2 == pytest.approx(before.area_m2, rel=0.08)


class SlowFits(RefineHere):
    """A fit takes five frames' time, and one that begins at an earlier one takes one. The newest job waits."""

    def __init__(self) -> None:
        super().__init__()
        self._runs: tuple[RefineJob, int] | None = None
        self._waits: RefineJob | None = None

    def offer(self, job: RefineJob) -> None:
        self.skipped["palm"] = self.skipped.get("palm", 0) + (self._waits is not None)
        self._waits = job
        self._next()

    def _next(self) -> None:
        if self._runs is None and self._waits is not None:
            self._runs, self._waits = (self._waits, 1 if self._waits.before else 5), None

    def a_frame_later(self) -> None:
        if self._runs is None:
            return
        job, left = self._runs
        self._runs = job, left - 1
        if left == 1:
            super().offer(job)
            self._runs = None
            self._next()


@pytest.mark.release
def test_a_slide_is_refined_as_far_as_there_is_time_and_what_is_skipped_is_counted() -> None:
    """At 20 mm/s a touch is elsewhere when a fit from nothing is done: the next one begins where that ended."""
    stub, fits = StubSkin(80.0, skin=configured()), SlowFits()
    stub.pipeline.inference.fit_by(fits)
    refined, off, step = 0, [], 0.020 / 22 / UNIT
    for k in range(24):
        there = replace(CIRCLE, x=0.5 - k * step)
        start, end = (transfer((replace(there, x=there.x + half * step),)) for half in (0.5, -0.5))
        found = stub.see(start, end)
        fits.a_frame_later()
        contact = the_contact(found)
        if contact.refined:
            refined += 1
            off.append(np.hypot(*(np.array(contact.position[:2]) - UNIT * there.centroid)))
    assert refined >= 10 and np.median(off) < 5e-4
    counters = stub.pipeline.inference.health().counters
    assert counters["refine_skipped"] > 0 and counters["refine_fits"] > 8


def test_an_answer_of_a_touch_that_is_gone_is_dropped() -> None:
    stub, fits = StubSkin(80.0, skin=configured()), LateFits()
    stub.pipeline.inference.fit_by(fits)
    stub.feel((CIRCLE,))
    for _ in range(4):
        stub.feel()
    fits.answer()
    found = stub.feel((replace(CIRCLE, x=-0.3),))
    assert found.delta.touched and found.image.refined is None


# -- the process


@pytest.fixture
def process():
    made = RefineProcess()
    yield made
    made.close()


def job(bundle: Bundle, number: int = 1, skin: str = "palm") -> RefineJob:
    response = TouchResponse(bundle.response(), bundle.pattern, bundle.z0.astype(float))
    sigma = np.full(120, 1e-4)
    sigma[7] = np.inf  # not measured
    d = response.of(CIRCLE) + 1e-4 * np.random.default_rng(number).standard_normal(120)
    start = replace(CIRCLE, x=0.24, radius=0.26, drop=0.25)
    return RefineJob(skin, number, str(bundle.path), np.where(np.isfinite(sigma), d, 0.0), sigma, start, ("circle",))


def answered(process: RefineProcess, skin: str = "palm") -> RefineAnswer:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if (answer := process.poll(skin)) is not None:
            return answer
        time.sleep(0.02)
    raise AssertionError(f"no answer within a minute: {process.problem}")


def test_the_process_fits_the_newest_of_each_skin_and_counts_the_others(process: RefineProcess, bundle: Bundle) -> None:
    process.start()
    began = time.monotonic()
    process.offer(job(bundle, 1))
    for number in (2, 3, 4):
        process.offer(job(bundle, number))
    process.offer(job(bundle, 5, "sole"))
    assert time.monotonic() - began < 5.0 and process.skipped == {"palm": 2}
    found = answered(process)
    while found.number == 1:
        found = answered(process)
    assert found.number == 4 and found.problem == "" and found.posterior is not None
    assert found.posterior.position == pytest.approx(CIRCLE.centroid, abs=0.01) and not found.live[7]
    assert answered(process, "sole").number == 5


@pytest.mark.release
def test_a_job_that_knows_the_answer_goes_before_one_that_did_not(process: RefineProcess, bundle: Bundle) -> None:
    process.offer(job(bundle, 1))
    process.offer(job(bundle, 2))  # made while the first is fitted
    assert answered(process).number == 1
    process.offer(job(bundle, 3))
    assert answered(process).number == 3 and process.skipped == {"palm": 1}


def test_a_process_that_dies_is_started_again_and_said(
    process: RefineProcess, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.refine_process.WAIT_S", (0.0, 0.0))
    process._pause_s = 0.0
    process.offer(job(bundle))
    assert process._process is not None
    os.kill(process._process.pid, signal.SIGKILL)
    process._process.wait()
    while not process.problem:
        process.poll("palm")
    assert "ended; it is started again" in process.problem and process.skipped == {"palm": 1}
    process.offer(job(bundle, 2))
    assert answered(process).number == 2 and process.problem == ""


def test_a_process_that_cannot_be_started_stops_nothing(bundle: Bundle) -> None:
    process = RefineProcess(("/nowhere/python",))
    process.start()
    process.offer(job(bundle))
    assert "cannot be used" in process.problem and process.poll("palm") is None


def test_a_fit_that_never_ends_is_given_up(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.refine_process.STUCK_S", 0.0)
    process = RefineProcess((sys.executable, "-c", "import time; time.sleep(60)"))
    process.offer(job(bundle))
    time.sleep(0.01)
    assert process.poll("palm") is None and "gave no answer" in process.problem
    process.close()


HALF_AN_ANSWER = """
import os, struct, time
os.write(1, struct.pack("!i", 1000) + b"x" * 10)
time.sleep(60)
"""


def test_half_an_answer_keeps_no_frame_waiting(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.refine_process.STUCK_S", 0.5)
    process = RefineProcess((sys.executable, "-c", HALF_AN_ANSWER))
    process.offer(job(bundle))
    began = time.monotonic()
    while not process.problem:
        assert process.poll("palm") is None and time.monotonic() < began + 20
        time.sleep(0.02)
    assert "gave no answer" in process.problem
    process.close()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"d": np.full(120, np.nan)}, "measurements that are no numbers"),
        ({"d": np.zeros(3)}, "a frame of 3 measurements, expected 120"),
        ({"kinds": ("hexagon",)}, "KeyError"),
        ({"tare_frames": 0.0}, "ZeroDivisionError"),
    ],
)
def test_a_job_that_cannot_be_done_is_answered(bundle: Bundle, change: dict[str, object], said: str) -> None:
    found = Refiner()(replace(job(bundle), **change))  # type: ignore[arg-type]
    assert found.posterior is None and said in found.problem


def test_a_bundle_that_cannot_be_read_is_an_answer_too(bundle: Bundle) -> None:
    found = Refiner()(replace(job(bundle), bundle="/nowhere"))
    assert found.posterior is None and "a touch could not be fitted: no bundle '/nowhere'" in found.problem


def test_an_image_that_shows_nothing_starts_no_fit() -> None:
    assert start_of(np.zeros((24, 24))) is None
    assert start_of(np.full((24, 24), np.inf)) is None


# -- image and fit


CONTACT = Contact(id=1, position=[0.01, 0.0, 0.0], area_m2=3e-4, force_n=3.0, force_sigma_n=0.3)
TOUCH = RefinedTouch(
    kind="circle",
    probabilities=[1.0, 0.0, 0.0, 0.0, 0.0],
    position=[0.0101, 0.0],
    sigma=[2e-4, 1e-4, 0.0],
    drop=0.31,
    drop_sigma=0.01,
    integral=9e-5,
    integral_sigma=1e-6,
    area_m2=3.1e-4,
    area_sigma_m2=1e-5,
    centre=[0.0101, 0.0],
    radius_m=0.01,
)


@pytest.mark.parametrize(
    "touch, newton, same",
    [
        (TOUCH, 3.1, True),
        (replace(TOUCH, position=[0.018, 0.0]), 3.1, False),
        (replace(TOUCH, position=[float("nan"), 0.0]), 3.1, False),
        (replace(TOUCH, area_m2=9e-4), 3.1, False),
        (TOUCH, 5.0, False),
    ],
)
def test_a_fit_counts_where_it_and_the_image_mean_the_same_touch(
    touch: RefinedTouch, newton: float, same: bool
) -> None:
    assert agrees(CONTACT, touch, Force(newton, 0.1)) == same


def test_where_the_kinds_differ_the_image_has_a_say() -> None:
    agreed = settled(CONTACT, TOUCH, Force(3.2, 0.1))
    assert agreed == (Force(3.2, 0.1), TOUCH.area_m2, TOUCH.area_sigma_m2)
    force, area, sigma = settled(CONTACT, replace(TOUCH, between_kinds=[0.2, 0.2]), Force(3.2, 0.1))
    assert force.newton == pytest.approx((3.0 * 3.2) ** 0.5) and area == CONTACT.area_m2
    assert force.sigma == pytest.approx(np.hypot(0.1, force.newton - 3.2))
    assert sigma == pytest.approx(np.hypot(1e-5, 1e-5))
    without = settled(replace(CONTACT, force_n=None), replace(TOUCH, between_kinds=[0.2, 0.0]), Force(None, None))
    assert without[0] == Force(None, None)


def test_the_shape_is_what_fit_and_network_say_together() -> None:
    first = 1 / (1 + 9**0.25)  # the network has a quarter
    said = both([0.5, 0.5, 0.0, 0.0, 0.0], [0.1, 0.9, 0.0, 0.0, 0.0])
    assert said == pytest.approx([first, 1 - first, 0.0, 0.0, 0.0])
    assert both([0.5, 0.5, 0.0, 0.0, 0.0], []) == [0.5, 0.5, 0.0, 0.0, 0.0]
    assert both([1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]) == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_an_outline_is_that_of_the_likeliest_shape() -> None:
    touch = replace(TOUCH, kind="rectangle", aspect=2.0, radius_m=0.01)
    assert np.hypot(*(np.array(refined_outline(touch)) - TOUCH.centre).T) == pytest.approx([0.01] * 4)


# -- where nothing is refined, it is said why


def test_info_says_why_nothing_is_refined(bundle: Bundle, tmp_path: object) -> None:
    skin = configured("any")
    assert refinement(skin, bundle) == "on"
    assert "names no `indenter`" in refinement(skin.model_copy(update={"indenter": None}), bundle)
    files = {name: sha for name, sha in bundle.manifest["files"].items() if name != "response.npz"}
    without = replace(bundle, manifest={**bundle.manifest, "files": files})
    assert "python -m models.build --skin square16 --response" in refinement(skin, without)
    assert "calibrated as it is mounted" in refinement(skin, bundle, calibrated=True)
    assert "measured, not modelled" in refinement(skin, Bundle.load("disc16"))
    assert "no network" in refinement(skin.model_copy(update={"network": "none"}), bundle)
    for radius in (0.001, 0.0499):
        assert f"`radius_m` is {radius:g} m" in refinement(configured("circle", radius_m=radius), bundle)
        assert "of radius 0.0025 to 0.0475 m" in refinement(configured("circle", radius_m=radius), bundle)
    for radius in (0.0025, 0.01, 0.0475):
        assert refinement(configured("circle", radius_m=radius), bundle) == "on"
    assert "`refine = false`" in refinement(configured("any", refine=False), bundle)
    stub = StubSkin(80.0, skin=skin)
    info = stub.pipeline.pre.info()
    assert info is not None and info["refinement"] == "on"


def test_an_indenter_of_another_kind_has_no_radius() -> None:
    palm = {"port": "stub", "bundle": "square16"}
    with pytest.raises(ConfigError, match='`radius_m` with kind = "circle" alone'):
        parse({"skins": {"palm": palm | {"indenter": {"kind": "hertz", "radius_m": 0.01}}}})
    with pytest.raises(ConfigError, match="indenter.kind: found 'square'; allowed: 'circle', 'hertz' or 'any'"):
        parse({"skins": {"palm": palm | {"indenter": {"kind": "square"}}}})
    older = parse({"skins": {"palm": palm | {"indenter": {"radius_m": 0.01, "shape": "circle"}}}})
    assert older.skin("palm").indenter == Indenter(kind="circle", radius_m=0.01)
