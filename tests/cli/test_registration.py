"""Registration: known similarities are found again; the real hydrogel skin is located as well as README says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from services.calibration.registration import (
    RegistrationError,
    Similarity,
    half_width,
    part,
    read_presses,
    register,
    sample,
    sensitivities,
)
from services.calibration.sensitivity import corrected, locate, response


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load("disc16")


def presses_of(bundle: Bundle, true: Similarity, n: int = 60, gains: bool = True) -> dict[str, np.ndarray]:
    """What a skin lying at `true` in the machine's frame would measure: every measurement with a gain of its own."""
    rng = np.random.default_rng(8)
    radius, angle = 0.8 * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 2 * np.pi, n)
    places = half_width(bundle) * np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    signal = sample(sensitivities(bundle, 1.5), places, half_width(bundle))
    signal *= 0.02 / np.abs(signal).mean()
    if gains:
        signal *= rng.uniform(0.2, 2.0, signal.shape[1])
    before = rng.uniform(100, 200, (1, signal.shape[1])) * (1 + 1e-3 * rng.standard_normal(signal.shape))
    after = before * (1 + signal + 1e-3 * rng.standard_normal(signal.shape))
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
    found, explained = register(read_presses(presses_of(bundle, true), bundle), bundle)
    assert found.mirrored == true.mirrored and explained > 0.9
    corners = 0.05 * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1.0]])
    assert np.linalg.norm(found.to_machine(corners) - true.to_machine(corners), axis=1).max() < 2e-3


def test_similarity_there_and_back() -> None:
    points = np.random.default_rng(9).normal(size=(5, 2))
    for mirrored in (False, True):
        similarity = Similarity(1.1, 1.3, np.array([0.1, -0.2]), mirrored)
        assert np.allclose(similarity.to_skin(similarity.to_machine(points)), points)
        turned = similarity.to_machine(np.eye(2)) - similarity.to_machine(np.zeros((2, 2)))
        assert np.isclose(np.linalg.det(turned), (-1 if mirrored else 1) * 1.3**2)


def test_real_presses_are_found_within_5_mm(bundle: Bundle, reference: Path) -> None:
    """Median over 400 presses that took no part, after 100 that did. (A plain one-step linear image: 14.9 mm.)"""
    with np.load(reference / "hydrogel_disc16.npz") as data:
        arrays = dict(data)
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (slice(0, 100), slice(100, None)))
    similarity, _ = register(train, bundle)
    matrices = corrected(train, response(train, similarity, bundle), bundle)
    error = np.linalg.norm(locate(test, matrices, bundle, similarity) - test.xy, axis=1)
    assert np.median(error) < 0.005 and error.mean() < 0.006
    gains_only = corrected(train, response(train, similarity, bundle, field_share=0.0), bundle)
    error = np.linalg.norm(locate(test, gains_only, bundle, similarity) - test.xy, axis=1)
    assert np.median(error) < 0.010


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"xy": None}, "no array xy"),
        ({"xy": np.zeros((60, 3))}, "expected \\(60, 2\\)"),
        ({"touched": np.ones((59, 192))}, "one row per press"),
        ({"untouched": np.zeros((60, 192))}, "not above 0"),
        ({"touched": np.full((60, 192), np.nan)}, "not finite"),
        ({"depth": np.zeros(3)}, "depth"),
    ],
)
def test_wrong_files_are_refused(bundle: Bundle, change: dict[str, np.ndarray | None], says: str) -> None:
    arrays = presses_of(bundle, Similarity(0.0, 1.0, np.zeros(2), False)) | change
    with pytest.raises(RegistrationError, match=says):
        read_presses({name: a for name, a in arrays.items() if a is not None}, bundle)


def test_too_few_presses_are_refused(bundle: Bundle) -> None:
    arrays = presses_of(bundle, Similarity(0.0, 1.0, np.zeros(2), False), n=10)
    with pytest.raises(RegistrationError, match="at least 20"):
        register(read_presses(arrays, bundle), bundle)


def test_the_command_writes_a_bundle_and_its_pose(skin, bundle, tmp_path) -> None:  # type: ignore[no-untyped-def]
    true = Similarity(0.7, 1.25, np.array([0.01, -0.02]), False)
    np.savez(tmp_path / "presses.npz", **presses_of(bundle, true))
    ran = skin("register", tmp_path / "presses.npz", "--skin", "disc16", "--presses", 60, "--out", tmp_path / "mine")
    assert ran.code == 0 and "turned by +40." in ran.out
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
