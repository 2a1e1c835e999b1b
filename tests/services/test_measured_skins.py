"""Skins of which no model is known: of a measured bundle the image tells the touches, of a registered one its map."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from services.calibration.fields import half_width, sample, sensitivities
from services.calibration.register_command import register_presses
from services.pipeline import Pipeline, Result
from services.runtime.config import Skin
from tests.services.curves import stages_of
from tests.services.stub_skin import present, whole_scan

NOISE = 1e-4
FORCE_N = 3.0  # of a press of strength 1


class MeasuredSkin:
    """A disc of hydrogel: its measurements answer to presses as the bundle says, each by a gain of its own."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(4)
        bundle = Bundle.load("disc16")
        self.reach, self.sensitivities = half_width(bundle), sensitivities(bundle, 1.5)
        self.gains = self.rng.uniform(0.7, 1.4, len(bundle.pattern))
        self.gains *= 0.02 / np.abs(self.at((0.0, 0.0))).mean()
        self.z0 = self.rng.uniform(100, 200, len(bundle.pattern))

    def at(self, place: tuple[float, float], strength: float = 1.0) -> NDArray[np.floating]:
        """(K,) relative change by a press at a place [m]."""
        return np.asarray(strength * self.gains * sample(self.sensitivities, np.array([place]), self.reach)[0])

    def registered(self, folder: Path) -> Path:
        radius, angle = 0.8 * self.reach * np.sqrt(self.rng.uniform(0, 1, 60)), self.rng.uniform(0, 2 * np.pi, 60)
        xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        strength = self.rng.uniform(0.5, 1.5, len(xy))
        untouched = self.z0 * (1 + 1e-3 * self.rng.standard_normal((len(xy), len(self.z0))))
        change = np.array([self.at((x, y), s) for (x, y), s in zip(xy, strength, strict=True)])
        presses = {"untouched": untouched, "touched": untouched * (1 + change), "xy": xy, "force": FORCE_N * strength}
        register_presses(presses, "disc16", len(xy), folder)
        return folder


class Felt:
    """Its frames, through the stages."""

    def __init__(self, skin: MeasuredSkin, bundle: Path | str) -> None:
        config = Skin(port="stub", bundle=str(bundle), frame_id="skin")
        self.skin, self.pipeline, self.scan, self.gain = skin, Pipeline(config), 0, 1.0
        self.rng = np.random.default_rng(1)  # the same whichever tests run
        self.feel(0.0, 70)
        self.pipeline.pre.command("tare", {})  # no model says whether something touched at the start
        assert not present(self.feel(0.0, 5)[-1])

    def feel(self, change: NDArray[np.floating] | float, scans: int) -> list[Result]:
        return [self._result(change) for _ in range(scans)]

    def _result(self, change: NDArray[np.floating] | float) -> Result:
        self.scan += 1
        z = self.gain * self.skin.z0 * (1 + change) * (1 + NOISE * self.rng.standard_normal(len(self.skin.z0)))
        return self.pipeline.run(whole_scan(z, self.scan, device_us=self.scan * 45_000))


@pytest.fixture(scope="module")
def skin() -> MeasuredSkin:
    return MeasuredSkin()


@pytest.fixture(scope="module")
def registered(skin: MeasuredSkin, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return skin.registered(tmp_path_factory.mktemp("skins") / "mine")


@pytest.fixture(params=["measured", "registered"])
def felt(request: pytest.FixtureRequest, skin: MeasuredSkin, registered: Path) -> Felt:
    return Felt(skin, registered if request.param == "registered" else "disc16")


def test_a_touch_begins_stays_and_ends(felt: Felt) -> None:
    first, *rest = felt.feel(felt.skin.at((0.02, 0.01)), 40)
    (begun,) = first.contact.contacts
    assert first.contact.valid and begun.state == "begin"
    twin = Felt(felt.skin, felt.pipeline.pre.config.bundle)  # that goes on from its state
    for stage, other in zip(stages_of(felt.pipeline), stages_of(twin.pipeline), strict=True):
        other.load(stage.state())
    twin.scan = felt.scan
    for result in [*rest, *twin.feel(felt.skin.at((0.02, 0.01)), 2)]:
        (contact,) = present(result)
        assert result.contact.valid and (contact.id, contact.state) == (begun.id, "hold")
        assert np.hypot(contact.position[0] - 0.02, contact.position[1] - 0.01) < 0.01
    left, after = felt.feel(0.0, 2)
    assert [(c.id, c.state) for c in left.contact.contacts] == [(begun.id, "end")] and not after.contact.contacts


def test_a_touch_that_slides_keeps_its_number(felt: Felt) -> None:
    ids, off = set[int](), list[float]()
    for x in np.linspace(-0.03, 0.03, 41):  # 33 mm/s
        (result,) = felt.feel(felt.skin.at((float(x), 0.02)), 1)
        for contact in present(result):
            ids.add(contact.id)
            off.append(float(np.hypot(contact.position[0] - x, contact.position[1] - 0.02)))
    assert len(ids) == 1 and len(off) >= 40 and np.median(off) < 0.008


def test_a_second_touch_has_a_number_of_its_own(felt: Felt) -> None:
    one = felt.skin.at((0.03, 0.0))
    (first,) = present(felt.feel(one, 3)[-1])
    both = present(felt.feel(one + felt.skin.at((-0.03, -0.01)), 4)[-1])
    assert len(both) == 2 and first.id in [contact.id for contact in both]
    (last,) = present(felt.feel(one, 3)[-1])
    assert last.id == first.id


def test_what_foam_remembers_drift_and_gain_are_no_touches(felt: Felt) -> None:
    press = felt.skin.at((0.0, 0.03))
    assert all(present(result) for result in felt.feel(press, 100))
    felt.feel(0.02 * press, 2)
    assert all(result.contact.valid and not result.contact.contacts for result in felt.feel(0.02 * press, 40))
    felt.feel(0.0, 40)
    felt.gain = 1.02
    felt.feel(0.0, 4)
    for _ in range(200):  # 0.2 %/s
        felt.gain *= 1 + 1e-4
        (result,) = felt.feel(0.0, 1)
        assert result.contact.valid and not result.contact.contacts


def test_a_registered_skin_tells_force_and_place(skin: MeasuredSkin, registered: Path) -> None:
    felt = Felt(skin, registered)
    (contact,) = present(felt.feel(skin.at((0.02, -0.02), 1.2), 3)[-1])
    assert contact.force_n is not None and contact.force_sigma_n is not None and contact.position_sigma is not None
    assert abs(contact.force_n - 1.2 * FORCE_N) < 0.15 * FORCE_N and contact.position_sigma[0] < 0.005
    assert np.hypot(contact.position[0] - 0.02, contact.position[1] + 0.02) < 0.004  # its map's grid is 2.7 mm wide
