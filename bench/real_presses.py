"""Where 400 real presses on a hydrogel skin are found, after 100 others: `python -m bench.real_presses FILE`.

FILE is hydrogel_disc16.npz: 500 presses of D. Hardman and colleagues (github.com/DSHardman/HydrogelEIT, superpose500).
The first 100 fit the frame, the gains and the sensitivities; nothing is chosen by the other 400. Every row but the last
goes through the runtime stages, each press against the untouched frame just before it.
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

from models.bundle import Bundle, BundleError
from services.calibrating.registration import Presses, Similarity, part, read_presses, register
from services.calibrating.sensitivity import write_corrected
from services.config import Skin
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct

Array = NDArray[np.float64]

TRAINING = 100


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
    return np.linalg.norm(similarity.to_machine(np.nan_to_num(found)) - xy, axis=1)


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
    return np.exp(-((a[:, None] - b[None]) ** 2).sum(axis=-1))


def run(file: Path, skin: str) -> list[dict[str, Any]]:
    """The rows of the table."""
    with np.load(file, allow_pickle=False) as data:
        arrays = dict(data)
    bundle = Bundle.load(skin)
    first, others = slice(0, TRAINING), slice(TRAINING, None)
    train, test = (read_presses(part(arrays, rows), bundle) for rows in (first, others))
    touched, untouched = arrays["touched"], arrays["untouched"]
    rows = []
    linear = dataclasses.replace(bundle, manifest={**bundle.manifest, "files": {"matrices.npz": ""}})
    found, seen, seconds = positions(linear, touched, untouched)
    fit = similarity_of(found[first], train.xy)
    rows.append(
        summary("uniform disc, one step; similarity", errors(found[others], fit, test.xy), seen[others], seconds)
    )
    similarity, _ = register(train, bundle)
    true_size = dataclasses.replace(similarity, scale=1.0)
    for name, share in (("+ a gain per measurement", 0.0), ("+ smooth corrections (skin register)", None)):
        with tempfile.TemporaryDirectory() as folder:
            options = {} if share is None else {"field_share": share}
            own = write_corrected(Path(folder) / "own", train, similarity, bundle, {}, **options)
            found, seen, seconds = positions(own, touched[others], untouched[others])
        rows.append(summary(name, errors(found, true_size, test.xy), seen, seconds))
    began = time.perf_counter()
    guess = kernel_ridge(train, test)
    seconds = (time.perf_counter() - began) / len(test)
    rows.append(summary("kernel ridge on the same 100", np.linalg.norm(guess - test.xy, axis=1), None, seconds))
    return rows


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench.real_presses", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, nargs="?", help="hydrogel_disc16.npz; default: in $EITSKIN_REFERENCE")
    parser.add_argument("--skin", default="disc16", help="bundle of the uniform disc")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    args = parser.parse_args(argv)
    file = args.file or Path(os.environ.get("EITSKIN_REFERENCE", "../shared/data")) / "hydrogel_disc16.npz"
    if not file.is_file():
        print(f"no file {file}: name hydrogel_disc16.npz, or set EITSKIN_REFERENCE to its folder", file=sys.stderr)
        return 2
    try:
        rows = run(file, args.skin)
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
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({"presses": 400, "registered_on": TRAINING, "rows": rows}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
