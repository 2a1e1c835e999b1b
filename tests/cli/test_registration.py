"""Registration: known similarities are found again; a real skin is located as docs/figures.md says."""

import numpy as np
import pytest

from models.bundle import Bundle
from models.locator import NINETY, Locator
from models.locator_arrays import arrays_of
from services.calibration.fields import half_width, sample, sensitivities
from services.calibration.locating import build, true_places
from services.calibration.presses import RegistrationError, part, read_presses
from services.calibration.register_command import register_presses
from services.calibration.registration import KnownPose, Similarity, register
from services.pipeline import Pipeline
from services.recordings.file_source import file_frame
from services.recordings.npz_file import frames_of, load_npz, read_scans
from services.runtime.config import Skin, load
from tests import needs

PLAIN = Similarity(0.4, 1.0, np.zeros(2), False)
DISC = "hydrogel_disc16.npz"


@pytest.fixture(scope="module")
def bundle():
    return Bundle.load("disc16")


def presses_of(bundle, true, n=60, reach=0.8, noise=1e-3, strength=1.0):
    """What a skin lying at `true` in the machine's frame would measure: every measurement with a gain of its own."""
    rng = np.random.default_rng(8)
    radius, angle = reach * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 2 * np.pi, n)
    places = half_width(bundle) * np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    signal = sample(sensitivities(bundle, 1.5), places, half_width(bundle))
    signal *= 0.02 / np.abs(signal).mean()
    signal *= rng.uniform(0.2, 2.0, signal.shape[1]) * np.reshape(strength, (-1, 1))
    before = rng.uniform(100, 200, (1, signal.shape[1])) * (1 + noise * rng.standard_normal(signal.shape))
    after = before * (1 + signal + noise * rng.standard_normal(signal.shape))
    return {"untouched": before, "touched": after, "xy": true.to_machine(places)}


@pytest.mark.parametrize(
    "true",
    [PLAIN, Similarity(-1.9, 1.2, np.array([0.012, -0.02]), False), Similarity(2.6, 0.9, -np.ones(2) / 50, True)],
)
def test_a_known_similarity_is_found(bundle, true):
    made = register(read_presses(presses_of(bundle, true), bundle), bundle)
    found = made.similarity
    assert found.mirrored == true.mirrored and made.explained > 0.9 and not made.doubts
    assert abs(np.angle(np.exp(1j * (found.angle - true.angle)))) < max(0.04, 6 * made.sigma["angle"]) < 0.3
    corners = 0.05 * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1.0]])
    assert np.linalg.norm(found.to_machine(corners) - true.to_machine(corners), axis=1).max() < 4e-3
    assert np.allclose(true.to_skin(true.to_machine(corners)), corners)
    turned = true.to_machine(np.eye(2)) - true.to_machine(np.zeros((2, 2)))
    assert np.isclose(np.linalg.det(turned), (-1 if true.mirrored else 1) * true.scale**2)


class Split:
    """Presses of the reference data that a map is made of, and others that it finds."""

    def __init__(self, bundle, train, test, shuffle=0):
        arrays = load_npz(needs.reference(DISC))
        count = len(arrays["xy"])
        order = np.random.default_rng(shuffle).permutation(count) if shuffle else np.arange(count)
        self.train, self.test = (read_presses(part(arrays, order[rows]), bundle) for rows in (train, test))
        similarity = register(self.train, bundle).similarity
        self.made, _, self.crossed = build(self.train, similarity, bundle)
        locator, scale = Locator(self.made), self.train.unit / self.test.unit
        self.found = [locator.locate(d * scale, self.train.noise) for d in self.test.difference]
        off = np.array([[t[0].x, t[0].y] for t in self.found]) - true_places(self.test.xy, similarity)
        self.error = np.linalg.norm(off, axis=1)  # m, from where a press was to where it is found
        square = [a @ np.linalg.solve(t[0].covariance, a) for a, t in zip(off, self.found, strict=True)]
        self.beyond = np.sqrt(np.array(square) / NINETY)  # of the ellipse that 90 % are said to lie in


def test_real_presses_are_found_within_3_mm(bundle):
    """Median over 200 presses that took no part, after 100 that did: 2.5 mm. (A plain one-step image: 14.9 mm.)"""
    real = Split(bundle, slice(0, 100), slice(100, 300))
    assert np.median(real.error) < 0.004 and real.error.mean() < 0.005
    assert abs(np.median(real.crossed.distance) - np.median(real.error)) < 0.0015  # what registration says of itself
    assert 0.54 < np.sqrt(np.mean(real.beyond**2)) < 0.75  # 0.66 where exactly 90 % lie within
    assert sum(len(t) == 1 for t in real.found) >= 190
    depth = np.array([t[0].value for t in real.found])
    assert np.abs(depth - real.test.value).mean() < 0.0025  # their mean depth is off by 4


def test_ten_real_presses_are_enough_to_begin_with_and_say_that_they_know_little(bundle):
    """A shuffle that leaves much of the skin untouched."""
    few = Split(bundle, slice(0, 10), slice(10, 500), shuffle=6)
    assert np.median(few.error) < 0.02
    assert np.mean(few.beyond <= 1) >= 0.85 and np.sqrt(np.mean(few.beyond**2)) < 0.71
    far, sigma = few.error > 0.03, np.array([t[0].sigma[0] for t in few.found])  # where it is wrong, it says so
    assert far.sum() > 50 and np.median(sigma[far]) > 0.03
    arrays = {name: np.asarray(value) for name, value in vars(few.made).items()}
    for name, wrong in (("map", few.made.map[:-1]), ("error", few.made.error * np.nan), ("shape", np.array([0, 5]))):
        with pytest.raises(ValueError, match=name):  # a bundle that holds it is refused
            arrays_of(arrays | {name: wrong}, 192)


def test_what_is_told_of_a_skin_is_kept(bundle):
    presses = read_presses(presses_of(bundle, Similarity(0.4, 1.1, np.zeros(2), True), n=12), bundle)
    found = register(presses, bundle, KnownPose(0.16 * 1.1, 0.4, True)).similarity
    assert found.mirrored and abs(found.scale / 1.1 - 1) < 0.025 and abs(found.angle - 0.4) < np.radians(6)
    with pytest.raises(RegistrationError, match="--numbering"):  # told wrongly: no pose explains these presses
        register(presses, bundle, KnownPose(clockwise=False))
    with pytest.raises(RegistrationError, match="presses lie inside the skin"):
        register(presses, bundle, KnownPose(diameter_m=0.05))


def test_a_skin_is_no_larger_than_physics_allows(bundle):
    arrays = presses_of(bundle, PLAIN, n=80, reach=0.35)
    made = register(read_presses(arrays, bundle), bundle)
    xy = arrays["xy"]
    radius = np.linalg.norm(xy - 0.5 * (xy.min(axis=0) + xy.max(axis=0)), axis=1).max()
    assert 0.99 * radius < made.similarity.scale * half_width(bundle) < 1.61 * radius
    assert any("--diameter" in doubt for doubt in made.doubts)
    told = register(read_presses(arrays, bundle), bundle, KnownPose(diameter_m=0.16))
    assert abs(told.similarity.scale - 1.0) < 0.025 and told.explained > made.explained


def test_presses_that_register_no_skin_are_refused(bundle):
    many = presses_of(bundle, PLAIN)
    for arrays, says in (
        (many | {"xy": many["xy"][np.random.default_rng(3).permutation(60)]}, "row n of xy"),
        (presses_of(bundle, PLAIN, n=9), "at least 10"),
        (many | {"xy": np.zeros((60, 2))}, "spread them"),
        (many | {"xy": np.zeros((60, 3))}, r"expected \(60, 2\)"),
        (many | {"touched": np.ones((59, 192))}, "one row per press"),
        (many | {"untouched": np.zeros((60, 192))}, "untouched value above 0"),
        (many | {"touched": np.full((60, 192), np.nan)}, "are finite"),
    ):
        with pytest.raises(RegistrationError, match=says):
            register(read_presses(arrays, bundle), bundle)


def test_equal_untouched_rows_say_nothing_of_noise(bundle):
    """Neither none nor 60 dB: what the presses themselves leave unexplained."""
    arrays, rng = presses_of(bundle, PLAIN, n=80, noise=0.0), np.random.default_rng(11)
    for level in (4e-3, 4e-4):
        touched = arrays["touched"] * (1 + level * rng.standard_normal(arrays["touched"].shape))
        untouched = np.broadcast_to(arrays["untouched"][:1], touched.shape).copy()
        noise = read_presses(arrays | {"touched": touched, "untouched": untouched}, bundle).noise
        assert 0.4 * level < np.median(noise) < 2.5 * level


def test_presses_and_measurements_that_are_missing_are_left_out(bundle):
    """A dead measurement, a press of which nothing came, one with a gap, and one twice: the others tell as before."""
    arrays = presses_of(bundle, PLAIN, n=80)
    whole = register(read_presses(arrays, bundle), bundle).similarity
    arrays = {name: np.vstack([a, a[:1]]) for name, a in arrays.items()}
    arrays["touched"][5] = np.nan
    arrays["touched"][6, 3] = np.inf
    arrays["untouched"][:, 17] = 0.0
    presses = read_presses(arrays, bundle)
    assert presses.left_out == 2 and len(presses) == 79
    assert not presses.measured[17] and presses.measured.sum() == 191
    found = register(presses, bundle).similarity
    assert np.linalg.norm(found.to_machine(np.eye(2) * 0.05) - whole.to_machine(np.eye(2) * 0.05)) < 4e-3
    made, _, crossed = build(presses, found, bundle)
    assert np.median(crossed.distance) < 0.004
    touch = Locator(made).locate(presses.difference[9], np.full(192, 1e-3))[0]
    gone = np.where(np.arange(192) % 5 == 0, np.inf, 1e-3)  # a fifth of the measurements is lost later
    without = Locator(made).locate(np.where(np.isfinite(gone), presses.difference[9], 0.0), gone)[0]
    assert np.hypot(touch.x - without.x, touch.y - without.y) < 0.004


def test_contacts_of_a_registered_skin_say_how_deep_and_how_sure(bundle, tmp_path):
    """Through the stages, from differences alone; a skin that was not registered says nothing of either."""
    arrays, rows = load_npz(needs.reference(DISC)), slice(120, 130)
    relative = arrays["touched"] / arrays["untouched"] - 1
    file = {"pattern": arrays["pattern"], "delta": 500.0 * relative, "xy": arrays["xy"], "depth": arrays["depth"]}
    register_presses(file, "disc16", 120, tmp_path / "mine")

    def contacts_of(path):
        own, contacts = Bundle.load(path), []
        skin, data = Skin(port="stub", bundle=path, frame_id="skin"), read_scans(part(file, rows), own)
        pipeline = Pipeline(skin, bundle=own)
        for scan, (values, kind) in enumerate(frames_of(data), start=1):
            frame = pipeline.run(file_frame("skin", "opposite", scan, values, kind, scan * 45_000_000, data.separate))
            if kind == "full":
                contacts += [c for c in frame.contact.contacts if c.state != "end"][:1]
        return contacts

    unknown, contacts = contacts_of("disc16"), contacts_of(str(tmp_path / "mine"))
    assert len(unknown) == len(contacts) == 10
    assert all(c.position_sigma is None and c.indentation_m is None for c in unknown)
    assert np.abs(np.array([c.indentation_m for c in contacts]) - arrays["depth"][rows]).mean() < 0.0035
    assert all(0 < c.position_sigma[1] <= c.position_sigma[0] < 0.02 for c in contacts)


def test_forces_are_told_where_the_file_has_them(bundle):
    force = np.random.default_rng(5).uniform(1, 5, 120)
    presses = read_presses(presses_of(bundle, PLAIN, n=120, strength=force / 3) | {"force": force}, bundle)
    made, _, crossed = build(presses, register(presses, bundle).similarity, bundle)
    found = Locator(made).locate(presses.difference[0], presses.noise)[0]
    assert Locator(made).quantity == "force_n" and np.abs(crossed.value_error).mean() < 0.3
    assert abs(found.value - presses.value[0]) < 6 * found.value_sigma + 0.1


@pytest.mark.live
def test_readme_s_real_skin_works_word_for_word(skin, bundle, tmp_path, monkeypatch):
    """Registered, imported, replayed from another folder, on presses of a skin turned, larger and moved."""
    true = Similarity(0.7, 1.25, np.array([0.01, -0.02]), False)
    np.savez(tmp_path / "FILE.npz", pattern=bundle.pattern, **presses_of(bundle, true, n=30))
    monkeypatch.chdir(tmp_path)
    ran = skin("register", "FILE.npz", "--skin", "disc16", "--presses", 30, "--out", "my-skin")
    assert ran.code == 0 and "turned by +" in ran.out, ran.out + ran.err
    made = Bundle.load(tmp_path / "my-skin")  # its hashes are right
    assert abs(made.metres_per_unit / bundle.metres_per_unit - 1.25) < 0.05
    pose = load(tmp_path / "my-skin" / "skin.toml").skins["disc16"].pose
    assert np.allclose(pose.position_m, (0.01, -0.02, 0), atol=2e-3)
    assert abs(pose.quaternion_xyzw[2] - np.sin(0.35)) < 0.02
    assert "frames of 192" in skin("import", "FILE.npz", "presses.mcap", "--skin", "my-skin").out
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    ran = skin("replay", "../presses.mcap", "--bundle", "../my-skin", "--fast", "--private")
    assert ran.code == 0 and "30 touched" in ran.out, ran.out + ran.err
