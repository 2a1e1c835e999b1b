"""`skin reconstruct` against scenes that another solver computed; files of rows as other people have them."""

import gzip
import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io

from models import patterns
from models.bundle import Bundle
from services.recordings.npz_file import Input, InputError, load_npz, read_input, read_scans, reading_options
from services.recordings.reconstruction import baseline_of, reconstruct
from services.runtime.config import Skin
from tests import needs

METRES = 0.05  # per model unit
SKIN = Skin(port="stub", bundle="square16")


def reconstructed(arrays, **more):
    data = arrays if isinstance(arrays, Input) else read_input(arrays, 120)
    return reconstruct(data, SKIN, Bundle.load("square16"), **more)


@pytest.fixture(scope="module")
def scenes():
    return dict(np.load(needs.reference("eidors_reference.npz")))


@pytest.fixture(scope="module")
def noisy(scenes):
    """70 dB noise on the 19 scenes and on 64 untouched frames."""
    rng, clean = np.random.default_rng(1), scenes["impedance_pairs"]
    sigma = np.abs(clean[0]) * 10 ** (-70 / 20)
    rows = clean + sigma * rng.standard_normal(clean.shape)
    return {"measurements": rows, "untouched": clean[0] + sigma * rng.standard_normal((64, 120))}


@pytest.fixture(scope="module")
def out(noisy):
    return reconstructed(noisy)


@pytest.fixture(scope="module")
def fresh(noisy):
    return reconstructed(noisy, age_s=10.0)


def test_keys_shapes_and_types(out) -> None:
    numbers = {"image": ("<f4", (96, 96)), "touched": ("|b1", ()), "valid": ("|b1", ()), "count": ("<i8", ())}
    numbers |= {"position": ("<f8", (8, 2)), "shape": ("<U12", (8,))}
    numbers |= {"force": ("<f8", (8,)), "force_sigma": ("<f8", (8,)), "statistic": ("<f8", ()), "limit": ("<f8", ())}
    numbers |= {"reasons": ("<U120", ()), "check": ("<U16", ())}
    rows = {name: a for name, a in out.items() if name != "assumed"}
    assert {name: (a.dtype.str, a.shape[1:]) for name, a in rows.items()} == numbers
    assert {len(a) for a in rows.values()} == {19} and np.isfinite(out["image"]).all()
    assert [*dict(out["assumed"])] == ["noise", "age", "unit", "columns", "left out"]


def test_touches_are_seen_and_nothing_else(scenes, out, fresh) -> None:
    """Of rows whose age nobody says, drift may explain a light press. G0, G1: two and three touches; J: drift."""
    touched = scenes["drop"].reshape(19, -1).max(axis=1) > 0
    assert any(name.startswith("J") for name in scenes["scene"][~touched])
    assert not out["touched"][~touched].any() and out["touched"][touched].mean() > 0.8
    assert fresh["touched"][touched].all() and not fresh["touched"][0]
    assert np.isnan(out["position"][0]).all() and out["count"][0] == 0
    assert [int(n) for n, name in zip(fresh["count"], scenes["scene"], strict=True) if name.startswith("G")] == [2, 3]


def test_positions_and_signs_are_the_true_ones(scenes, fresh) -> None:
    """Axes and signs, not accuracy: within a tenth of the side, and no mirror image does better."""
    rows = [k for k in range(19) if np.isfinite(scenes["shapes"][k, :, 0]).sum() == 1]
    axis, shown = -1 + 2 * (np.arange(96) + 0.5) / 96, (scenes["drop"][rows] > 0).astype(float)
    truth = np.stack([shown.sum(axis=1) @ axis, shown.sum(axis=2) @ axis], 1) / shown.sum(axis=(1, 2))[:, None]
    found = fresh["position"][rows, 0] / METRES
    error = np.linalg.norm(found - truth, axis=1)
    assert np.median(error) < 0.05 and error.max() < 0.2
    for flip in ((-1, 1), (1, -1), (-1, -1)):
        assert np.median(np.linalg.norm(found * flip - truth, axis=1)) > 3 * np.median(error)
    iy, ix = np.unravel_index(fresh["image"][rows].reshape(len(rows), -1).argmax(axis=1), (96, 96))
    assert np.median(np.linalg.norm(np.stack([axis[ix], axis[iy]], 1) - truth, axis=1)) < 0.1


def test_a_row_does_not_depend_on_the_others_unless_they_are_a_sequence(noisy, out) -> None:
    """The baseline follows slow drift in a sequence, and only there."""
    rows = [4, 0, 11]
    alone = reconstructed({"measurements": noisy["measurements"][rows], "untouched": noisy["untouched"]})
    for name in out.keys() - {"assumed"}:
        assert np.array_equal(alone[name], out[name][rows], equal_nan=out[name].dtype.kind == "f"), name
    drift = 1 + 2e-3 * np.linspace(0, 1, 30)[:, None]
    noise = 3e-4 * np.random.default_rng(2).standard_normal((30, 120))
    data = Input(noisy["untouched"].mean(axis=0) * drift * (1 + noise), noisy["untouched"], None)
    apart, sequence = reconstructed(data, sequence=False), reconstructed(data, sequence=True)
    assert apart["count"].shape == (30,) and not np.array_equal(apart["image"][-1], sequence["image"][-1])


def test_a_reference_of_each_row_takes_its_gain_away(noisy) -> None:
    gain, rows, before = np.array([[0.6], [1.9]]), noisy["measurements"][[0, 4]], noisy["untouched"][:2]
    gained, plain = (reconstructed(Input(rows * times, None, before * times)) for times in (gain, 1.0))
    assert np.allclose(gained["position"][1, 0], plain["position"][1, 0], atol=1e-4)
    assert gained["touched"].tolist() == plain["touched"].tolist() == [False, True]


def test_what_is_missing_costs_its_own_row_or_column(noisy) -> None:
    """The other rows come out as from a file without it."""
    rows, reference = noisy["measurements"][[4, 5, 11]], noisy["untouched"][:3].copy()
    whole = reconstructed({"measurements": rows[::2], "reference": reference[::2]})
    reference[1] = np.nan
    said: list[str] = []
    some = reconstructed({"measurements": rows, "reference": reference}, warn=said.append)
    assert some["valid"].tolist() == some["touched"].tolist() == [True, False, True]
    assert some["count"][1] == 0 and not some["image"][1].any() and np.isnan(some["position"][1]).all()
    for name in whole:
        if whole[name].dtype.kind == "f":  # the rows have other times, whose last bits are other ones
            np.testing.assert_allclose(some[name][[0, 2]], whole[name], rtol=1e-6, err_msg=name)
    assert len(said) == 1 and "1 of 3 rows" in said[0]
    rows = noisy["measurements"][[0, 4]]
    everything = reconstructed(Input(rows, noisy["untouched"], None))
    for count in (64, 1):  # a tare of many rows, and of few
        untouched = noisy["untouched"][:count].copy()
        untouched[:, ::8] = np.nan
        found = reconstructed({"measurements": rows, "untouched": untouched})
        assert found["touched"].tolist() == [False, True] and np.isfinite(found["image"]).all()
        assert np.linalg.norm(found["position"][1, 0] - everything["position"][1, 0]) < 0.1 * METRES


def test_untouched_rows_that_are_computed_or_few(noisy) -> None:
    """Without noise they still show touches; one row is said."""
    mean, rows = noisy["untouched"].mean(axis=0), noisy["measurements"][[0, 4] * 5]
    out = reconstructed({"measurements": rows, "untouched": np.tile(mean, (64, 1))})
    assert out["touched"].tolist() == [False, True] * 5 and out["valid"].all()
    said: list[str] = []
    reconstructed(Input(rows[:2], noisy["untouched"][:1], None), warn=said.append)
    assert len(said) == 1 and "one row" in said[0]


GAINS = np.exp(0.08 * np.random.default_rng(7).standard_normal(120))


@pytest.mark.many
@pytest.mark.parametrize(("of", "says"), [
    (lambda z: z * GAINS, ""),  # from one pair of electrodes to the next, as converters have them
    (lambda z: 1 / z, "off what the bundle predicts"),
    (lambda z: 20 * np.log10(z), "off what the bundle predicts"),
    (lambda z: z[..., ::-1], "off what the bundle predicts"),
    (lambda z: z[..., np.random.default_rng(4).permutation(120)], "off what the bundle predicts"),
    (lambda z: np.round(z * 255 / z.max()), "in steps of 1, 0.5 % of it"),
    (lambda z: np.round(z * 511 / z.max()), "in steps of 1, 0.2 % of it"),
    (lambda z: np.round(z * 4095 / z.max()), ""),
])  # fmt: skip
def test_rows_of_another_quantity_order_or_too_coarse_are_not_valid(noisy, of, says: str) -> None:
    rows = of(np.vstack([noisy["untouched"][:4], noisy["measurements"][:4]]))
    for data in (Input(rows[4:], rows[:4], None), Input(rows[4:], None, rows[:4]), Input(rows[4:5], rows[:4], None)):
        lines: list[str] = []
        out = reconstructed(data, warn=lines.append)
        assert out["valid"].all() if not says else not out["valid"].any() and says in lines[-1], lines


def test_steps_beside_noise_that_is_finer_and_rows_that_stand_twice_are_no_fault(scenes) -> None:
    """Counts of 10 bits, most of them the same in each of 20 untouched rows; computed rows that stand twice each."""
    clean = scenes["impedance_pairs"]
    noise = 1 + 1e-4 * np.random.default_rng(2).standard_normal((20, 120))
    counts = np.round(np.vstack([clean[0] * noise, clean[4:6]]) * 1023 / clean.max())
    twice = clean[0] * np.repeat([1.0, 1.05], 2)[:, None]
    measured, computed = Input(counts[20:], counts[:20], None), Input(twice, clean[:1], None)
    for data, says in ((measured, "same in every row"), (computed, "one row")):
        lines: list[str] = []
        assert reconstructed(data, warn=lines.append)["valid"].all() and says in lines[0] and len(lines) == 1, lines


def test_a_reason_is_given_once() -> None:
    """disc16 has no force law, and differences alone have no unit: both say that no force is known."""
    bundle, rng = Bundle.load("disc16"), np.random.default_rng(0)
    data = read_scans({"delta": rng.standard_normal((2, len(bundle.pattern)))}, bundle)
    for said in reconstruct(data, Skin(port="stub", bundle="disc16"), bundle)["reasons"]:
        assert len(said.split()) == len({*said.split()}), said


def test_the_console_says_why_a_tare_is_in_doubt(noisy) -> None:
    lines: list[str] = []
    noise = 1 + 1e-2 * np.random.default_rng(2).standard_normal((20, 120))
    rows = Input(noisy["measurements"][:1], noisy["untouched"].mean(axis=0) * noise, None)
    assert not reconstructed(rows, warn=lines.append)["valid"].any()
    assert len(lines) == 1 and "scatter by" in lines[0] and "tare" not in lines[0]


@pytest.mark.parametrize("beside", [1, 4, 20])
@pytest.mark.parametrize("times", [0.02, 1e-6])
def test_a_dead_measurement_or_three_cost_no_row(noisy, beside: int, times: float) -> None:
    rows = np.vstack([noisy["untouched"][:beside], noisy["measurements"][[0, 4, 5]]])
    rows[:, [3, 40, 77]] *= times
    out = reconstructed(Input(rows[beside:], rows[:beside], None), age_s=10.0)
    assert out["valid"].all() and out["count"].tolist() == [0, 1, 1]


def test_what_is_no_impedance_in_untouched_rows_is_no_baseline():
    bundle = Bundle.load("square16")
    rows = bundle.z0 * np.random.default_rng(0).uniform(1.0, 1.001, (3, 120))
    rows[:, 0], rows[:, 1], rows[:, 2] = 0.0, -1.0, np.nan
    baseline = baseline_of(rows, bundle.prereconstructor(), print, rows)
    assert not baseline.z0[:3].any() and np.isinf(baseline.sigma[:3]).all() and not baseline.doubt
    assert (baseline.z0 > 0.9 * bundle.z0)[3:].all() and (baseline.sigma < 1e-3 * bundle.z0)[3:].all()


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
    found = read_scans(arrays, bundle, reading_options(given.get("columns", ""), given.get("pattern", ""), ""))
    ratio = np.abs(found.measurements) / np.abs(rows[:N])
    np.testing.assert_allclose(ratio / ratio[0, 0], 1, rtol=1e-5)
    assert says in found.understood and bool(says) == bool(found.understood)


@pytest.mark.parametrize(("bundle", "of", "says"), [
    (PAIRS, in_turn, "say --columns magnitude-phase; else one of real-imaginary"),
    (PAIRS, in_halves, "say --columns magnitude-then-phase"),
    (PAIRS, lambda z: z[:, SENSE_FIRST], "say --pattern sense-first"),
    (PAIRS, lambda z: np.hstack([z[:, :1], z]), "say --columns 1:"),
    (PAIRS, lambda z: np.ones((len(z), 208)), "measured `adjacent` give 208"),
    (PAIRS, lambda z: np.ones((len(z), 256)), "16 drive pairs by 16 sense pairs of neighbours"),
    (ADJACENT, lambda z: np.ones((208, 256)), "say --columns transposed if so"),
])  # fmt: skip
def test_several_readings_or_none_are_refused_with_what_to_say(bundle, of, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_scans({name: of(z) for name, z in split(rows_of(bundle)).items()}, bundle)


def test_real_rows_beside_complex_ones_are_said_to_be_magnitudes() -> None:
    data = split(rows_of(PAIRS))
    found = read_scans(data | {"untouched": abs(data["untouched"])}, PAIRS)
    assert found.understood == "`untouched` is real beside a complex `measurements`, so magnitudes"


def as_text(rows, sign: str, decimal: str) -> bytes:
    names = ["time (s)", *(f"z_{i}_{j}" for i, j, *_ in PAIRS.pattern + 1), "label"]
    labels = ["touch"] * N + ["empty"] * M
    lines = [sign.join([f"{at}", *(f"{abs(v):.9g}" for v in row), labels[at]]) for at, row in enumerate(rows)]
    return "\n".join([sign.join(names), *(line.replace(".", decimal) for line in lines)]).encode("utf-8-sig")


def numbered(rows) -> bytes:
    """As pandas writes them, in an older Windows, in an order of their own."""
    lines = [f"{at}," + ",".join(f"{abs(v):.9g}" for v in row[::-1]) for at, row in enumerate(rows)]
    return "\n".join(["# \xb5V", "," + ",".join(map(str, range(120)[::-1])), *lines]).encode("latin-1")


def under_a_preamble(rows) -> bytes:
    """As instruments write them: what was measured, names, units."""
    text = as_text(rows, ",", ".").decode("utf-8-sig").replace("\n", "\n" + "s," + "V," * 120 + "-\n", 1)
    return f"Analyser 4\nDate,2024-05-01\n\n{text}".encode()


def in_a_remark(rows) -> bytes:
    """As numpy.savetxt names columns."""
    return b"# " + as_text(rows, " ", ".").replace(b"time (s)", b"time").decode("utf-8-sig").encode()


KINDS = ["names.csv", "names.csv.gz", "decimal_comma.csv", "remark.txt", "numbered.csv", "lines.csv"]
KINDS += ["v5.mat", "v4.mat", "bare.npy", "no_names.npz"]


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_every_kind(tmp_path: Path, kind: str) -> None:
    """Cut anywhere, each gives a sentence, or fewer rows."""
    rows, out, path = rows_of(PAIRS), io.BytesIO(), tmp_path / kind
    {
        "names.csv": lambda: out.write(as_text(rows, ",", ".")),
        "decimal_comma.csv": lambda: out.write(as_text(rows, ";", ",")),
        "remark.txt": lambda: out.write(in_a_remark(rows)),
        "numbered.csv": lambda: out.write(numbered(np.roll(rows, M, axis=0))),
        "lines.csv": lambda: out.write(under_a_preamble(rows)),
        "v5.mat": lambda: scipy.io.savemat(out, {"vi": rows[:N], "vh": rows[N:], "note": "foam"}, do_compression=True),
        "v4.mat": lambda: scipy.io.savemat(out, {"data": rows[:N].T, "baseline": rows[N:].T}, format="4"),
        "bare.npy": lambda: np.save(out, np.roll(rows, M, axis=0)),
        "no_names.npz": lambda: np.savez(out, np.roll(rows, M, axis=0)),
    }[kind.removesuffix(".gz")]()
    whole = gzip.compress(out.getvalue()) if kind.endswith(".gz") else out.getvalue()
    path.write_bytes(whole)
    untouched = str(M) if kind in ("bare.npy", "no_names.npz", "numbered.csv") else ""
    found = read_scans(load_npz(path), PAIRS, reading_options("", "", untouched))
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
