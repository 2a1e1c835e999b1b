"""Real presses on hydrogel: how far the service finds them from where the probe stood.

First, hydrogel_disc16.npz (500 presses, D. Hardman and colleagues): the skin is registered on the first 100, the other
400 are scored, through `skin reconstruct` with more and more of what the 100 teach, and frame by frame as a board's.
Then, over several random splits, that file and hydrogel_vse_concentric.npz beside it (2500 presses of a skin that is
uneven on purpose, differences only), registered on few and on many presses.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.goals import Goal
from models.bundle import Bundle
from models.locator import NINETY, Locator
from services.calibration.locating import build, true_places
from services.calibration.presses import Presses, RegistrationError, part, read_presses
from services.calibration.registration import Similarity, register
from services.calibration.response import fit
from services.calibration.sensitivity import write_corrected
from services.pipeline import Pipeline
from services.recordings.file_source import FILE_RATE_HZ, file_frame
from services.recordings.npz_file import Input, frames_of, load_npz, read_scans
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

Array = NDArray[np.float64]

SKIN = "disc16"  # the uniform disc
FILE, CONCENTRIC = "hydrogel_disc16.npz", "hydrogel_vse_concentric.npz"
TRAINING = 100
AGREE_M = 0.5e-3
CASES: tuple[tuple[str, int, float | None], ...] = (
    (FILE, 10, 8.0),
    (FILE, 100, 2.4),
    (FILE, 300, None),
    (CONCENTRIC, 100, 4.0),
    (CONCENTRIC, 300, 2.9),
    (CONCENTRIC, 1000, 1.8),
)
"""File, presses that register the skin, target of the others' median error [mm]."""
MOST_OTHERS = 400
QUICK = 300  # presses that register a skin, at most, in the short form
CONFIDENTLY = 1.5  # times its 90 % ellipse: a press that is farther off was stated too surely
SPLIT_COLUMNS = (
    ("median_mm", "median mm", 1.0),
    ("p95_mm", "p95 mm", 1.0),
    ("in_90_percent_ellipse", "in 90 % ellipse, %", 100.0),
    ("confidently_wrong", "1.5 x beyond, %", 100.0),
    ("counted_as_one", "one touch, %", 100.0),
    ("depth_mae_mm", "depth MAE mm", 1.0),
)


def run(file: Path, count: int, quick: bool) -> dict[str, Any]:
    """Both tables. Raises OSError where there is no such file, BundleError."""
    if not file.is_file():
        raise FileNotFoundError(f"no file {file}")
    rows, live = others_of_a_hundred(file)
    return {"file": file.name, "rows": rows, "live_path": live, "splits": splits(file, 1 if quick else count, quick)}


def others_of_a_hundred(file: Path) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """The rows of the first table, and what `live_path` counts."""
    arrays, bundle = load_npz(file), Bundle.load(SKIN)
    first, others = slice(0, TRAINING), slice(TRAINING, None)
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (first, others))
    touched, untouched, xy = arrays["touched"], arrays["untouched"], arrays["xy"]  # in the file's order, as frames are
    linear = dataclasses.replace(bundle, manifest={**bundle.manifest, "files": {"matrices.npz": ""}})
    found, seen, seconds = positions(linear, touched, untouched)
    fitted = similarity_of(found[first], xy[first])
    rows = [summary("uniform disc, one step; similarity", errors(found[others], fitted, xy[others]), seconds)]
    similarity = register(train, bundle).similarity
    true_size = dataclasses.replace(similarity, scale=1.0)
    locator, response, _ = build(train, similarity, bundle)
    live: dict[str, int] = {}
    for name, map_, shipped in (
        ("+ a gain per measurement", fit(train, similarity, bundle, field=False), None),
        ("+ the measured response map", response, None),
        ("+ its likelihood (skin register)", response, locator),
    ):
        with tempfile.TemporaryDirectory() as folder:
            own = write_corrected(Path(folder) / "own", train, map_, shipped, {})
            found, seen, seconds = positions(own, touched[others], untouched[others])
            live = live_path(own, arrays) if shipped is not None else {}
        rows.append(summary(name, errors(found, true_size, xy[others]), seconds, int(seen.sum())))
    began = time.perf_counter()
    guess = kernel_ridge(train, test)
    seconds = (time.perf_counter() - began) / len(test)
    rows.append(summary("kernel ridge on the same 100", np.linalg.norm(guess - test.xy, axis=1), seconds))
    return rows, live


def positions(bundle: Bundle, touched: Array, untouched: Array) -> tuple[Array, NDArray[np.bool_], float]:
    """(N, 2) m of the strongest contact in the bundle's frame (NaN: none), whether touched, seconds per press."""
    began = time.perf_counter()
    out = reconstruct(Input(touched, None, untouched), Skin(port="stub", bundle=str(bundle.path)), bundle)
    return out["position"][:, 0], out["touched"], (time.perf_counter() - began) / len(touched)


def similarity_of(found: Array, xy: Array) -> Similarity:
    """The similarity from positions found to machine positions, weighted so that outliers count less (L1)."""
    seen = np.isfinite(found).all(axis=1)
    made: list[tuple[float, Similarity]] = []
    for mirrored in (False, True):
        flip = np.array([1.0, -1.0 if mirrored else 1.0])
        p, q = (found[seen] * flip) @ [1, 1j], xy[seen] @ [1, 1j]
        weight = np.ones(len(p))
        for _ in range(50):
            weight /= weight.sum()
            pc, qc = p - weight @ p, q - weight @ q
            turn = (weight * pc.conj()) @ qc / ((weight * abs(pc) ** 2).sum() + 1e-30)
            shift = weight @ q - turn * (weight @ p)
            left = abs(turn * p + shift - q)
            weight = 1 / np.maximum(left, 1e-3)
        at = np.array([shift.real, shift.imag])
        made.append((float(np.median(left)), Similarity(float(np.angle(turn)), float(abs(turn)), at, mirrored)))
    return min(made, key=lambda each: each[0])[1]


def errors(found: Array, similarity: Similarity, xy: Array) -> Array:
    """(N,) m; a press that was not found counts as found at the skin's centre."""
    return np.asarray(np.linalg.norm(similarity.to_machine(np.nan_to_num(found)) - xy, axis=1))


def summary(name: str, distance: Array, seconds: float, touched: int | None = None) -> dict[str, Any]:
    median, p95 = 1e3 * np.percentile(distance, (50, 95))
    told = {"median_mm": float(median), "mean_mm": 1e3 * float(distance.mean()), "p95_mm": float(p95)}
    return {"method": name, **told, "presses": len(distance), "touched": touched, "ms_per_press": seconds * 1e3}


def kernel_ridge(presses: Presses, test: Presses) -> Array:
    """Positions by kernel ridge regression on the normalised differences: what learning from the 100 alone gives."""
    scale = np.abs(presses.difference).mean(axis=0)
    x, y = (p.difference / scale for p in (presses, test))
    x, y = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, y))
    mean = presses.xy.mean(axis=0)
    weight = np.linalg.solve(_rbf(x, x) + 0.01 * np.eye(len(x)), presses.xy - mean)
    return np.asarray(_rbf(y, x) @ weight + mean)


def _rbf(a: Array, b: Array) -> Array:
    return np.asarray(np.exp(-((a[:, None] - b[None]) ** 2).sum(axis=-1)))


def live_path(bundle: Bundle, arrays: dict[str, NDArray[Any]]) -> dict[str, int]:
    """Count, among presses that took no part in the registration, those that the live path finds, and those of them
    that it finds where the offline path does.
    """
    skin, data = Skin(port="stub", bundle=str(bundle.path), frame_id="skin"), read_scans(arrays, bundle)
    offline = reconstruct(data, skin, bundle)
    pipeline, contacts = Pipeline(skin, bundle=bundle), []
    for scan, (values, kind) in enumerate(frames_of(data), start=1):
        frame = file_frame("skin", "", scan, values, kind, round(scan * 1e9 / FILE_RATE_HZ), data.separate)
        contact = pipeline.run(frame).contact
        if kind == "full":
            contacts.append(contact)
    found = agree = 0
    for contact, place in zip(contacts[TRAINING:], offline["position"][TRAINING:, 0], strict=True):
        seen = [c for c in contact.contacts if c.state != "end"]
        if contact.valid and len(seen) == 1:
            found += 1
            agree += bool(np.linalg.norm(np.array(seen[0].position[:2]) - place) < AGREE_M)
    offline_found = int((offline["touched"] & offline["valid"])[TRAINING:].sum())
    return {"presses": len(contacts) - TRAINING, "offline": offline_found, "found": found, "agree": agree}


def splits(file: Path, count: int, quick: bool) -> list[dict[str, Any]]:
    """A row for each case whose file is there: the first presses of the file (of the concentric one, whose places are
    in no order, of a first shuffle), then random ones.
    """
    bundle, rows = Bundle.load(SKIN), []
    for name, presses, target in CASES:
        path = file if name == FILE else file.parent / name
        if not path.is_file() or (quick and presses > QUICK):
            continue
        arrays = load_npz(path)
        n = len(arrays["xy"])
        orders = [np.arange(n) if name == FILE else np.random.default_rng(1).permutation(n)]
        orders += [np.random.default_rng(seed).permutation(n) for seed in range(2, 1 + count)]
        each = [one(arrays, bundle, order, presses) for order in orders]
        rows.append({"file": path.stem, "presses": presses, "target_mm": target, "splits": each})
    return rows


def one(arrays: Mapping[str, Any], bundle: Bundle, order: Any, presses: int) -> dict[str, Any]:
    """Registered on the first of this order, scored on those that follow. A refusal is a row too."""
    train = read_presses(part(arrays, order[:presses]), bundle)
    test = read_presses(part(arrays, order[presses : presses + MOST_OTHERS]), bundle)
    try:
        similarity = register(train, bundle).similarity
        made, _, crossed = build(train, similarity, bundle)
    except RegistrationError as why:
        return {"refused": str(why)}
    locator, places = Locator(made), true_places(test.xy, similarity)
    # Another part of one file of differences: in the unit that the skin was registered in.
    found = [locator.locate(d * train.unit / test.unit, train.noise) for d in test.difference]
    apart = np.array([[t[0].x, t[0].y] if t else similarity.offset * 0 for t in found]) - places
    distance = np.linalg.norm(apart, axis=1)
    beyond = [
        float(np.sqrt(a @ np.linalg.solve(t[0].covariance, a) / NINETY)) if t else 0.0
        for t, a in zip(found, apart, strict=True)
    ]
    seen = np.array([bool(t) for t in found])
    row: dict[str, Any] = {
        "median_mm": 1e3 * float(np.median(distance)),
        "p95_mm": 1e3 * float(np.percentile(distance, 95)),
        "in_90_percent_ellipse": float(np.mean(seen & (np.array(beyond) <= 1.0))),
        "confidently_wrong": float(np.mean(np.array(beyond) > CONFIDENTLY)),
        "counted_as_one": float(np.mean([len(t) == 1 for t in found])),
        "corrected": crossed.corrected,
    }
    if locator.quantity == "indentation_m" and test.value is not None:
        told = [t[0].value if t else np.nan for t in found]
        row["depth_mae_mm"] = 1e3 * float(np.nanmean(np.abs(np.array(told, float) - test.value)))
    return row


def goals(found: dict[str, Any]) -> list[Goal]:
    made = [Goal(f"real presses, {row['method']}: median, mm", row["median_mm"]) for row in found["rows"]]
    for row in found["splits"]:
        medians = [each["median_mm"] for each in row["splits"] if "refused" not in each]
        figure = f"real presses, {row['file']} registered on {row['presses']}: median of the others, mm"
        made.append(Goal(figure, float(np.mean(medians)) if medians else None, at_most=row["target_mm"]))
    return made


def show(found: dict[str, Any]) -> None:
    print(f"{'real presses, ' + found['file']:40s} median mm  mean mm  p95 mm  touched  ms/press")
    for row in found["rows"]:
        touched = "" if row["touched"] is None else f"{row['touched']}/{row['presses']}"
        print(
            f"{row['method']:40s} {row['median_mm']:9.1f} {row['mean_mm']:8.1f} {row['p95_mm']:7.1f} {touched:>8s} "
            f"{row['ms_per_press']:9.2f}"
        )
    print(
        "live path: {found} of {presses} found as one valid contact (offline {offline} are touched and valid), "
        "{agree} within 0.5 mm of offline".format(**found["live_path"])
    )
    print("\n" + f"{'registered on':32s}" + "".join(f"{title:>22s}" for _, title, _ in SPLIT_COLUMNS))
    for row in found["splits"]:
        cells = []
        for key, _, times in SPLIT_COLUMNS:
            values = times * np.array([each[key] for each in row["splits"] if key in each])
            cells.append(f"{values.mean():.2f} ({values.std():.2f})" if len(values) else "-")
        print(f"{row['file'] + ', ' + str(row['presses']):32s}" + "".join(f"{cell:>22s}" for cell in cells))
        for each in row["splits"]:
            if "refused" in each:
                print(f"  one refused: {each['refused']}")
