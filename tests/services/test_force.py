"""Force and its uncertainty, through the real stages, on presses solved on a mesh that no training uses; its law."""

from dataclasses import replace

import numpy as np
import pytest

from models import geometry
from models.bundle import Bundle
from models.forward import shared
from models.pressure import FOAM, disc
from models.shapes import Shape
from models.solved_presses import SolvedPresses, solve
from protocol.frames import Contact
from services.contacts.force.curve import Curve
from services.contacts.force.law import ForceLaw, ImagePatch
from services.contacts.force.of_disc import SATURATED
from services.estimation.initialisation.baseline import take
from services.pipeline import Pipeline
from services.runtime.config import ConfigError, Skin
from tests.services.stub_skin import METRES, present, whole_scan


@pytest.fixture(scope="module")
def presses() -> SolvedPresses:
    return solve(geometry.load("square16"), 40, seed=99)


class Skinny:
    """A skin under noise: |Z| in, contacts out."""

    def __init__(self, skin: Skin, bundle: Bundle, z0: np.ndarray, decibel: float, hold: bool = False) -> None:
        self.z0, self.noise, self.rng, self.scan = z0, 10 ** (-decibel / 20), np.random.default_rng(5), 0
        self.pipeline = Pipeline(skin, bundle=bundle, always_reconstruct=not hold, each_alone=not hold)
        tare = z0 * (1 + self.noise * self.rng.standard_normal((64, len(z0))))
        self.baseline = take(tare, self.pipeline.pre.pre, "b")
        self.release()

    def release(self) -> None:
        self.pipeline.reset()
        self.pipeline.pre.set_baseline(replace(self.baseline, z0=self.baseline.z0.copy()))

    def press(self, d: np.ndarray, frames: int = 1) -> Contact | None:
        """The one contact of the last frame, on a skin that was free."""
        self.release()
        for _ in range(frames):
            self.scan += 1
            z = self.z0 * (1 + d) * (1 + self.noise * self.rng.standard_normal(len(d)))
            out = self.pipeline.run(whole_scan(z, self.scan, source="replay", board="b"))
        return present(out)[0] if out.delta.touched and len(present(out)) == 1 else None


class Mesh:
    def __init__(self, skin: str, mesh: str) -> None:
        self.model = shared(skin, mesh)
        self.z0 = np.abs(self.model.solve(1.0).impedances())

    def change(self, *shapes: Shape) -> np.ndarray:
        """(K,) relative."""
        return np.asarray(np.abs(self.model.solve(self.model.touched(list(shapes))).impedances()) / self.z0 - 1)


def configured(**more: object) -> Skin:
    return Skin.model_validate({"port": "stub", "bundle": "square16", "frame_id": "palm", **more})


def scored(skinny: Skinny, presses: SolvedPresses, frames: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(error / sigma, relative error) of the presses that are seen."""
    z, errors = [], []
    for shape, d in zip(presses.touches(), presses.difference, strict=True):
        if (c := skinny.press(d, frames)) is not None:
            assert c.force_n is not None and c.force_sigma_n is not None
            true = shape.force(METRES)
            z.append((c.force_n - true) / c.force_sigma_n)
            errors.append(c.force_n / true - 1)
    return np.array(z), np.array(errors)


@pytest.mark.release
def test_presses_of_any_shape_are_no_worse_than_they_say(presses: SolvedPresses, bundle: Bundle) -> None:
    """A sigma is of soft edges too, and these are sharp: 86 to 88 % lie within one in draws of 450."""
    for decibel, frames in ((75.0, 1), (66.0, 4)):
        z, errors = scored(Skinny(configured(), bundle, presses.z0, decibel, hold=frames > 1), presses, frames)
        assert len(z) > 34 and (np.abs(z) < 1).mean() > 0.6 and (np.abs(z) < 3).mean() > 0.96
        assert np.sqrt(np.mean(z**2)) > 0.3  # nor far better
        assert abs(np.median(errors)) < 0.03 and np.sqrt(np.mean(errors**2)) < 0.12


@pytest.mark.parametrize(("radius", "drops"), [(0.2, (0.1, 0.5)), (0.1, (0.4, 0.4))])  # 1 to 5 N by 10 mm, 1 N by 5 mm
def test_a_known_indenter_takes_the_trade_off_away(bundle: Bundle, radius: float, drops: tuple[float, float]) -> None:
    mesh, rng = Mesh("square16", "stub"), np.random.default_rng(3)
    shapes = [Shape("circle", *rng.uniform(-0.75, 0.75, 2), radius, rng.uniform(*drops)) for _ in range(16)]
    presses = SolvedPresses(np.array([s.as_row() for s in shapes]), np.array([mesh.change(s) for s in shapes]), mesh.z0)
    z, known = scored(Skinny(configured(indenter={"radius_m": METRES * radius}), bundle, mesh.z0, 70.0), presses)
    other_z, unknown = scored(Skinny(configured(), bundle, mesh.z0, 70.0), presses)
    assert np.abs(known).mean() < min(0.035, 0.8 * np.abs(unknown).mean()) and np.abs(unknown).mean() < 0.09
    assert np.median(known / z) < 0.7 * np.median(unknown / other_z)  # its relative sigma
    assert 0.3 < (np.abs(z) < 1).mean()


def test_the_force_of_a_press_is_told_whatever_its_size(bundle: Bundle) -> None:
    """Sizes, places and a mesh that the estimate's constants were not measured on."""
    mesh, rng, table = Mesh("square16", "inverse"), np.random.default_rng(11), []
    skinny = Skinny(configured(), bundle, mesh.z0, 80.0)
    for mm, newton in ((mm, newton) for mm in (6.0, 8.5, 12.0, 18.0) for newton in (1.0, 2.0, 4.0) for _ in range(2)):
        radius = mm * 1e-3
        drop = FOAM.flat_drop(newton, disc(radius))
        x, y = rng.uniform(-1 + radius / METRES, 1 - radius / METRES, 2)
        c = skinny.press(mesh.change(Shape("circle", x, y, radius / METRES, drop)), 6)
        assert c is not None and c.force_n is not None and c.force_sigma_n is not None
        assert c.pressure_pa is not None and c.pressure_sigma_pa is not None
        table.append((mm, c.force_n / newton, (c.force_n - newton) / c.force_sigma_n, c.force_sigma_n / newton, drop))
        assert abs(c.pressure_pa - float(FOAM.pressure(drop))) < 4 * c.pressure_sigma_pa
    sizes, over, sigmas, sigma, drops = np.array(table).T
    assert all(np.median(over[sizes == mm]) == pytest.approx(1.0, abs=0.06) for mm in np.unique(sizes))
    # A press that saturates the foam has a force from below only: how far off it may be its sigma says.
    told = drops <= SATURATED
    assert told.sum() >= 18 and np.sqrt(np.mean((over[told] - 1) ** 2)) < 0.07
    # A sigma is of touches of any shape and edge, so discs lie well within; what they may not be is useless.
    assert (np.abs(sigmas) < 3).all() and np.median(sigma) < 0.06 and 0.2 < np.sqrt(np.mean(sigmas**2)) < 1.2


def look(**more: float) -> ImagePatch:
    return ImagePatch(**{"peak": 0.3, "peak_sigma": 0.03, "integral": 1e-4, "x": 0.0, "y": 0.0, **more})


def of_images(**more: object) -> ForceLaw:
    """Of a skin whose images alone tell its touches, calibrated by a foam like the shipped one."""
    skin = configured(bundle="disc16", **more)
    return replace(ForceLaw.of(skin, Bundle.load("disc16")), curve=Curve(1.0), calibrated=True)


def with_law(bundle: Bundle, **said: object) -> Bundle:
    return replace(bundle, manifest={**bundle.manifest, "force_law": said})


@pytest.mark.parametrize(("radius", "drop"), [(0.01, 0.3), (0.005, 0.7), (0.02, 0.1)])
def test_an_image_tells_the_foams_pressure_and_its_patch(radius: float, drop: float) -> None:
    area, gain = disc(radius), 0.03 * float(FOAM.gain(drop))
    force = of_images().force(look(peak=drop, peak_sigma=0.03 * drop, integral=area * drop))
    assert force.newton == pytest.approx(FOAM.force("circle", drop, area))
    assert force.pressure == pytest.approx(float(FOAM.pressure(drop)))
    assert (force.sigma, force.pressure_sigma) == pytest.approx((gain * force.newton, gain * force.pressure))


def test_a_force_of_saturated_foam_says_so() -> None:
    law = of_images()
    assert law.saturates(law.force(look(peak=0.8, peak_sigma=0.12)).pressure)
    assert not law.saturates(float(FOAM.pressure(0.5))) and not law.saturates(None)
    beyond, most = (law.force(look(peak=peak)) for peak in (1.5, 0.97))
    assert beyond.newton == pytest.approx(most.newton) and beyond.pressure == most.pressure  # no image tells more


def test_of_a_known_indenter_an_image_tells_only_how_strongly_it_acts() -> None:
    area, law = disc(0.005), of_images(indenter={"radius_m": 0.005})
    drop = FOAM.flat_drop(2.0, area)
    force = law.force(look(peak=drop, peak_sigma=0.03, integral=area * drop))
    assert (force.newton, force.pressure) == pytest.approx((2.0, 2.0 / area), rel=0.01)
    assert force.sigma == pytest.approx(2.0 * float(FOAM.gain(drop)) * 0.03 / drop, rel=0.01)
    peak = replace(law, reads="peak", curve=Curve(10.0)).force(look(peak=drop, integral=area * drop))
    assert (peak.newton, peak.pressure) == pytest.approx((10.0 * drop, 10.0 * drop / area))


def test_a_law_may_read_the_peak_or_the_integral(bundle: Bundle) -> None:
    law = ForceLaw.of(configured(), with_law(bundle, of="peak"))
    force = law.force(look())
    assert force.newton == pytest.approx(3.0) and force.pressure is None and str(law) == "10 N per S/m, to 5 N"
    integral = {"of": "integral", "newtons_per_siemens_metre": 3e4, "most_n": 4}
    law = ForceLaw.of(configured(), with_law(bundle, **integral))
    assert law.force(look(peak=0.1)).newton == pytest.approx(3.0) and law.most_n == 4
    with pytest.raises(ConfigError, match="newtons_per_siemens_metre"):
        ForceLaw.of(configured(), with_law(bundle, of="integral", most_n=4))


def test_skin_toml_chooses_what_forces_are_read_from(bundle: Bundle) -> None:
    its_own, disc16 = with_law(bundle, of="peak", newtons_per_siemens=8.0), Bundle.load("disc16")
    for reads, of, newton in (("peak", bundle, 3.0), ("peak", its_own, 2.4), (None, its_own, 2.4)):
        assert ForceLaw.of(configured(reads=reads), of).force(look()).newton == pytest.approx(newton)
    law = ForceLaw.of(configured(), bundle)
    assert ForceLaw.of(configured(reads="pressure"), its_own).describe() == law.describe()
    assert not law.calibrated and law.exists and not ForceLaw.of(Skin(port="stub", bundle="disc16"), disc16).exists
    with pytest.raises(ConfigError, match=r"skins\.sole\.reads: found 'peak', .* disc16 have no scale"):
        ForceLaw.of(Skin(port="stub", bundle="disc16", reads="peak"), disc16, "sole")


def test_the_images_error_and_the_calibrations_own_are_passed_on() -> None:
    law = replace(of_images(), reads="peak", curve=Curve(10.0))
    assert law.force(look()).sigma == pytest.approx(0.3) and law.force(look(peak_sigma=0.0)).sigma is None
    force = replace(law, curve=Curve(10.0, 2.0), own_error=0.15).force(look())
    assert force.newton == pytest.approx(0.9) and force.sigma == pytest.approx(0.9 * 0.25)  # hypot(2 * 10 %, 15 %)


def test_an_indenter_that_cannot_press_this_skin_is_refused(bundle: Bundle) -> None:
    for radius in (1e-9, 0.5):
        said = rf"skins\.palm\.indenter\.radius_m: found {radius:g} m; expected 0\.000.* to 0.05 m"
        with pytest.raises(ConfigError, match=said):
            ForceLaw.of(configured(indenter={"radius_m": radius}), bundle, "palm")
    for radius in (0.001, 0.05):
        law = ForceLaw.of(configured(indenter={"radius_m": radius}), bundle)
        assert law.indenter_m2 == pytest.approx(disc(radius))
