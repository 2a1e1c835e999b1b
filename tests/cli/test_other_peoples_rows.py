"""Files of rows as other people have them: read as the same rows, and said; or refused with what to say."""

import gzip
import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io

from models import patterns
from models.bundle import Bundle
from services.recordings.npz_file import InputError, load_npz, read_scans, said

N, M = 5, 3


def skin_of(name: str):
    """What reading needs of a bundle, with a value of its own for each measurement."""
    pattern = patterns.pattern(name, 16)
    z0, model = np.random.default_rng(7).uniform(1, 9, len(pattern)), SimpleNamespace(normalisation="model")
    return SimpleNamespace(pattern=pattern, z0=z0, matrices=model, name=name, manifest={}, skin={"pattern": name})


def rows_of(bundle):
    noise = np.random.default_rng(3).standard_normal((N + M, len(bundle.z0)))
    return bundle.z0 * np.exp(0.01 * noise - 0.1j)


def split(rows):
    return {"measurements": rows[:N], "untouched": rows[N:]}


def grid(z):
    """(n, 256): all drive pairs of `adjacent` by all sense pairs."""
    whole = np.full((len(z), 16, 16), 7 + 0j)
    whole[:, ADJACENT.pattern[:, 1], ADJACENT.pattern[:, 2]] = z
    return whole.reshape(-1, 256)


def square(z):
    whole = np.zeros((len(z), 16, 16), complex)
    whole[:, PAIRS.pattern[:, 0], PAIRS.pattern[:, 1]] = z
    return (whole + whole.transpose(0, 2, 1)).reshape(-1, 256)


def in_turn(z):
    return np.stack([abs(z), np.angle(z)], -1).reshape(len(z), -1)


def in_halves(z):
    return np.hstack([z.real, z.imag])


ADJACENT, PAIRS, OPPOSITE = map(skin_of, ("adjacent", "pairs", "opposite"))
SENSE_FIRST = np.lexsort((PAIRS.pattern[:, 0], PAIRS.pattern[:, 1]))
READ = [
    (PAIRS, lambda z: (abs(z) * 1e6).astype(np.int32), "", ""),
    (PAIRS, lambda z: -z.real, "", ""),
    (PAIRS, lambda z: z.T, "", "transposed: measurements, untouched"),
    (ADJACENT, lambda z: z.reshape(-1, 16, 13), "", "16 by 13"),
    (ADJACENT, grid, "", "16 drive pairs by 16 sense"),
    (ADJACENT, lambda z: grid(z).T, "", "stand as rows; 16 drive pairs"),
    (PAIRS, square, "", "each pair taken once"),
    (PAIRS, in_turn, "columns=magnitude-phase", "as told"),
    (PAIRS, in_halves, "columns=real-then-imaginary", "as told"),
    (PAIRS, lambda z: np.hstack([z[:, :1], z]), "columns=1:", "columns 1:, as told"),
    (PAIRS, lambda z: z[:, SENSE_FIRST], "pattern=sense-first", "one sense pair after the other"),
]
PATTERNS = [  # of files that say their order
    (ADJACENT, lambda p: p[:, [1, 0, 2, 3]], None, "208 drive pairs are the other way round"),
    (OPPOSITE, lambda p: p[:, [2, 3, 0, 1]], None, "192 have sense and drive exchanged"),
    (OPPOSITE, lambda p: (p.T + 1).astype(float), None, "counted from 1"),
    (PAIRS, lambda p: p[:, :2], None, "the order of the file's `pattern`"),
]


@pytest.mark.parametrize(("bundle", "of", "told", "says"), READ + PATTERNS)
def test_one_reading_fits(bundle, of, told: str | None, says: str) -> None:
    rows, given = rows_of(bundle), dict(part.split("=") for part in (told or "").split())
    arrays = split(rows)
    if told is None:
        shuffled = np.random.default_rng(1).permutation(len(bundle.pattern))
        arrays = split(rows[:, shuffled]) | {"pattern": of(bundle.pattern[shuffled])}
    else:
        arrays = {name: of(each) for name, each in arrays.items()}
    found = read_scans(arrays, bundle, said(given.get("columns", ""), given.get("pattern", ""), ""))
    ratio = np.abs(found.measurements) / np.abs(rows[:N])
    np.testing.assert_allclose(ratio / ratio[0, 0], 1, rtol=1e-5)
    assert says in found.understood and bool(says) == bool(found.understood)


@pytest.mark.parametrize(
    ("bundle", "of", "says"),
    [
        (PAIRS, in_turn, "say --columns magnitude-phase; else one of real-imaginary"),
        (PAIRS, in_halves, "say --columns magnitude-then-phase"),
        (PAIRS, lambda z: z[:, SENSE_FIRST], "say --pattern sense-first"),
        (PAIRS, lambda z: np.hstack([z[:, :1], z]), "say --columns 1:"),
        (PAIRS, lambda z: np.ones((len(z), 208)), "measured `adjacent` give 208"),
        (PAIRS, lambda z: np.ones((len(z), 256)), "16 drive pairs by 16 sense pairs of neighbours"),
        (ADJACENT, lambda z: np.ones((208, 256)), "say --columns transposed if so"),
    ],
)
def test_several_readings_or_none_are_refused_with_what_to_say(bundle, of, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_scans({name: of(z) for name, z in split(rows_of(bundle)).items()}, bundle)


def as_text(rows, sign: str, decimal: str) -> bytes:
    names = ["time (s)", *(f"z_{i}_{j}" for i, j, *_ in PAIRS.pattern + 1), "label"]
    labels = ["touch"] * N + ["empty"] * M
    lines = [sign.join([f"{at}", *(f"{abs(v):.9g}" for v in row), labels[at]]) for at, row in enumerate(rows)]
    return "\n".join([sign.join(names), *(line.replace(".", decimal) for line in lines)]).encode("utf-8-sig")


@pytest.mark.parametrize("kind", ["names.csv", "names.csv.gz", "decimal_comma.csv", "v5.mat", "v4.mat", "bare.npy"])
def test_files_of_every_kind(tmp_path: Path, kind: str) -> None:
    """Cut anywhere, each gives a sentence, or fewer rows."""
    rows, out, path = rows_of(PAIRS), io.BytesIO(), tmp_path / kind
    match kind.removesuffix(".gz"):
        case "names.csv":
            out.write(as_text(rows, ",", "."))
        case "decimal_comma.csv":
            out.write(as_text(rows, ";", ","))
        case "v5.mat":
            scipy.io.savemat(out, {"vi": rows[:N], "vh": rows[N:], "note": "foam"}, do_compression=True)
        case "v4.mat":
            scipy.io.savemat(out, {"data": rows[:N].T, "baseline": rows[N:].T}, format="4")
        case _:
            np.save(out, np.roll(rows, M, axis=0))
    whole = gzip.compress(out.getvalue()) if kind.endswith(".gz") else out.getvalue()
    path.write_bytes(whole)
    found = read_scans(load_npz(path), PAIRS, said("", "", str(M) if kind == "bare.npy" else ""))
    np.testing.assert_allclose(abs(found.measurements), abs(rows[:N]), rtol=1e-7)
    np.testing.assert_allclose(found.untouched, abs(rows[N:]), rtol=1e-7)
    for cut in (0, 1, 5, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:cut])
        try:
            load_npz(path)
        except InputError as why:
            assert path.stem in str(why)


def test_out_says_why(skin, tmp_path: Path) -> None:
    rng, z0 = np.random.default_rng(0), Bundle.load("square16").z0
    untouched = z0 * (1 + 1e-4 * rng.standard_normal((20, 120)))
    np.savez(tmp_path / "in.npz", measurements=z0 * np.exp(0.5 * rng.standard_normal((1, 120))), untouched=untouched)
    ran = skin("reconstruct", tmp_path / "in.npz", tmp_path / "out.npz", "--skin", "square16", "--no-calibrate")
    assert ran.code == 0 and "1 row not valid out_of_distribution" in ran.out and "--pattern" in ran.out, ran.out
    with np.load(tmp_path / "out.npz") as out:
        assert out["statistic"] >= out["limit"] and out["check"][0] and "out_of_distribution" in out["reasons"][0]
        assert dict(out["assumed"])["noise"].endswith("from 20 rows of `untouched`")
