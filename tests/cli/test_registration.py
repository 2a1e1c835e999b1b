"""Registration: known similarities are found again; the real hydrogel skin is located as docs/figures.md says."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from models.locator import NINETY, Locator
from models.locator_arrays import arrays_of
from services.calibration.fields import half_width, sample, sensitivities
from services.calibration.locating import build, true_places
from services.calibration.presses import Presses, RegistrationError, part, read_presses
from services.calibration.register_command import register_presses
from services.calibration.registration import KnownPose, Similarity, register
from services.recordings.npz_file import load_npz, read_scans
from services.runtime.config import Skin

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load("disc16")


def presses_of(
    bundle: Bundle,
    true: Similarity,
    n: int = 60,
    reach: float = 0.8,
    noise: float = 1e-3,
    strength: np.ndarray | float = 1.0,
) -> Arrays:
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
    [
        Similarity(0.4, 1.0, np.array([0.0, 0.0]), False),
        Similarity(-1.9, 1.2, np.array([0.012, -0.02]), False),
        Similarity(2.6, 0.9, np.array([-0.03, 0.01]), True),
    ],
)
def test_a_known_similarity_is_found(bundle: Bundle, true: Similarity) -> None:
    made = register(read_presses(presses_of(bundle, true), bundle), bundle)
    found = made.similarity
    assert found.mirrored == true.mirrored and made.explained > 0.9 and not made.doubts
    assert abs(np.angle(np.exp(1j * (found.angle - true.angle)))) < max(0.02, 4 * made.sigma["angle"]) < 0.2
    corners = 0.05 * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1.0]])
    assert np.linalg.norm(found.to_machine(corners) - true.to_machine(corners), axis=1).max() < 2e-3


def test_similarity_there_and_back() -> None:
    points = np.random.default_rng(9).normal(size=(5, 2))
    for mirrored in (False, True):
        similarity = Similarity(1.1, 1.3, np.array([0.1, -0.2]), mirrored)
        assert np.allclose(similarity.to_skin(similarity.to_machine(points)), points)
        turned = similarity.to_machine(np.eye(2)) - similarity.to_machine(np.zeros((2, 2)))
        assert np.isclose(np.linalg.det(turned), (-1 if mirrored else 1) * 1.3**2)


def located(test: Presses, train: Presses, similarity: Similarity, locator: Locator) -> np.ndarray:
    """(N,) m from where a press was to where it is found."""
    found = [locator.locate(d * train.unit / test.unit, train.noise) for d in test.difference]
    assert all(found)
    return np.linalg.norm(np.array([[t[0].x, t[0].y] for t in found]) - true_places(test.xy, similarity), axis=1)


def test_real_presses_are_found_within_3_mm(bundle: Bundle, reference: Path) -> None:
    """Median over 200 presses that took no part, after 100 that did. (A plain one-step linear image: 14.9 mm.)

    90 % of them lie within their ellipses, their depths of 10, 15 and 20 mm are told, and each is one touch.
    """
    arrays = load_npz(reference / "hydrogel_disc16.npz")
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (slice(0, 100), slice(100, 300)))
    similarity = register(train, bundle).similarity
    made, _, crossed = build(train, similarity, bundle)
    locator = Locator(made)
    found = [locator.locate(d, train.noise) for d in test.difference]
    apart = np.array([[t[0].x, t[0].y] for t in found]) - true_places(test.xy, similarity)
    error = np.linalg.norm(apart, axis=1)
    assert np.median(error) < 0.003 and error.mean() < 0.0036
    assert abs(np.median(crossed.distance) - np.median(error)) < 0.001  # what registration says of itself
    square = [a @ np.linalg.solve(t[0].covariance, a) for a, t in zip(apart, found, strict=True)]
    assert 0.86 <= np.mean(np.array(square) <= NINETY) <= 0.95
    assert sum(len(t) == 1 for t in found) >= 196
    depth = np.array([t[0].value for t in found])
    assert np.abs(depth - test.value).mean() < 0.0017  # presses of 10, 15 and 20 mm; their mean depth is off by 4


@pytest.mark.release
def test_an_uneven_skin_is_learned_from_differences_of_any_scale(bundle: Bundle, reference: Path) -> None:
    """Kernel ridge regression on 100 of these presses placed others to 5.8 mm median."""
    arrays = load_npz(reference / "hydrogel_vse_concentric.npz")
    order = np.random.default_rng(1).permutation(len(arrays["xy"]))
    scaled = arrays | {"delta": arrays["delta"].astype(float) * 3e5}
    errors = []
    for file in (arrays, scaled):
        train, test = (read_presses(part(file, order[rows]), bundle) for rows in (slice(0, 100), slice(300, 700)))
        similarity = register(train, bundle).similarity
        errors.append(located(test, train, similarity, Locator(build(train, similarity, bundle)[0])))
    assert np.median(errors[0]) < 0.004
    assert np.allclose(errors[0], errors[1], atol=1e-5)


@pytest.mark.release
def test_many_presses_correct_what_the_likelihood_gets_wrong(bundle: Bundle, reference: Path) -> None:
    arrays = load_npz(reference / "hydrogel_vse_concentric.npz")
    order = np.random.default_rng(1).permutation(len(arrays["xy"]))
    train, test = (read_presses(part(arrays, order[rows]), bundle) for rows in (slice(0, 700), slice(1000, 1300)))
    similarity = register(train, bundle).similarity
    made, _, crossed = build(train, similarity, bundle)
    assert crossed.corrected and np.median(crossed.distance) < 0.92 * crossed.before
    plain = dataclasses.replace(made, place_centres=np.zeros((0, 0)))
    corrected, alone = (np.median(located(test, train, similarity, Locator(each))) for each in (made, plain))
    assert corrected < 0.93 * alone and corrected < 0.0022


def test_ten_real_presses_are_enough_to_begin_with(bundle: Bundle, reference: Path) -> None:
    arrays = load_npz(reference / "hydrogel_disc16.npz")
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (slice(0, 10), slice(100, 300)))
    similarity = register(train, bundle).similarity
    made = build(train, similarity, bundle)[0]
    assert np.median(located(test, train, similarity, Locator(made))) < 0.0095
    arrays = {name: np.asarray(value) for name, value in vars(made).items()}
    assert arrays_of(arrays, 192).map.shape == made.map.shape
    for name, wrong in (("map", made.map[:-1]), ("error", made.error * np.nan), ("shape", np.array([0, 5]))):
        with pytest.raises(ValueError, match=name):  # a bundle that holds it is refused
            arrays_of(arrays | {name: wrong}, 192)


def test_few_presses_say_that_they_know_little(bundle: Bundle, reference: Path) -> None:
    """After ten presses of one shuffle, which leave much of the skin untouched, 68 % of others lay in their 90 %
    ellipses, and one in eight was more than half an ellipse beyond.
    """
    arrays = load_npz(reference / "hydrogel_disc16.npz")
    order = np.random.default_rng(6).permutation(len(arrays["xy"]))
    train, test = (read_presses(part(arrays, order[rows]), bundle) for rows in (slice(0, 10), slice(10, 210)))
    similarity = register(train, bundle).similarity
    locator = Locator(build(train, similarity, bundle)[0])
    found = [locator.locate(d, train.noise)[0] for d in test.difference]
    apart = np.array([[t.x, t.y] for t in found]) - true_places(test.xy, similarity)
    beyond = np.sqrt([a @ np.linalg.solve(t.covariance, a) / NINETY for a, t in zip(apart, found, strict=True)])
    assert np.mean(beyond <= 1) >= 0.86 and np.mean(beyond > 1.5) <= 0.05
    far = np.linalg.norm(apart, axis=1) > 0.03  # where it is wrong, it says so
    assert far.sum() > 10 and np.median([t.sigma[0] for t in np.array(found, object)[far]]) > 0.02


def test_what_is_told_of_a_skin_is_kept(bundle: Bundle) -> None:
    true = Similarity(0.4, 1.1, np.array([0.0, 0.0]), True)
    presses = read_presses(presses_of(bundle, true, n=12), bundle)
    told = register(presses, bundle, KnownPose(0.16 * 1.1, 0.4, True))
    found = told.similarity
    assert found.mirrored and abs(found.scale / 1.1 - 1) < 0.025 and abs(found.angle - 0.4) < np.radians(6)
    with pytest.raises(RegistrationError, match="--numbering"):  # told wrongly: no pose explains these presses
        register(presses, bundle, KnownPose(clockwise=False))
    with pytest.raises(RegistrationError, match="presses lie inside the skin"):
        register(presses, bundle, KnownPose(diameter_m=0.05))


def test_a_skin_is_no_larger_than_physics_allows(bundle: Bundle) -> None:
    """Presses within a third of the skin: it would be three times their radius. Nobody presses so; it is said."""
    true = Similarity(0.4, 1.0, np.array([0.0, 0.0]), False)
    arrays = presses_of(bundle, true, n=80, reach=0.35)
    made = register(read_presses(arrays, bundle), bundle)
    xy = arrays["xy"]
    radius = np.linalg.norm(xy - 0.5 * (xy.min(axis=0) + xy.max(axis=0)), axis=1).max()
    assert 0.99 * radius < made.similarity.scale * half_width(bundle) < 1.61 * radius
    assert any("--diameter" in doubt for doubt in made.doubts)
    told = register(read_presses(arrays, bundle), bundle, KnownPose(diameter_m=0.16))
    assert abs(told.similarity.scale - 1.0) < 0.025 and told.explained > made.explained


def test_places_that_do_not_belong_to_the_measurements_are_refused(bundle: Bundle) -> None:
    arrays = presses_of(bundle, Similarity(0.4, 1.0, np.zeros(2), False), n=60)
    arrays["xy"] = arrays["xy"][np.random.default_rng(3).permutation(60)]
    with pytest.raises(RegistrationError, match="row n of xy"):
        register(read_presses(arrays, bundle), bundle)


def same(a: Presses, b: Presses) -> bool:
    return all(np.allclose(getattr(a, name), getattr(b, name)) for name in ("difference", "xy", "strength", "noise"))


def test_the_order_of_rows_says_nothing(bundle: Bundle) -> None:
    arrays = presses_of(bundle, Similarity(0.4, 1.0, np.zeros(2), False), n=40)
    arrays["depth"] = np.linspace(0.01, 0.02, 40)
    order = np.random.default_rng(2).permutation(40)
    shuffled = {name: a[order] for name, a in arrays.items()}
    assert same(read_presses(arrays, bundle), read_presses(shuffled, bundle))


def test_equal_untouched_rows_say_nothing_of_noise(bundle: Bundle) -> None:
    """Neither none nor 60 dB: what the presses themselves leave unexplained, here noise of 0.004 and of 0.0004."""
    arrays = presses_of(bundle, Similarity(0.4, 1.0, np.zeros(2), False), n=80, noise=0.0)
    rng = np.random.default_rng(11)
    for level in (4e-3, 4e-4):
        noisy = arrays | {"touched": arrays["touched"] * (1 + level * rng.standard_normal(arrays["touched"].shape))}
        noisy["untouched"] = np.broadcast_to(arrays["untouched"][:1], arrays["untouched"].shape).copy()
        found = np.median(read_presses(noisy, bundle).noise)
        assert 0.4 * level < found < 2.5 * level


def test_presses_and_measurements_that_are_missing_are_left_out(bundle: Bundle) -> None:
    """A dead measurement, a press of which nothing came, one with a gap, and one twice: the others tell as before."""
    arrays = presses_of(bundle, Similarity(0.4, 1.0, np.zeros(2), False), n=80)
    whole = register(read_presses(arrays, bundle), bundle).similarity
    for name in ("touched", "untouched"):
        arrays[name] = np.vstack([arrays[name], arrays[name][:1]])
    arrays["xy"] = np.vstack([arrays["xy"], arrays["xy"][:1]])
    arrays["touched"][5] = np.nan
    arrays["touched"][6, 3] = np.inf
    arrays["untouched"][:, 17] = 0.0
    presses = read_presses(arrays, bundle)
    assert presses.left_out == 2 and len(presses) == 79
    assert not presses.measured[17] and presses.measured.sum() == 191
    found = register(presses, bundle).similarity
    assert np.linalg.norm(found.to_machine(np.eye(2) * 0.05) - whole.to_machine(np.eye(2) * 0.05)) < 2e-3
    made, _, crossed = build(presses, found, bundle)
    assert np.median(crossed.distance) < 0.004
    touch = Locator(made).locate(presses.difference[9], np.full(192, 1e-3))[0]
    gone = np.where(np.arange(192) % 5 == 0, np.inf, 1e-3)  # a fifth of the measurements is lost later
    without = Locator(made).locate(np.where(np.isfinite(gone), presses.difference[9], 0.0), gone)[0]
    assert np.hypot(touch.x - without.x, touch.y - without.y) < 0.004


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.release
def test_touches_add_up(bundle: Bundle, reference: Path, count: int) -> None:
    """Sums of real presses at places that are at least 50 mm apart: as many touches, each where its press was."""
    arrays = load_npz(reference / "hydrogel_disc16.npz")
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (slice(0, 150), slice(150, 500)))
    similarity = register(train, bundle).similarity
    locator, places = Locator(build(train, similarity, bundle)[0]), true_places(test.xy, similarity)
    rng, right, far, tried = np.random.default_rng(1), 0, [], 0
    while tried < 40:
        rows = rng.choice(len(test), count, replace=False)
        apart = np.linalg.norm(places[rows][:, None] - places[rows], axis=2) + np.eye(count)
        if apart.min() < 0.05:
            continue
        tried += 1
        found = locator.locate(test.difference[rows].sum(axis=0), train.noise)
        right += len(found) == count
        if len(found) == count:
            at = np.array([[t.x, t.y] for t in found])
            far += np.linalg.norm(places[rows][:, None] - at, axis=2).min(axis=1).tolist()
    assert right >= (30 if count == 2 else 20) and np.median(far) < 0.008


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"xy": None}, "no array xy"),
        ({"touched": None, "untouched": None}, "or delta"),
        ({"touched": None, "untouched": None, "delta": np.zeros((60, 192))}, "no differences"),
        ({"touched": None, "untouched": None, "delta": np.zeros((60, 191))}, "one row per press"),
        ({"xy": np.zeros((60, 3))}, "expected \\(60, 2\\)"),
        ({"touched": np.ones((59, 192))}, "one row per press"),
        ({"untouched": np.zeros((60, 192))}, "untouched value above 0"),
        ({"touched": np.full((60, 192), np.nan)}, "are finite"),
        ({"depth": np.zeros(3)}, "depth"),
        ({"force": np.zeros(3)}, "newtons"),
    ],
)
def test_wrong_files_are_refused(bundle: Bundle, change: dict[str, np.ndarray | None], says: str) -> None:
    arrays = presses_of(bundle, Similarity(0.0, 1.0, np.zeros(2), False)) | change
    with pytest.raises(RegistrationError, match=says):
        read_presses({name: a for name, a in arrays.items() if a is not None}, bundle)


def test_too_few_presses_are_refused(bundle: Bundle) -> None:
    arrays = presses_of(bundle, Similarity(0.0, 1.0, np.zeros(2), False), n=9)
    with pytest.raises(RegistrationError, match="at least 10"):
        register(read_presses(arrays, bundle), bundle)


def test_all_presses_at_one_place_are_refused(bundle: Bundle) -> None:
    arrays = presses_of(bundle, Similarity(0.0, 1.0, np.zeros(2), False), n=20)
    arrays["xy"] = np.zeros((20, 2))
    with pytest.raises(RegistrationError, match="spread them"):
        register(read_presses(arrays, bundle), bundle)


def test_contacts_of_a_registered_skin_say_how_deep_and_how_sure(bundle: Bundle, reference: Path, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Through the stages, from differences alone; a skin that was not registered says nothing of either."""
    from services.pipeline import Pipeline
    from services.recordings.file_source import file_frame
    from services.recordings.npz_file import frames_of

    arrays = load_npz(reference / "hydrogel_disc16.npz")
    relative = arrays["touched"] / arrays["untouched"] - 1
    file = {"pattern": arrays["pattern"], "delta": 500.0 * relative, "xy": arrays["xy"], "depth": arrays["depth"]}
    register_presses(file, "disc16", 120, tmp_path / "mine")
    for path, told in ((tmp_path / "mine", True), ("disc16", False)):
        own = Bundle.load(path)
        skin = Skin(port="stub", bundle=str(path), frame_id="skin")
        data, pipeline, contacts = read_scans(part(file, slice(120, 130)), own), Pipeline(skin, bundle=own), []
        for scan, (values, kind) in enumerate(frames_of(data), start=1):
            frame = pipeline.run(file_frame("skin", "opposite", scan, values, kind, scan * 45_000_000, data.separate))
            if kind == "full":
                contacts += [c for c in frame.contact.contacts if c.state != "end"][:1]
        assert len(contacts) == 10
        assert all((c.position_sigma is not None) == told for c in contacts)
        assert all((c.indentation_m is not None) == told for c in contacts)
        if told:
            depth = np.array([c.indentation_m for c in contacts])
            assert np.abs(depth - arrays["depth"][120:130]).mean() < 0.0017
            assert all(0 < c.position_sigma[1] <= c.position_sigma[0] < 0.02 for c in contacts)


def test_forces_are_told_where_the_file_has_them(bundle: Bundle) -> None:
    """Presses whose effect grows with their force."""
    true = Similarity(0.4, 1.0, np.zeros(2), False)
    force = np.random.default_rng(5).uniform(1, 5, 120)
    arrays = presses_of(bundle, true, n=120, strength=force / 3)
    arrays["force"] = force
    presses = read_presses(arrays, bundle)
    made, _, crossed = build(presses, register(presses, bundle).similarity, bundle)
    locator = Locator(made)
    assert locator.quantity == "force_n" and np.abs(crossed.value_error).mean() < 0.3
    found = locator.locate(presses.difference[0], presses.noise)[0]
    assert abs(found.value - presses.value[0]) < 5 * found.value_sigma + 0.1


def test_the_command_writes_a_bundle_and_its_pose(skin, bundle, tmp_path) -> None:  # type: ignore[no-untyped-def]
    true = Similarity(0.7, 1.25, np.array([0.01, -0.02]), False)
    np.savez(tmp_path / "presses.npz", **presses_of(bundle, true))
    ran = skin("register", tmp_path / "presses.npz", "--skin", "disc16", "--presses", 60, "--out", tmp_path / "mine")
    assert ran.code == 0 and "turned by +40." in ran.out, ran.out + ran.err
    made = Bundle.load(tmp_path / "mine")  # its hashes are right
    assert abs(made.metres_per_unit / bundle.metres_per_unit - 1.25) < 0.03
    from services.runtime.config import load

    pose = load(tmp_path / "mine" / "skin.toml").skins["disc16"].pose
    assert (
        np.allclose(pose.position_m, (0.01, -0.02, 0), atol=1e-3) and abs(pose.quaternion_xyzw[2] - np.sin(0.35)) < 0.01
    )


def test_readme_s_real_skin_works_word_for_word(skin, reference, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """On 120 of the presses: registered, imported, replayed through the real processes from another folder."""
    with np.load(reference / "hydrogel_disc16.npz") as data:
        np.savez(tmp_path / "FILE", **part(dict(data), slice(0, 120)))
    monkeypatch.chdir(tmp_path)
    assert skin("register", "FILE.npz", "--skin", "disc16", "--out", "my-skin").code == 0
    assert "304 frames" in skin("import", "FILE.npz", "presses.mcap", "--skin", "my-skin").out
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    ran = skin("replay", "../presses.mcap", "--bundle", "../my-skin", "--fast")
    assert ran.code == 0 and "304 of them valid, 120 touched" in ran.out, ran.out + ran.err
    ran = skin("reconstruct", "../FILE.npz", "images.npz", "--skin", "../my-skin")
    assert "120 rows, 120 touched, 120 valid" in ran.out, ran.out + ran.err
