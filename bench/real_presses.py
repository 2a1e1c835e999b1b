"""Where real presses on hydrogel skins are found, by others of the same skin: `python -m bench.real_presses FILE`.

FILE is hydrogel_disc16.npz: 500 presses of D. Hardman and colleagues (github.com/DSHardman/HydrogelEIT, superpose500).
The first 100 register the skin; nothing is chosen by the other 400. Every row of the first table but the last goes
through the runtime stages, each press against the untouched frame just before it.

A line below the table says how many of the 400 the live path finds as one valid contact, and how many of those within
0.5 mm of what `skin reconstruct` says: the whole file's frames as a replay or a port gives them, one after the other.
Exit status 1 where those are fewer than 396.

The second table has that file and hydrogel_vse_concentric.npz beside it (2500 presses of a skin that is uneven on
purpose, differences only), registered on few and on many presses, over several random splits; --quick makes one split.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.press_splits import CASES, CONCENTRIC, print_splits, splits
from models.bundle import Bundle, BundleError
from models.command import whole
from services.calibration.locating import build
from services.calibration.presses import Presses, part, read_presses
from services.calibration.registration import Similarity, register
from services.calibration.response import fit
from services.calibration.sensitivity import write_corrected
from services.pipeline import Pipeline
from services.recordings.file_source import FILE_RATE_HZ, file_frame
from services.recordings.npz_file import Input, frames_of, read_scans
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

Array = NDArray[np.float64]

TRAINING = 100
AGREE_M = 0.5e-3
FEWEST_AGREE = 396  # of the other 400


def positions(bundle: Bundle, touched: Array, untouched: Array) -> tuple[Array, NDArray[np.bool_], float]:
    """(N, 2) m of the strongest contact in the bundle's frame (NaN: none), whether touched, seconds per press."""
    began = time.perf_counter()
    out = reconstruct(Input(touched, None, untouched), Skin(port="stub", bundle=str(bundle.path)), bundle)
    return out["position"][:, 0], out["touched"], (time.perf_counter() - began) / len(touched)


def similarity_of(found: Array, xy: Array) -> Similarity:
    """The similarity from positions found to machine positions, weighted so that outliers count less (L1)."""
    seen = np.isfinite(found).all(axis=1)
    a, b = found[seen], xy[seen]
    best: tuple[float, Similarity] | None = None
    for mirrored in (False, True):
        flip = np.array([1.0, -1.0 if mirrored else 1.0])
        p, q = (a * flip) @ [1, 1j], b @ [1, 1j]
        weight = np.ones(len(p))
        for _ in range(50):
            weight /= weight.sum()
            pc, qc = p - weight @ p, q - weight @ q
            turn = (weight * pc.conj()) @ qc / ((weight * abs(pc) ** 2).sum() + 1e-30)
            shift = weight @ q - turn * (weight @ p)
            left = abs(turn * p + shift - q)
            weight = 1 / np.maximum(left, 1e-3)
        fit = Similarity(float(np.angle(turn)), float(abs(turn)), np.array([shift.real, shift.imag]), mirrored)
        if best is None or np.median(left) < best[0]:
            best = float(np.median(left)), fit
    assert best is not None
    return best[1]


def errors(found: Array, similarity: Similarity, xy: Array) -> Array:
    """(N,) m; a press that was not found counts as found at the skin's centre."""
    return np.asarray(np.linalg.norm(similarity.to_machine(np.nan_to_num(found)) - xy, axis=1))


def summary(name: str, distance: Array, touched: NDArray[np.bool_] | None, seconds: float) -> dict[str, Any]:
    return {
        "method": name,
        "median_mm": float(np.median(distance) * 1e3),
        "mean_mm": float(distance.mean() * 1e3),
        "p95_mm": float(np.percentile(distance, 95) * 1e3),
        "touched": None if touched is None else int(touched.sum()),
        "ms_per_press": seconds * 1e3,
    }


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


def run(file: Path, skin: str) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """The rows of the table, and what `live_path` counts."""
    with np.load(file, allow_pickle=False) as data:
        arrays = dict(data)
    bundle = Bundle.load(skin)
    first, others = slice(0, TRAINING), slice(TRAINING, None)
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (first, others))
    touched, untouched, xy = arrays["touched"], arrays["untouched"], arrays["xy"]  # in the file's order, as frames are
    rows = []
    linear = dataclasses.replace(bundle, manifest={**bundle.manifest, "files": {"matrices.npz": ""}})
    found, seen, seconds = positions(linear, touched, untouched)
    fitted = similarity_of(found[first], xy[first])
    rows.append(
        summary("uniform disc, one step; similarity", errors(found[others], fitted, xy[others]), seen[others], seconds)
    )
    similarity = register(train, bundle).similarity
    true_size = dataclasses.replace(similarity, scale=1.0)
    locator, response, _ = build(train, similarity, bundle)
    gains = fit(train, similarity, bundle, field=False)
    for name, map_, shipped in (
        ("+ a gain per measurement", gains, None),
        ("+ the measured response map", response, None),
        ("+ its likelihood (skin register)", response, locator),
    ):
        with tempfile.TemporaryDirectory() as folder:
            own = write_corrected(Path(folder) / "own", train, map_, shipped, {})
            found, seen, seconds = positions(own, touched[others], untouched[others])
            live = live_path(own, arrays) if shipped is not None else {}
        rows.append(summary(name, errors(found, true_size, xy[others]), seen, seconds))
    began = time.perf_counter()
    guess = kernel_ridge(train, test)
    seconds = (time.perf_counter() - began) / len(test)
    rows.append(summary("kernel ridge on the same 100", np.linalg.norm(guess - test.xy, axis=1), None, seconds))
    return rows, live


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench.real_presses", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, nargs="?", help="hydrogel_disc16.npz; default: in $EITSKIN_REFERENCE")
    parser.add_argument("--skin", default="disc16", help="bundle of the uniform disc")
    parser.add_argument("--splits", type=whole(), default=3, help="random splits of each row of the second table")
    parser.add_argument("--quick", action="store_true", help="one split, and at most 300 presses")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    args = parser.parse_args(argv)
    file = args.file or Path(os.environ.get("EITSKIN_REFERENCE", "../shared/data")) / "hydrogel_disc16.npz"
    if not file.is_file():
        print(f"no file {file}: name hydrogel_disc16.npz, or set EITSKIN_REFERENCE to its folder", file=sys.stderr)
        return 2
    try:
        rows, live = run(file, args.skin)
    except BundleError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{'method':40s} median mm  mean mm  p95 mm  touched  ms/press")
    for row in rows:
        touched = "" if row["touched"] is None else f"{row['touched']}/400"
        print(
            f"{row['method']:40s} {row['median_mm']:9.1f} {row['mean_mm']:8.1f} {row['p95_mm']:7.1f} {touched:>8s} "
            f"{row['ms_per_press']:9.2f}"
        )
    print(
        "live path: {found} of {presses} found as one valid contact (offline {offline} are touched and valid), "
        "{agree} within 0.5 mm of offline".format(**live)
    )
    files = {name: file if name != CONCENTRIC else file.parent / f"{CONCENTRIC}.npz" for name, _, _ in CASES}
    crossed = splits(files, args.skin, 1 if args.quick else args.splits, 300 if args.quick else None)
    print_splits(crossed)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        report = {"presses": 400, "registered_on": TRAINING, "rows": rows, "live_path": live, "splits": crossed}
        args.out.write_text(json.dumps(report, indent=2) + "\n")
    return 0 if live["agree"] >= FEWEST_AGREE else 1


if __name__ == "__main__":
    sys.exit(main())
