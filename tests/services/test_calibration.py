"""A skin's own force law: what presses teach, what they may not, its file; what a reference says of a press."""

import math
import re
import time
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from models.pressure import FOAM
from models.shapes import Shape
from protocol.frames import EstimatedTouch, ReferenceFrame
from protocol.runtime import host_id
from services.calibration import collecting, presses_csv
from services.calibration.collecting import Collected, Collector
from services.calibration.force_fit import CalibrationError, Press, fit, unknown
from services.calibration.force_presses import of_file
from services.calibration.presses import read_presses
from services.calibration.reference import MOST_GAP_S, Doubtful, PressCourse, ReferenceForce
from services.calibration.seen import SeenTouch, TouchReader
from services.contacts.force import calibration_file as calibration
from services.contacts.force.curve import Curve
from services.contacts.force.law import ForceLaw, Quantity
from services.describe import describe, force
from services.runtime.config import ConfigError, Indenter, Skin
from tests.services.stub_skin import StubSkin, transfer


def seen(peak, area, x=0.0, y=0.0, relative=0.03):
    """A disc, by sharp readings."""
    values = {"pressure": FOAM.force("circle", peak, area), "peak": peak, "integral": peak * area}
    return SeenTouch(x, y, {of: Quantity(value, relative) for of, value in values.items()})


def presses(n, seed=0, scatter=0.02):
    """Of a made-up skin, 40 N per (S/m)^0.8, weaker foam towards its edge; areas of all sizes."""
    rng, made = np.random.default_rng(seed), []
    for k in range(n):
        peak, x, y, area = rng.uniform(0.05, 0.5), *rng.uniform(-0.03, 0.03, 2), rng.uniform(1e-4, 5e-4)
        newton = 40.0 * peak**0.8 * np.exp(0.4 * (x**2 + y**2) / 0.03**2 + scatter * rng.standard_normal())
        made.append(Press(float(newton), seen(peak, area, x, y), f"press {k}"))
    return made


def off(found, some):
    """rms of log force."""
    by = [np.log(found.curve(p.seen.quantities[found.reads].value, p.seen.x, p.seen.y) / p.force_n) for p in some]
    return float(np.sqrt(np.mean(np.square(by))))


def test_the_law_of_a_skin_is_found_and_its_error_foretold():
    found = fit(presses(25))
    assert found.reads == "peak" and found.curve.correction != "none"
    fresh = off(found, presses(300, seed=1))
    assert fresh < 0.05 and found.origin["error"]["left_out_rms"] == pytest.approx(fresh, rel=0.6)
    assert fit(presses(6, scatter=0.1)).curve.correction in ("none", "radius"), "few presses: few parameters"
    some = presses(13, seed=3, scatter=0.2)  # with as many as they allow, the fit is better than the forecast
    assert (many := fit(some)).origin["error"]["left_out_rms"] > off(many, some)
    for x, y in ((0.0, 0.0), (0.05, -0.05), (0.5, 0.5)):
        assert (np.diff([many.curve(p, x, y) for p in np.linspace(0.01, 1.5, 60)]) > 0).all(), "more is more force"


def test_the_law_is_no_law_where_forces_have_nothing_to_do_with_the_images():
    p, rng = presses(12), np.random.default_rng(2)
    for some, expected in (
        (p[:4], "4 presses: at least 5"),
        *(([replace(p[0], force_n=f), *p[1:]], f"press 0: found a force of {f} N") for f in (-1.0, float("nan"))),
        ([replace(q, force_n=2.0 + 0.01 * k) for k, q in enumerate(p)], "at least 1.5 times"),
        ([replace(q, force_n=1 / q.force_n) for q in p], "harder presses do not act more strongly"),
        ([replace(p[0], seen=seen(0.0, 1e-4)), *p[1:]], "press 0: found pressure 0.0, peak 0.0"),
        ([replace(q, force_n=float(np.exp(rng.uniform(-1, 2.5)))) for q in presses(30)], "."),
    ):
        with pytest.raises(CalibrationError, match=expected):
            fit(some)


@pytest.fixture
def file(tmp_path, skin, bundle):
    calibration.save(tmp_path / "law.json", fit(presses(25)), "palm", skin, bundle)
    return tmp_path / "law.json"


def test_the_file_gives_the_law_back_and_info_names_it(file, skin, bundle):
    configured = skin.model_copy(update={"calibration": file})
    law = ForceLaw.of(configured, bundle, "palm")
    assert law.calibrated and law.curve == fit(presses(25)).curve
    p = presses(1, seed=9)[0]
    found = law.of_touch(of_peak(p.seen.quantities["peak"].value, p.seen.x, p.seen.y))
    assert found.newton == pytest.approx(p.force_n, rel=0.12) and 0.005 < found.sigma / p.force_n < 0.1
    digest = calibration.save(file, fit(presses(25)), "palm", skin, bundle)
    said = describe(configured, bundle, force(configured, bundle), None)
    assert len(digest) == 64 and said["calibration_hash"] == digest
    assert said["force_law"]["calibrated"] and said["force_law"]["of"] == "peak"


def test_a_file_of_something_else_is_refused(file, skin, bundle):
    def refused(expected, skin=skin, bundle=bundle, name="palm"):
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
    good = Curve(2.0, 0.7, "tilt", (0.1, 0.2), 0.03).to_dict()
    assert Curve.from_dict(good).exponent == 0.7
    for bad in ({"exponent": -1.0}, {"scale": 0.0}, {"correction": "wavy"}, {"coefficients": [0.1]}):
        with pytest.raises(ValueError, match="above 0|correction"):
            Curve.from_dict(good | bad)
    for other in ("[]", '{"newtons_per_siemens": -3}', '{"schema": "eitskin.force/2"}'):
        file.write_text(other)
        refused("is no calibration of forces")


def test_presses_survive_the_csv_but_not_for_another_indenter_and_errors_name_line_and_column(tmp_path):
    some, file = presses(8), tmp_path / "p.csv"
    presses_csv.write(file, some)
    back = presses_csv.read(file)
    assert [p.force_n for p in back] == [p.force_n for p in some]
    for of, quantity in some[3].seen.quantities.items():
        found = back[3].seen.quantities[of]
        assert (found.value, found.relative) == pytest.approx((quantity.value, 0.03), rel=1e-5)
    for radius_m in (0.01 / 3, 0.01):  # a third: not to the last digit there
        presses_csv.write(file, some, indenter_m=radius_m)
        assert len(presses_csv.read(file, radius_m)) == 8
    with pytest.raises(CalibrationError, match="line 2, column indenter_m: found 0.01, skin.toml names None"):
        presses_csv.read(file)
    head = "force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m\n"
    for text, expected in (
        ("force_n,x_m\n1,2\n", "line 1: found columns force_n, x_m; missing y_m, pressure_n"),
        (head + "1,0,0,1,0.1,1e-5\n\ntwo,0,0,1,0.1,1e-5\n", "line 4, column force_n: found 'two'"),
        (head + "1,0,nan,1,0.1,1e-5\n", "line 2, column y_m: found 'nan'"),
    ):
        file.write_text(text)
        with pytest.raises(CalibrationError, match=expected):
            presses_csv.read(file)


def estimated(x, y, radius_m, drop, acts, relative):
    """A disc, as the measurements tell it."""
    return EstimatedTouch(
        id=1, position=[x, y], sigma=[2e-4, 2e-4, 0.0], radius_m=radius_m, radius_sigma=relative, drop=drop,
        drop_sigma=relative * drop, strength=acts, strength_sigma=0.01 * acts,
    )  # fmt: skip


def of_peak(peak, x, y):
    return estimated(x, y, 0.01, peak, peak / (1 - peak / 2) * math.pi * 0.01**2, 0.02)


def of_foam(radius_mm, newton, stiffness, tip=True):
    """A press of foam `stiffness` times as stiff as the shipped, as a sharp image shows it."""
    area = math.pi * (radius_mm * 1e-3) ** 2
    shown = seen(FOAM.flat_drop(newton / stiffness, area), area)
    return Press(newton, shown, f"{newton} N", radius_mm * 1e-3 if tip else None)


def test_presses_of_two_tips_choose_pressure_and_one_says_what_it_cannot_know(skin):
    forces = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
    differ = fit([of_foam(mm, f, of) for mm, of in ((7.0, 1.03), (14.0, 0.97)) for f in forces]).origin["error"]
    assert differ["scatter"] < 0.01 < 0.02 < differ["law"] < 0.04, "tips differ, however many presses there are"
    two = fit([of_foam(mm, f, 1.4) for mm in (7.0, 14.0) for f in forces])
    assert two.origin["error"]["law"] < 0.02
    assert two.reads == "pressure" and two.curve.scale == pytest.approx(1.4, rel=0.08)
    assert two.origin["tips_m"] == pytest.approx([0.007, 0.014]) and unknown(two, skin) == ""
    one = fit([of_foam(10.0, f, 1.4) for f in forces])
    assert "one tip, radius 10 mm" in unknown(one, skin) and "press with two tips" in unknown(one, skin)
    assert "nobody said what pressed" in unknown(fit([of_foam(10.0, f, 1.4, False) for f in forces]), skin)
    assert unknown(one, skin.model_copy(update={"indenter": Indenter(radius_m=0.01)})) == ""


SKIN = Skin(port="stub", bundle="square16", frame_id="palm", network="none")
PRESS, OTHER = (Shape("circle", 0.4, -0.2, 0.2, 0.3),), Shape("circle", -0.5, 0.5, 0.2, 0.3)


class Frames:
    """Raw and image frames of the stub's skin, scan after scan, `shapes` on it; `late`: raw ones after their images."""

    def __init__(self, late):
        self.stub, self.now, self.shapes = StubSkin(80.0, skin=SKIN), 0.0, ()
        self._late, self._ready, self._run, self._raws = late, deque(), self.stub.pipeline.run, []
        self.clock = lambda: self.now
        self.stub.pipeline.run = lambda raw: (self._raws.append(raw), self._run(raw))[1]

    def recv(self, timeout_s=0.0):
        if timeout_s == 0.0:
            self._ready.clear()
            return None
        if not self._ready:
            self.now += 0.045
            self._ready.extend([self.stub.feel(self.shapes).image, self._raws[-1]])
            self._ready.rotate(0 if self._late else 1)
        return self._ready.popleft()


@pytest.mark.parametrize("late", [False, True])
def test_a_press_is_measured_against_the_scans_just_before(bundle, late):
    frames = Frames(late)
    collector = Collector(frames, TouchReader(SKIN, bundle), frames.clock, patience_s=5.0)
    before = collector.untouched()
    with pytest.raises(CalibrationError, match="no steady press within 5 s: nothing touches"):
        collector.pressed()
    frames.shapes = (*PRESS, OTHER)
    with pytest.raises(CalibrationError, match="2 touches at once"):
        collector.pressed()
    frames.shapes = PRESS
    touched, seen = collector.pressed()
    measure, pattern = frames.stub.analog.measure, frames.stub.pattern
    for found, t in ((before, transfer()), (touched, transfer(PRESS))):
        np.testing.assert_allclose(found, np.abs(measure((t, t), pattern, SKIN.setting, 4e4, 0.0)[0]), rtol=5e-4)
    assert np.abs(touched / before - 1).max() > 0.01 and (seen.x, seen.y) == pytest.approx((0.02, -0.01), abs=2e-3)
    with pytest.raises(CalibrationError, match="no untouched scans within 5 s: something touches"):
        collector.untouched()


def test_the_file_is_what_register_and_calibrate_force_read(bundle, tmp_path):
    rng, z0 = np.random.default_rng(0), np.asarray(bundle.z0)
    presses = [Collected(0.001 * k, -0.002 * k, 1.0 + k, z0 * (1 + 1e-2 * rng.random(len(z0))), z0) for k in range(24)]
    file, rows = tmp_path / "presses.npz", []
    forces = collecting.write(file, presses, bundle.pattern)
    with np.load(file) as arrays:
        found = read_presses(dict(arrays), bundle)
    np.testing.assert_allclose(found.xy, [(p.x, p.y) for p in presses])
    np.testing.assert_allclose(found.difference, [p.touched / p.untouched - 1 for p in presses])
    read = presses_csv.read(forces, None, lambda row: (rows.append(row), SeenTouch(0.0, 0.0, {}))[1])
    assert forces == tmp_path / "presses.csv"
    assert [p.force_n for p in read] == [p.force_n for p in presses] and rows == list(range(24))
    of_file(file, SKIN, bundle, lambda text: None)  # reads measurements and reference
    assert collecting.write(tmp_path / "unknown.npz", [Collected(0.0, 0.0, None, z0, z0)], bundle.pattern) is None


BEGAN, ENDED, STEADY, NEWTON, RATE_HZ, START_S = 2.0, 6.0, (3.5, 5.0), 3.0, 100, time.monotonic() - 60.0


def pressed(t):
    """Share of a press's force over time."""
    return np.clip(np.minimum(t - BEGAN, ENDED - t) / 0.2, 0.0, 1.0)


def course():
    t = np.arange(0.0, 8.0, 0.045)
    steady = (START_S + STEADY[0], START_S + STEADY[1])
    return PressCourse(START_S + t, 2e-5 * pressed(t), START_S + BEGAN, steady, START_S + ENDED)


def reading(at, force_n=1.0, **more):
    said = {"valid": True, "force_n": force_n, "stamps": {"sample": int(at * 1e9)}} | more
    return ReferenceFrame(skin="palm", host=host_id(), **said)


@pytest.fixture
def reference():
    yield (made := ReferenceForce("palm"))
    made.close()


def listen(reference, force, delay_s=0.0, lost=lambda t: False):
    noise = np.random.default_rng(2)
    for k, t in enumerate(np.arange(0.0, 8.0, 1 / RATE_HZ)):
        said, at = float(force(np.array(t - delay_s))) + 0.02 * noise.standard_normal(), START_S + t
        if not lost(t):
            reference.take(reading(at, said, seq=k), at + 0.01)


def scale(t):
    return NEWTON * pressed(t) - 7.0


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.45])
def test_its_rise_is_the_force_whatever_its_zero_and_delay(reference, delay_s):
    """A force that creeps is that of its own time: with the delay left out the mean would be off by 4 %."""
    middle, lost = NEWTON * (1 + 0.04 * (np.mean(STEADY) - BEGAN)), lambda t: t * RATE_HZ % 10 > 7  # three in ten
    crept = lambda t: NEWTON * pressed(t) * (1 + 0.04 * np.clip(t - BEGAN, 0, 4)) - 7.0 + 1.0 * (t < 1.2)  # noqa: E731
    listen(reference, crept, delay_s, lost)
    assert reference.force(course()) == pytest.approx(middle, rel=0.01)
    assert reference.delay_s == pytest.approx(delay_s, abs=0.0101)


@pytest.mark.parametrize(("force", "more", "why"), [
    (lambda t: -scale(t), {}, "fell while the skin was pressed.*change its sign"),
    (scale, {"delay_s": 0.8}, "0.8 s late, expected 0.5 s at most"),
    (lambda t: np.sin(3 * t), {}, "does not follow the press"),
    (scale, {"lost": lambda t: 4.0 < t < 4.4}, f"dropped out for 0.4. s of it, expected {MOST_GAP_S:g} s"),
    (scale, {"lost": lambda t: t < 1.9}, "found 0 readings of the reference in the 0.5 s before the touch"),
    (lambda t: (1 + 0.3 * np.sin(9 * t)) * NEWTON * pressed(t), {}, "changed by .* %.*hold still"),
])  # fmt: skip
def test_what_is_doubtful_is_no_force(reference, force, more, why):
    listen(reference, force, **more)
    with pytest.raises(Doubtful, match=why):
        reference.force(course())


UNUSABLE = [
    ({"force_n": float("nan")}, "found a force of nan N.*expected a number"),
    ({"valid": False, "reasons": ["clock"]}, r"not valid \(clock\)"),
    ({"stamps": {"sample": int((START_S - 3) * 1e9)}}, "3.0 s after its stamp `sample`"),
]


@pytest.mark.parametrize(("change", "why"), UNUSABLE)
def test_what_cannot_be_used_is_said_and_is_no_reading(reference, change, why):
    now = START_S
    assert "no message of reference/palm has come" in reference.trouble(now)
    reference.take(reading(now), now)
    assert reference.trouble(now) == ""
    reference.take(reading(now, **change), now)
    assert re.search(why, reference.trouble(now)) and "silent for more than" in reference.trouble(now + 5)
    reference.take(reading(now), now + 6)
    reference.take(reading(now + 6, session="f" * 16), now + 6)
    assert "two programs publish reference/palm" in reference.trouble(now + 6)
