"""`skin reconstruct` against scenes that another solver computed, and the promises about its rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from services.estimation.first.references import noise_of_references
from services.recordings.npz_file import Input, read_input
from services.recordings.reconstruction import reconstruct, resampled
from services.runtime.config import Skin

METRES = 0.05  # per model unit


@pytest.fixture(scope="module")
def scenes(reference: Path) -> dict[str, np.ndarray]:
    with np.load(reference / "eidors_reference.npz") as data:
        return dict(data)


@pytest.fixture(scope="module")
def noisy(scenes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """70 dB noise on the 19 scenes and on 64 untouched frames."""
    rng, clean = np.random.default_rng(1), scenes["impedance_pairs"]
    sigma = np.abs(clean[0]) * 10 ** (-70 / 20)
    return {
        "measurements": clean + sigma * rng.standard_normal(clean.shape),
        "untouched": clean[0] + sigma * rng.standard_normal((64, 120)),
    }


@pytest.fixture(scope="module")
def out(noisy: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    bundle = Bundle.load("square16")
    return reconstruct(read_input(noisy, 120), Skin(port="stub", bundle="square16"), bundle)


@pytest.fixture(scope="module")
def fresh(noisy: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same right after the untouched rows."""
    bundle = Bundle.load("square16")
    return reconstruct(read_input(noisy, 120), Skin(port="stub", bundle="square16"), bundle, age_s=10.0)


def test_keys_shapes_and_types(out: dict[str, np.ndarray]) -> None:
    assert {name: (a.dtype.str, a.shape) for name, a in out.items()} == {
        "image": ("<f4", (19, 96, 96)),
        "touched": ("|b1", (19,)),
        "valid": ("|b1", (19,)),
        "count": ("<i8", (19,)),
        "position": ("<f8", (19, 8, 2)),
        "force": ("<f8", (19, 8)),
        "force_sigma": ("<f8", (19, 8)),
        "shape": ("<U12", (19, 8)),
    }
    assert np.isfinite(out["image"]).all()


def test_untouched_is_untouched_and_touches_are_seen(scenes, out, fresh) -> None:  # type: ignore[no-untyped-def]
    """Of rows whose age nobody says, five minutes of drift may explain a light press."""
    touched = scenes["drop"].reshape(19, -1).max(axis=1) > 0
    assert any(name.startswith("J") for name in scenes["scene"][~touched]), "scenes where all has drifted"
    assert not out["touched"][~touched].any() and out["touched"][touched].mean() > 0.85
    assert fresh["touched"][touched].all() and not fresh["touched"][0]
    assert np.isnan(out["position"][0]).all() and out["count"][0] == 0


def test_positions_and_signs_are_the_true_ones(scenes, fresh) -> None:  # type: ignore[no-untyped-def]
    """Axes and signs, not accuracy: within a tenth of the side, and no mirror image does better."""
    rows = [k for k in range(19) if np.isfinite(scenes["shapes"][k, :, 0]).sum() == 1]
    axis = -1 + 2 * (np.arange(96) + 0.5) / 96
    truth = np.array(
        [
            [(scenes["drop"][k] > 0).mean(axis=0) @ axis, (scenes["drop"][k] > 0).mean(axis=1) @ axis]
            / np.array([(scenes["drop"][k] > 0).mean(axis=0).sum()])
            for k in rows
        ]
    )
    found = fresh["position"][rows, 0] / METRES
    error = np.linalg.norm(found - truth, axis=1)
    assert np.median(error) < 0.05 and error.max() < 0.2
    for flip in ((-1, 1), (1, -1), (-1, -1)):
        assert np.median(np.linalg.norm(found * flip - truth, axis=1)) > 3 * np.median(error)
    brightest = [np.unravel_index(fresh["image"][k].argmax(), (96, 96)) for k in rows]
    from_image = np.array([[axis[ix], axis[iy]] for iy, ix in brightest])
    assert np.median(np.linalg.norm(from_image - truth, axis=1)) < 0.1


def test_a_row_does_not_depend_on_the_others(noisy, out) -> None:  # type: ignore[no-untyped-def]
    rows = [4, 0, 11]
    some = {"measurements": noisy["measurements"][rows], "untouched": noisy["untouched"]}
    alone = reconstruct(read_input(some, 120), Skin(port="stub", bundle="square16"), Bundle.load("square16"))
    for name in out:
        assert np.array_equal(alone[name], out[name][rows], equal_nan=out[name].dtype.kind == "f"), name


def test_a_sequence_is_tracked(noisy) -> None:  # type: ignore[no-untyped-def]
    """Rows of a sequence meet the state of the one before: the baseline follows slow drift there, and only there."""
    rng = np.random.default_rng(2)
    base = noisy["untouched"].mean(axis=0)
    drift = 1 + 2e-3 * np.linspace(0, 1, 600)[:, None]
    rows = base * drift * (1 + 3e-4 * rng.standard_normal((600, 120)))
    data = Input(rows[::20], noisy["untouched"], None)
    out = reconstruct(data, Skin(port="stub", bundle="square16"), Bundle.load("square16"), sequence=False)
    assert out["count"].shape == (30,)
    scans = reconstruct(data, Skin(port="stub", bundle="square16"), Bundle.load("square16"), sequence=True)
    assert not np.array_equal(out["image"][-1], scans["image"][-1])


def test_a_reference_of_each_row_follows_drift(noisy) -> None:  # type: ignore[no-untyped-def]
    """Each row is compared with its own reference: gains of the rows do not matter."""
    rng = np.random.default_rng(3)
    gain = rng.uniform(0.5, 2.0, (19, 1))
    before = noisy["untouched"][:19] * gain
    skin, bundle = Skin(port="stub", bundle="square16"), Bundle.load("square16")
    out = reconstruct(Input(noisy["measurements"] * gain, None, before), skin, bundle)
    plain = reconstruct(Input(noisy["measurements"], None, before / gain), skin, bundle)
    assert np.allclose(out["position"][4, 0], plain["position"][4, 0], atol=1e-4)
    assert not out["touched"][0] and not plain["touched"][0]


def test_failed_measurements_leave_a_finite_image(noisy) -> None:  # type: ignore[no-untyped-def]
    rows = noisy["measurements"][4:6].copy()
    rows[0, 7], rows[1] = np.nan, np.nan
    data = Input(rows, noisy["untouched"], None)
    out = reconstruct(data, Skin(port="stub", bundle="square16"), Bundle.load("square16"))
    assert np.isfinite(out["image"]).all() and not out["valid"][1]


def test_a_bad_reference_costs_its_own_row_only(noisy) -> None:  # type: ignore[no-untyped-def]
    """The others come out as from a file without that row."""
    bundle, skin = Bundle.load("square16"), Skin(port="stub", bundle="square16")
    rows, reference = noisy["measurements"][[4, 5, 11]], noisy["untouched"][:3].copy()
    without = {"measurements": rows[::2], "reference": reference[::2]}
    whole = reconstruct(read_input(without, 120), skin, bundle)
    reference[1] = np.nan
    said: list[str] = []
    out = reconstruct(read_input({"measurements": rows, "reference": reference}, 120), skin, bundle, warn=said.append)
    assert out["valid"].tolist() == [True, False, True] and out["touched"].tolist() == [True, False, True]
    assert out["count"][1] == 0 and not out["image"][1].any() and np.isnan(out["position"][1]).all()
    for name in whole:
        if whole[name].dtype.kind == "f":  # the rows have other times, whose last bits are other ones
            np.testing.assert_allclose(out[name][[0, 2]], whole[name], rtol=1e-6, err_msg=name)
        else:
            assert np.array_equal(out[name][[0, 2]], whole[name]), name
    assert len(said) == 1 and "1 of 3 rows" in said[0]


def test_columns_of_untouched_without_values_are_left_out(noisy) -> None:  # type: ignore[no-untyped-def]
    """In a tare of many rows and in one of few; what remains still shows the touch where it is."""
    bundle, skin = Bundle.load("square16"), Skin(port="stub", bundle="square16")
    rows = noisy["measurements"][[0, 4]]
    everything = reconstruct(Input(rows, noisy["untouched"], None), skin, bundle)
    for count in (64, 3, 1):
        untouched = noisy["untouched"][:count].copy()
        untouched[:, ::8] = np.nan
        out = reconstruct(read_input({"measurements": rows, "untouched": untouched}, 120), skin, bundle)
        assert out["touched"].tolist() == [False, True] and np.isfinite(out["image"]).all()
        assert np.linalg.norm(out["position"][1, 0] - everything["position"][1, 0]) < 0.1 * METRES


def test_computed_untouched_rows_without_noise_still_show_touches(noisy) -> None:  # type: ignore[no-untyped-def]
    bundle, skin = Bundle.load("square16"), Skin(port="stub", bundle="square16")
    rows, mean = noisy["measurements"][[0, 4]], noisy["untouched"].mean(axis=0)
    for arrays in ({"untouched": np.tile(mean, (64, 1))}, {"reference": np.tile(mean, (10, 1))}):
        some = {"measurements": rows[[0, 1] * 5], **arrays}
        out = reconstruct(read_input(some, 120), skin, bundle)
        assert out["touched"].tolist() == [False, True] * 5 and out["valid"].all()


def test_few_untouched_rows_are_said(noisy) -> None:  # type: ignore[no-untyped-def]
    said: list[str] = []
    data = Input(noisy["measurements"][:2], noisy["untouched"][:1], None)
    reconstruct(data, Skin(port="stub", bundle="square16"), Bundle.load("square16"), warn=said.append)
    assert len(said) == 1 and "one row" in said[0]


def test_noise_of_references_ignores_drift() -> None:
    rng = np.random.default_rng(4)
    drift = np.exp(np.linspace(0, 0.5, 400))[:, None]
    reference = 100 * drift * (1 + 2e-3 * rng.standard_normal((400, 50)))
    assert np.allclose(noise_of_references(reference), 2e-3, rtol=0.2)


def test_resampling_keeps_places() -> None:
    image = np.zeros((24, 24), np.float32)
    image[5, 17] = 1.0
    y, x = np.unravel_index(resampled(image, 96).argmax(), (96, 96))
    assert abs((y + 0.5) / 4 - 5.5) <= 0.2 and abs((x + 0.5) / 4 - 17.5) <= 0.2


def test_rows_stand_alone_so_that_all_their_touches_count(  # type: ignore[no-untyped-def]
    scenes, fresh
) -> None:
    """No row is the one before the next: nothing waits to be confirmed by it. G0 and G1: two and three touches."""
    several = [k for k, name in enumerate(scenes["scene"]) if name.startswith("G")]
    assert [int(fresh["count"][k]) for k in several] == [2, 3]
