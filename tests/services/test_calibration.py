"""A skin's own force law: what presses teach, what they may not, and the file that keeps it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from models.pressure import FOAM
from protocol.frames import EstimatedTouch, ImageFrame
from services.calibration import presses_csv as calibration_csv
from services.calibration.force_fit import CalibrationError, Press, fit, unknown
from services.calibration.force_presses import wait_for_press, wait_for_release
from services.calibration.live import missing
from services.calibration.seen import SeenTouch, TouchReader
from services.contacts.force import calibration_file as calibration
from services.contacts.force.curve import Curve
from services.contacts.force.law import ForceLaw, Quantity
from services.contacts.force.of_disc import flat_drop
from services.describe import describe, force
from services.runtime.config import ConfigError, Indenter, Skin

CONSTANT = 40.0  # N per (S/m)^0.8


def truth(peak: float, x: float, y: float) -> float:
    """The made-up skin: weaker foam towards its edge."""
    return float(CONSTANT * peak**0.8 * np.exp(0.4 * (x**2 + y**2) / 0.03**2))


def seen(peak: float, area: float, x: float = 0.0, y: float = 0.0, relative: float = 0.03) -> SeenTouch:
    """A disc, by sharp readings."""
    values = FOAM.force("circle", peak, area), peak, peak * area
    pressure, drop, integral = (Quantity(value, relative) for value in values)
    return SeenTouch(x, y, {"pressure": pressure, "peak": drop, "integral": integral})


def press(k: int, rng: np.random.Generator, scatter: float = 0.02) -> Press:
    peak, x, y = rng.uniform(0.05, 0.5), *rng.uniform(-0.03, 0.03, 2)
    area = rng.uniform(1e-4, 5e-4)  # of all sizes, so that the integral is no measure of force here
    force = truth(peak, x, y) * np.exp(scatter * rng.standard_normal())
    return Press(force, seen(peak, area, x, y), f"press {k}")


def presses(n: int, seed: int = 0, scatter: float = 0.02) -> list[Press]:
    rng = np.random.default_rng(seed)
    return [press(k, rng, scatter) for k in range(n)]


def test_the_law_of_a_skin_is_found_and_its_error_foretold() -> None:
    found = fit(presses(25))
    assert found.reads == "peak" and found.curve.correction != "none"
    fresh = presses(300, seed=1)
    off = [np.log(found.curve(p.seen.quantities["peak"].value, p.seen.x, p.seen.y) / p.force_n) for p in fresh]
    assert np.sqrt(np.mean(np.square(off))) < 0.05
    assert found.said["error"]["left_out_rms"] == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=0.6)


def of_tip(radius_m: float, n: int, seed: int, told_sd: float = 0.3) -> list[Press]:
    """Presses of one tip, whose area each tells anew to told_sd, and how strongly it acts to 0.2 %."""
    rng, area, made = np.random.default_rng(seed), np.pi * radius_m**2, []
    for k in range(n):
        force, (x, y) = float(rng.uniform(1.5, 4.0)), rng.uniform(-0.03, 0.03, 2)
        drop = FOAM.flat_drop(force, area)
        strength = area * drop / (1 - drop / 2) * np.exp(0.002 * rng.standard_normal())
        told = area * np.exp(told_sd * rng.standard_normal())
        touch = seen(float(flat_drop(strength / told)), told, float(x), float(y), relative=0.002)
        made.append(Press(force, touch, f"press {k}"))
    return made


@pytest.mark.parametrize("seed", range(3))
def test_presses_of_one_tip_that_saturates_the_foam_tell_its_size(tmp_path: Path, bundle: Bundle, seed: int) -> None:
    some = of_tip(0.006, 30, seed)
    without, found = fit(some), fit(some, any_tip=True)
    assert found.reads == "pressure" and found.tip_m == pytest.approx(0.006, rel=0.1)
    errors = [each.said["error"]["left_out_rms"] for each in (without, found)]
    assert errors[1] < 0.05 < errors[0] / 1.5
    skin = Skin(port="stub", bundle="square16")
    calibration.save(tmp_path / "law.json", found, "palm", skin, bundle)
    law = ForceLaw.of(skin.model_copy(update={"calibration": tmp_path / "law.json"}), bundle, "palm")
    assert law.curve == found.curve and law.indenter_m2 == pytest.approx(np.pi * found.tip_m**2)
    for press in of_tip(0.006, 20, 90 + seed):
        strength = press.seen.strength.value
        touch = EstimatedTouch(
            id=1, position=[press.seen.x, press.seen.y], sigma=[1e-3, 1e-3, 0.0], radius_m=0.006, radius_sigma=0.1,
            drop=0.5, drop_sigma=0.1, strength=strength, strength_sigma=0.01 * strength,
        )  # fmt: skip
        assert law.of_touch(touch).newton == pytest.approx(press.force_n, rel=0.15)


def test_a_tip_is_not_made_of_presses_that_any_size_explains() -> None:
    assert fit(of_tip(0.015, 30, 1, told_sd=0.002), any_tip=True).tip_m is None
    two = [replace(p, tip_m=mm * 1e-3) for mm in (5.0, 8.0) for p in of_tip(mm * 1e-3, 15, 2)]
    assert fit(two, any_tip=True).tip_m is None


def test_few_presses_are_not_given_many_parameters() -> None:
    found = fit(presses(6, scatter=0.1))
    assert found.curve.correction in ("none", "radius")


@pytest.mark.parametrize("seed", range(5))
def test_more_is_always_more_force(seed: int) -> None:
    curve = fit(presses(12, seed, scatter=0.15)).curve
    peaks = np.linspace(0.01, 1.5, 60)
    for x, y in ((0.0, 0.0), (0.05, -0.05), (0.5, 0.5)):
        assert (np.diff([curve(p, x, y) for p in peaks]) > 0).all()


def test_the_error_stated_is_not_that_of_the_presses_it_was_fitted_to() -> None:
    """With as many parameters as the presses allow, the fit is better than the forecast."""
    some = presses(13, seed=3, scatter=0.2)
    found = fit(some)
    own = [np.log(found.curve(p.seen.quantities[found.reads].value, p.seen.x, p.seen.y) / p.force_n) for p in some]
    assert found.said["error"]["left_out_rms"] > np.sqrt(np.mean(np.square(own)))


def test_the_integral_is_read_where_it_tells_more() -> None:
    rng = np.random.default_rng(1)
    some = []
    for k in range(15):
        peak, area = rng.uniform(0.3, 0.8), rng.uniform(1e-4, 5e-4)  # pressure does not rise as the drop does
        some.append(Press(3e4 * peak * area, seen(peak, area), f"press {k}"))
    found = fit(some)
    assert found.reads == "integral" and found.curve.exponent == 1.0 and found.curve.scale == pytest.approx(3e4)


def changed(p: Press, **more: float) -> Press:
    return replace(p, **more)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda p: p[:4], "4 presses: at least 5"),
        (lambda p: [changed(p[0], force_n=-1.0), *p[1:]], r"press 0: found a force of -1.0 N, expected one above 0"),
        (lambda p: [changed(p[0], force_n=float("nan")), *p[1:]], "press 0: found a force of nan"),
        (lambda p: [changed(q, force_n=2.0 + 0.01 * k) for k, q in enumerate(p)], "at least 1.5 times"),
        (lambda p: [changed(q, force_n=1 / q.force_n) for q in p], "harder presses do not act more strongly"),
        (lambda p: [replace(p[0], seen=seen(0.0, 1e-4)), *p[1:]], "press 0: found pressure 0.0, peak 0.0"),
    ],
)
def test_nonsense_is_refused(spoil: Callable[[list[Press]], list[Press]], expected: str) -> None:
    with pytest.raises(CalibrationError, match=expected):
        fit(spoil(presses(12)))


def test_forces_that_have_nothing_to_do_with_the_images_are_refused() -> None:
    rng = np.random.default_rng(2)
    with pytest.raises(CalibrationError):
        fit([changed(p, force_n=float(np.exp(rng.uniform(-1, 2.5)))) for p in presses(30)])


@pytest.fixture
def file(tmp_path: Path, skin: Skin, bundle: Bundle) -> Path:
    calibration.save(tmp_path / "law.json", fit(presses(25)), "palm", skin, bundle)
    return tmp_path / "law.json"


def test_the_file_gives_the_law_back(file: Path, skin: Skin, bundle: Bundle) -> None:
    law = ForceLaw.of(skin.model_copy(update={"calibration": file}), bundle, "palm")
    assert law.calibrated and law.curve == fit(presses(25)).curve
    p = presses(1, seed=9)[0]
    force = law.of_touch(of_peak(p.seen.quantities["peak"].value, p.seen.x, p.seen.y))
    assert force.newton == pytest.approx(p.force_n, rel=0.12) and force.sigma is not None
    assert 0.005 < force.sigma / p.force_n < 0.1


def test_info_names_the_file(file: Path, skin: Skin, bundle: Bundle) -> None:
    configured = skin.model_copy(update={"calibration": file})
    said = describe(configured, bundle, force(configured, bundle), None)
    digest = calibration.save(file, fit(presses(25)), "palm", skin, bundle)
    again = describe(configured, bundle, force(configured, bundle), None)
    assert len(said["calibration_hash"]) == 64 and again["calibration_hash"] == digest
    assert said["force_law"]["calibrated"] and said["force_law"]["of"] == "peak"


def test_a_file_of_something_else_is_refused(file: Path, skin: Skin, bundle: Bundle) -> None:
    def refused(expected: str, skin: Skin = skin, bundle: Bundle = bundle, name: str = "palm") -> None:
        with pytest.raises(ConfigError, match=expected):
            calibration.load(file, skin, bundle, name)

    calibration.load(file, skin, bundle, "palm")
    refused("belongs to skin 'palm', not to 'heel'", name="heel")
    refused("was made with bundle square16", bundle=replace(bundle, hash="0" * 64))
    refused("indenter of radius None", skin=skin.model_copy(update={"indenter": Indenter(radius_m=0.01)}))
    text = file.read_text()
    file.write_text(text.replace('"most_n": ', '"most_n": 1'))
    refused("changed or damaged")
    file.write_text(text.replace("eitskin.force/2", "eitskin.force/9"))
    refused("schema 'eitskin.force/9', this program reads eitskin.force/2")
    for other in ("[]", "nonsense", '{"newtons_per_siemens": -3}', json.dumps({"schema": "eitskin.force/2"})):
        file.write_text(other)
        refused("is no calibration of forces")


def test_a_curve_that_falls_is_none() -> None:
    good = Curve(2.0, 0.7, "tilt", (0.1, 0.2), 0.03).to_dict()
    assert Curve.from_dict(good).exponent == 0.7
    for bad in ({"exponent": -1.0}, {"scale": 0.0}, {"correction": "wavy"}, {"coefficients": [0.1]}):
        with pytest.raises(ValueError, match="above 0|correction"):
            Curve.from_dict(good | bad)


def test_presses_survive_the_csv(tmp_path: Path) -> None:
    some = presses(8)
    calibration_csv.write(tmp_path / "p.csv", some)
    back = calibration_csv.read(tmp_path / "p.csv")
    assert [p.force_n for p in back] == [p.force_n for p in some]
    for of, quantity in some[3].seen.quantities.items():
        found = back[3].seen.quantities[of]
        assert (found.value, found.relative) == pytest.approx((quantity.value, 0.03), rel=1e-5)


def test_presses_that_were_read_by_another_indenter_are_refused(tmp_path: Path) -> None:
    calibration_csv.write(tmp_path / "p.csv", presses(8), indenter_m=0.01)
    assert len(calibration_csv.read(tmp_path / "p.csv", 0.01)) == 8
    calibration_csv.write(tmp_path / "third.csv", presses(8), indenter_m=0.01 / 3)  # not to the last digit there
    assert len(calibration_csv.read(tmp_path / "third.csv", 0.01 / 3)) == 8
    with pytest.raises(CalibrationError, match="line 2, column indenter_m: found 0.01, skin.toml names None"):
        calibration_csv.read(tmp_path / "p.csv")


HEAD = "force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "line 1: found columns none; missing force_n"),
        ("force_n,x_m\n1,2\n", "line 1: found columns force_n, x_m; missing y_m, pressure_n"),
        ("force_n,row\n1,2\n", "or --measurements FILE.npz"),
        (HEAD + "1,0,0,1,0.1,1e-5\n\ntwo,0,0,1,0.1,1e-5\n", "line 4, column force_n: found 'two'"),
        (HEAD + "1,0,0,1,0.1\n", "line 2, column integral_s_m: found '', expected a number above 0"),
        (HEAD + "0,0,0,1,0.1,1e-5\n", "line 2, column force_n: found '0', expected a number above 0"),
        (HEAD + "1,0,nan,1,0.1,1e-5\n", "line 2, column y_m: found 'nan'"),
    ],
)
def test_errors_of_the_csv_name_line_and_column(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(CalibrationError, match=expected.replace("(", r"\(")):
        calibration_csv.read(tmp_path / "p.csv")


def of_peak(peak: float, x: float, y: float) -> EstimatedTouch:
    """A disc of 10 mm, as the measurements tell it."""
    acts = peak / (1 - peak / 2) * math.pi * 0.01**2
    return EstimatedTouch(
        id=1,
        position=[x, y],
        sigma=[2e-4, 2e-4, 0.0],
        radius_m=0.01,
        radius_sigma=0.02,
        drop=peak,
        drop_sigma=0.02 * peak,
        strength=acts,
        strength_sigma=0.01 * acts,
    )


@pytest.fixture
def reader(skin: Skin, bundle: Bundle) -> TouchReader:
    return TouchReader(skin, bundle)


class Images:
    """What comes, 22 image frames a second, and the clock that goes with it."""

    def __init__(self, peaks: Callable[[float], list[float]]) -> None:
        self.peaks, self.now = peaks, 0.0

    def clock(self) -> float:
        return self.now

    def recv(self, timeout_s: float = 0.0) -> ImageFrame:
        self.now += 1 / 22
        touches = [of_peak(peak, -0.02 + 0.04 * k, 0.0) for k, peak in enumerate(self.peaks(self.now))]
        now_ns = int(self.now * 1e9)
        return ImageFrame(skin="palm", valid=True, touched=bool(touches), estimates=touches, stamps={"sample": now_ns})


def test_a_press_counts_once_it_is_steady(reader: TouchReader) -> None:
    rng = np.random.default_rng(0)
    images = Images(lambda t: [] if t < 2 else [0.3 * min((t - 2) / 3, 1) * (1 + 0.01 * rng.standard_normal())])
    found = wait_for_press(images, reader, images.clock)
    assert found.quantities["peak"].value == pytest.approx(0.3, rel=0.03)
    assert (found.x, found.y) == pytest.approx((-0.02, 0.0))
    assert 6 < images.now < 8


def test_no_press_and_two_presses_are_told_apart(reader: TouchReader) -> None:
    for peaks, expected in (
        ([], "nothing touches"),
        ([0.3, 0.2], "2 touches at once"),
        (None, "the touch still changes by"),
    ):
        images = Images(lambda t, p=peaks: [0.2 + 0.15 * np.sin(3 * t)] if p is None else p)  # type: ignore[misc]
        with pytest.raises(CalibrationError, match=expected):
            wait_for_press(images, reader, images.clock, 10.0)
    held = Images(lambda t: [0.3])
    with pytest.raises(CalibrationError, match="still touches"):
        wait_for_release(held, held.clock, 3.0)


def of_foam(radius_mm: float, newton: float, stiffness: float, tip: bool) -> Press:
    """A press of foam `stiffness` times as stiff as the shipped, as a sharp image shows it."""
    area = math.pi * (radius_mm * 1e-3) ** 2
    shown = seen(FOAM.flat_drop(newton / stiffness, area), area)
    return Press(newton, shown, f"{newton} N", radius_mm * 1e-3 if tip else None)


def test_what_a_law_is_known_to_covers_how_much_tips_differ() -> None:
    """A law of both errs by 3 % for each of two tips that differ by 6 %, however many presses there are."""
    forces = np.linspace(0.5, 3.0, 40)
    differ = [of_foam(mm, f, of, True) for mm, of in ((7.0, 1.03), (14.0, 0.97)) for f in forces]
    error = fit(differ).said["error"]
    assert error["scatter"] < 0.01 < 0.02 < error["law"] < 0.04
    alike = fit([of_foam(mm, f, 1.0, True) for mm in (7.0, 14.0) for f in forces]).said["error"]
    one = fit([of_foam(7.0, f, 1.0, True) for f in forces]).said["error"]
    assert alike["law"] < 0.02 and one["law"] == one["scatter"]


def test_presses_of_two_tips_choose_pressure_and_one_says_what_it_cannot_know(skin: Skin) -> None:
    forces = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
    two = fit([of_foam(mm, f, 1.4, True) for mm in (7.0, 14.0) for f in forces])
    assert two.reads == "pressure" and two.curve.scale == pytest.approx(1.4, rel=0.08)
    assert two.said["tips_m"] == pytest.approx([0.007, 0.014]) and unknown(two, skin) == ""
    one = fit([of_foam(10.0, f, 1.4, True) for f in forces])
    assert "one tip, radius 10 mm" in unknown(one, skin) and "press with two tips" in unknown(one, skin)
    nobody = fit([of_foam(10.0, f, 1.4, False) for f in forces])
    assert "nobody said what pressed" in unknown(nobody, skin)
    assert unknown(one, skin.model_copy(update={"indenter": Indenter(radius_m=0.01)})) == ""


def test_a_second_tip_is_pressed_too_before_it_is_enough() -> None:
    """The presses of the first tip are many; one of the second tells little of it."""

    def all_over(mm: float, count: int) -> list[Press]:
        made = (of_foam(mm, f, 1.0, True) for f in np.linspace(0.5, 3.0, count))
        corners = ((0.01, 0.01), (-0.01, 0.01), (-0.01, -0.01), (0.01, -0.01))
        return [replace(p, seen=replace(p.seen, x=x, y=y)) for p, (x, y) in zip(made, corners * count, strict=False)]

    first = all_over(7.0, 20)
    assert missing(first, fit(first)) == ""
    second = all_over(14.0, 10)
    one, every = first + second[:1], first + second
    assert missing(one, fit(one)) == "9 more presses of this tip at least"
    assert "of this tip" not in missing(every, fit(every))
