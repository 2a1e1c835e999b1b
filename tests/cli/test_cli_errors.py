"""Bad requests: one clear line, the right exit code, never a traceback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.cli.talkers import PRESS_AND_WATCH

K = 120


def npz(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


GOOD = {"measurements": np.ones((2, K)), "untouched": np.ones((8, K))}


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"voltages": np.ones((2, K))}, "no array `measurements`"),
        ({"measurements": np.ones((2, K))}, "found neither"),
        ({**GOOD, "reference": np.ones((2, K))}, "found both"),
        ({**GOOD, "measurements": np.ones((2, 119))}, "expected numbers of shape (n, 120)"),
        ({**GOOD, "measurements": np.ones(K)}, "expected numbers of shape (n, 120)"),
        ({**GOOD, "measurements": np.full((2, K), "a")}, "expected numbers of shape (n, 120)"),
        ({**GOOD, "measurements": np.full((2, K), np.nan)}, "no finite number"),
        ({"measurements": np.ones((2, K)), "reference": np.ones((3, K))}, "expected one each"),
        ({**GOOD, "untouched": np.zeros((8, K))}, "in 0 of 120 columns, expected at least 60"),
        ({**GOOD, "untouched": np.where(np.arange(K) < 100, np.nan, np.ones((8, K)))}, "in 20 of 120 columns"),
        ({"measurements": np.ones((2, K)), "reference": np.full((2, K), np.inf)}, "no finite number"),
    ],
)
def test_reconstruct_refuses_wrong_arrays(skin, tmp_path, arrays, says) -> None:  # type: ignore[no-untyped-def]
    ran = skin("reconstruct", npz(tmp_path / "in.npz", **arrays), tmp_path / "out.npz", "--skin", "square16")
    assert ran.code == 2 and says in ran.err and len(ran.err.splitlines()) == 1
    assert not (tmp_path / "out.npz").exists()


def test_reconstruct_says_nothing_of_numpy(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Values out of range cost their row, with at most a line of our own."""
    rng = np.random.default_rng(0)
    rows, untouched = rng.uniform(1, 2, (4, K)), 1 + 1e-4 * rng.standard_normal((3, K))
    rows[0], rows[1], rows[2, :3] = np.nan, 1e300, np.inf
    untouched[:, :5], untouched[0, 7] = np.nan, np.inf
    ran = skin(
        "reconstruct",
        npz(tmp_path / "in.npz", measurements=rows, untouched=untouched),
        tmp_path / "out.npz",
        "--skin",
        "square16",
    )
    assert ran.code == 0 and "Warning" not in ran.err, ran.err
    with np.load(tmp_path / "out.npz") as out:
        assert not out["valid"][:2].any() and np.isfinite(out["image"]).all()


def test_reconstruct_refuses_what_is_no_npz(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "text.npz").write_text("x, y\n1, 2\n")
    np.save(tmp_path / "one.npy", np.ones(3))
    npz(tmp_path / "objects.npz", measurements=np.array([{}, None], dtype=object), untouched=np.ones((2, K)))
    for name in ("text.npz", "one.npy", "objects.npz", "missing.npz", "."):
        ran = skin("reconstruct", tmp_path / name, tmp_path / "out.npz", "--skin", "square16")
        assert ran.code == 2 and len(ran.err.splitlines()) == 1, name


def test_wrong_skin_names_those_there_are(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    ran = skin("reconstruct", npz(tmp_path / "in.npz", **GOOD), tmp_path / "out.npz", "--skin", "hexagon")
    assert ran.code == 2 and "no bundle 'hexagon'" in ran.err and "square16" in ran.err


def test_a_broken_configuration_is_named_where_the_skin_is_not_found(skin, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "skin.toml").write_text("[skins.palm\n")
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    ran = skin("reconstruct", npz(tmp_path / "in.npz", **GOOD), tmp_path / "out.npz", "--skin", "palm")
    assert ran.code == 2 and "no bundle 'palm'" in ran.err and "skin.toml: is not TOML" in ran.err
    ran = skin("reconstruct", npz(tmp_path / "in.npz", **GOOD), tmp_path / "out.npz", "--skin", "square16")
    assert ran.code == 0  # a bundle needs no configuration


def test_a_snapshot_without_a_recorder_says_so_at_once(skin) -> None:  # type: ignore[no-untyped-def]
    """Not after the ten seconds that an answer may take."""
    ran = skin("snapshot")
    assert ran.code == 3 and ran.out == "" and "recorder does not run here" in ran.err and "`skin up`" in ran.err


@pytest.mark.parametrize("command", [*PRESS_AND_WATCH, ("top", "--once", "--json", "--seconds", 0.1)])
def test_no_service_is_said_at_once(skin, command) -> None:  # type: ignore[no-untyped-def]
    ran = skin(*command)
    assert ran.code == 3 and "skin up" in ran.err and len(ran.err.splitlines()) == 1 and ran.out == ""


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (("press", "--x", 0, "--y", 0, "--force", 1, "--to-x", 0.01), "both --to-x and --to-y"),
        (("echo", "voltage"), "no topic 'voltage'"),
        (("fault", "electrode_open", "electrode"), "expected key=value"),
        (("bench", "speed"), "no benchmark 'speed'"),
        (("replay", "x.mcap", "--speed", 0), "above 0"),
        (("replay", "missing.mcap"), "missing.mcap: cannot be read"),
        (("record", "/nowhere/x.mcap"), "cannot write /nowhere/x.mcap"),
        (("record", "/tmp/x.mcap", "--topics", "raw,sound"), "no topic 'sound'"),
    ],
)
def test_wrong_requests(skin, command, says) -> None:  # type: ignore[no-untyped-def]
    ran = skin(*command)
    assert ran.code == 2 and says in ran.err


def test_a_runtime_folder_open_to_others_is_refused(skin, runtime) -> None:  # type: ignore[no-untyped-def]
    runtime.chmod(0o755)
    ran = skin("press", "--x", 0, "--y", 0, "--force", 1)
    assert ran.code == 2 and "chmod 700" in ran.err


def test_import_refuses_another_pattern(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    pattern = np.array([[0, 1, 2, 3]] * 192)
    source = npz(tmp_path / "in.npz", touched=np.ones((2, 192)), untouched=np.ones((2, 192)), pattern=pattern)
    ran = skin("import", source, tmp_path / "out.mcap", "--skin", "disc16")
    assert ran.code == 2 and "`pattern` has 192 rows, and lacks" in ran.err
    ran = skin("import", source, tmp_path / "out.mcap", "--skin", "square16")
    assert ran.code == 2 and not (tmp_path / "out.mcap").exists()


def test_a_damaged_configuration_is_explained(skin, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "skin.toml").write_text("[skins.palm]\nport = 5\n")
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    ran = skin("up")
    assert ran.code == 2 and "skins.palm.port" in ran.err
    ran = skin("doctor")
    assert ran.code == 1 and ran.out.startswith("FAIL  configuration")


def test_a_bundle_that_is_not_there_is_said_before_anything_starts(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "mine.toml"
    file.write_text('[skins.palm]\nport = "stub"\nbundle = "no-such"\n')
    ran = skin("up", "--config", file)
    assert ran.code == 2 and "skins.palm.bundle: no bundle 'no-such': shipped are" in ran.err and not ran.out


def test_a_calibration_of_forces_that_is_not_there_is_said_before_anything_starts(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "mine.toml"
    file.write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\ncalibration = "forces.json"\n')
    ran = skin("up", "--config", file)
    assert ran.code == 2 and "forces.json" in ran.err and "correct `calibration`" in ran.err and not ran.out


@pytest.mark.parametrize(
    ("name", "array", "says"),
    [
        ("touched", np.full((25, 192), "a"), "touched is <U1, expected numbers"),
        ("xy", np.full((25, 2), "a"), "xy is <U1, expected numbers"),
        ("depth", np.full(25, 1j), "depth is complex128, expected numbers"),
        ("touched", np.array(3.0), "touched ()"),
    ],
)
def test_register_refuses_arrays_that_are_no_presses(skin, tmp_path, name, array, says) -> None:  # type: ignore[no-untyped-def]
    arrays = {"touched": np.ones((25, 192)), "untouched": np.ones((25, 192)), "xy": np.zeros((25, 2)), name: array}
    ran = skin("register", npz(tmp_path / "in.npz", **arrays), "--skin", "disc16", "--out", tmp_path / "out")
    assert ran.code == 2 and says in ran.err and len(ran.err.splitlines()) == 1, ran.err
    assert not (tmp_path / "out").exists()


def test_an_untouched_frame_too_small_to_square_is_refused(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    arrays = {**GOOD, "untouched": np.full((8, K), 5e-324)}
    ran = skin("reconstruct", npz(tmp_path / "in.npz", **arrays), tmp_path / "out.npz", "--skin", "square16")
    assert ran.code == 2 and "in 0 of 120 columns" in ran.err
