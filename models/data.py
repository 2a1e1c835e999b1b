"""Training data: random contacts, solved on perturbed skins, in chunk files that can be made anywhere and in any order.

    python -m models.data --skin square16 --n 20000 --jobs 2

Each chunk is several hundred scenes on one skin as it might have been mounted (electrodes shifted along the outline,
contact impedances and background off, a little anisotropy and a smooth field: what a calibration leaves of them); 40 %
of chunks are the nominal skin. A touch in six has a soft edge. A chunk depends on (seed, split, index)
alone, so a run can be stopped and taken up again, and any number of processes on any joblib backend gives the same
files. Noise and drift are not in the data: training adds them, afresh each time.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from models import command, geometry
from models.condensed import CondensedSheet
from models.forward import ForwardModel
from models.mismatch import SmoothField, anisotropy_root, soft_drop, soft_touched, turned
from models.npz import read_npz
from models.scenes import TRAINING, random_scene
from models.shapes import Shape, drop_image, from_rows, to_rows
from protocol.errors import EitskinError
from protocol.whole_file import whole_file, write_whole


class OtherScenes(EitskinError, ValueError):
    """The folder holds scenes that must not be mixed with those of this run."""


class NoScenes(EitskinError, FileNotFoundError):
    """A folder has no finished scenes to train with, or to measure with."""


WORK = Path(__file__).parent / "work"
SPLITS = ("test", "train", "valid")
IMAGE = 48  # pixels a side
SCHEMA = 2  # of the chunk files: 1 had no soft edges

NOMINAL_SHARE = 0.4
CONTACT_SPREAD = 0.30  # each electrode, relative, uniform
BACKGROUND_SPREAD = 0.05
SHIFT_SPREAD = 0.03  # of the electrode spacing, standard deviation
FIELD_LEFT, ANISOTROPY_LEFT = 0.015, 0.01  # largest of each, relative: what a calibration leaves of 5 to 10 %
SOFT_SHARE = 0.16  # of scenes whose touches have soft edges
SOFT_EDGE = (0.01, 0.1)  # standard deviation of the blur, model units: 0.5 to 5 mm on the square skin
WORTH_INVERSE = 400  # scenes of a chunk from which the untouched sheet's inverse, two seconds, is worth its time


@dataclass(frozen=True)
class ChunkSpec:
    """What a chunk is made from, and all it depends on."""

    skin: str
    split: str
    index: int
    size: int
    seed: int
    mesh: str = "training"

    @property
    def file(self) -> str:
        return f"{self.split}-{self.index:05d}.npz"


@lru_cache(maxsize=1)
def _nominal(skin: str, mesh: str) -> ForwardModel:
    """The nominal skin's model, kept for the process: meshing takes as long as dozens of solves."""
    nominal = geometry.load(skin)
    return ForwardModel(nominal, nominal.pattern, mesh=mesh)


@lru_cache(maxsize=1)
def _nominal_condensed(skin: str, mesh: str) -> CondensedSheet:
    model = _nominal(skin, mesh)
    return CondensedSheet(model, model.touched([]))


def make_chunk(spec: ChunkSpec) -> dict[str, NDArray[Any]]:
    """Solve one chunk of S scenes on one variant of the skin; K measurements, E electrodes.

    difference (S, K) float32: |Z| / |Z0| - 1 against this variant's own Z0, without noise
    shapes (S, 3, 7) float32, image (S, 48, 48) float16: drop [S/m] on a background of 1
    blur (S,) float32: standard deviation of the touches' soft edges [model units], 0: sharp
    z0 (K,) ohm, contact_impedance (E,), background (), shift (E,) of each electrode along the outline [model units]
    """
    rng = np.random.default_rng([spec.seed, SPLITS.index(spec.split), spec.index])
    skin = geometry.load(spec.skin)
    n = skin.n_electrodes
    nominal = rng.random() < NOMINAL_SHARE or spec.split == "test"
    if nominal:
        wide, shift, model = 0.0, np.zeros(n), _nominal(spec.skin, spec.mesh)
    else:
        wide, shift = 1.0, np.clip(rng.standard_normal(n), -2, 2) * SHIFT_SPREAD * skin.perimeter / n
        model = ForwardModel(skin.moved(shift), skin.pattern, mesh=spec.mesh)
    contact = skin.contact_impedance * (1 + wide * CONTACT_SPREAD * rng.uniform(-1, 1, n))
    background = 1 + wide * BACKGROUND_SPREAD * rng.uniform(-1, 1)
    field = SmoothField(skin, wide * FIELD_LEFT * rng.uniform(), int(rng.integers(2**31)))(model.centroids)
    root = anisotropy_root(wide * ANISOTROPY_LEFT * rng.uniform(), rng.uniform(0, np.pi))

    def sheet(scene: list[Shape], blur: float) -> NDArray[np.float64]:
        """Conductivity tensors; a touch takes its share of whatever conducts where it is."""
        touched = soft_touched(model, scene, blur) if scene and blur else model.touched(scene)
        return turned(touched * (background * (1 + field))[:, None], root)

    if spec.size >= WORTH_INVERSE:
        solve = (
            _nominal_condensed(spec.skin, spec.mesh) if nominal else CondensedSheet(model, sheet([], 0.0), contact)
        ).impedances
    else:

        def solve(conductivity: NDArray[np.float64]) -> NDArray[np.float64]:
            return model.solve(conductivity, contact).impedances()

    z0 = np.abs(model.solve(sheet([], 0.0), contact).impedances())
    prior = TRAINING.on(skin)
    difference = np.empty((spec.size, len(z0)), np.float32)
    rows = np.empty((spec.size, 3, 7), np.float32)
    images = np.empty((spec.size, IMAGE, IMAGE), np.float16)
    blurs = np.where(rng.random(spec.size) < SOFT_SHARE, rng.uniform(*SOFT_EDGE, spec.size), 0.0).astype(np.float32)
    for k, blur in enumerate(blurs.tolist()):
        rows[k] = to_rows(random_scene(rng, prior, skin.inside))
        scene = from_rows(rows[k].astype(float))  # the float32 rows: what is stored is what was solved
        difference[k] = np.abs(solve(sheet(scene, blur))) / z0 - 1
        images[k] = soft_drop(scene, blur, IMAGE) if blur else drop_image(scene, IMAGE)
    return {
        "difference": difference,
        "shapes": rows,
        "image": images,
        "blur": blurs,
        "z0": z0,
        "contact_impedance": contact,
        "background": np.array(background),
        "shift": shift,
    }


@contextmanager
def _backend(name: str, scheduler: str | None) -> Iterator[None]:
    """joblib's configuration for a backend by name; "dask" joins the scheduler's cluster, "ray" the running one."""
    client: AbstractContextManager[object] = nullcontext()
    if name == "dask":
        from distributed import Client

        client = Client(scheduler)  # becomes the default client, which joblib's backend asks for
    elif name == "ray":
        from ray.util.joblib import register_ray

        register_ray()
    with client, joblib.parallel_config(backend=name):
        yield


def generate(
    folder: Path,
    specs: list[ChunkSpec],
    jobs: int = 1,
    backend: str = "loky",
    scheduler: str | None = None,
    quiet: bool = False,
) -> int:
    """Make the chunks that `folder` lacks; returns how many scenes that was. Files appear whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    _check_same_run(folder, specs[0])
    todo = [s for s in specs if not (folder / s.file).exists()]
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with _backend(backend, scheduler), Progress(*columns, disable=quiet) as progress:
        bar = progress.add_task(f"{specs[0].skin} scenes", total=sum(s.size for s in specs))
        progress.advance(bar, sum(s.size for s in specs) - sum(s.size for s in todo))
        for start in range(0, len(todo), max(1, 2 * jobs)):
            # a few chunks at a time: every backend has ordered lists, not all have generators
            batch = todo[start : start + max(1, 2 * jobs)]
            made = joblib.Parallel(n_jobs=jobs)(joblib.delayed(make_chunk)(s) for s in batch)
            for spec, arrays in zip(batch, made, strict=True):
                with whole_file(folder / spec.file) as part:
                    np.savez_compressed(part, **arrays)
                progress.advance(bar, spec.size)
    return sum(s.size for s in todo)


def chunk_size(folder: Path) -> int:
    """Scenes of a chunk of the folder; 0 where it has none yet."""
    path = folder / "data.json"
    return int(json.loads(path.read_text())["chunk"]) if path.exists() else 0


def _digest(skin: geometry.SkinGeometry) -> str:
    return hashlib.sha256(json.dumps(skin.to_dict(), sort_keys=True).encode()).hexdigest()[:16]


def check_skin(folder: Path, skin: geometry.SkinGeometry) -> None:
    """Raises OtherScenes where a folder says that its scenes are of another skin."""
    path = folder / "data.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    if found.get("geometry", _digest(skin)) != _digest(skin):  # older folders do not say
        raise OtherScenes(
            f"{folder} holds scenes of a skin {found.get('skin')!r} that is not '{skin.name}' as it is now: name the "
            f"folder of its scenes, or make some with python -m models.data --skin {skin.name}"
        )


def _check_same_run(folder: Path, spec: ChunkSpec) -> None:
    """Chunks of another seed, skin or mesh must not be mixed in: samples could repeat, or not mean the same."""
    digest = _digest(geometry.load(spec.skin))
    wanted = {"schema": SCHEMA, "skin": spec.skin, "mesh": spec.mesh, "seed": spec.seed, "chunk": spec.size}
    path = folder / "data.json"
    if not path.exists():
        write_whole(path, json.dumps(wanted | {"geometry": digest}, indent=1) + "\n")
    found = json.loads(path.read_text())
    if found.pop("geometry", digest) != digest:  # older folders do not say
        raise OtherScenes(
            f"{folder} holds scenes of skin '{spec.skin}' as it was before its outline, electrodes or pattern changed: "
            f"remove that folder, or name another with --work"
        )
    if found != wanted:
        raise OtherScenes(f"{path} says {found}, this run is {wanted}: use another folder, or remove this one")


@dataclass(frozen=True, eq=False)
class Dataset:
    """N scenes of V chunks: see `make_chunk`. z0 is (V, K) and `variant` (N,) points into it."""

    difference: NDArray[np.float32]
    image: NDArray[np.float16]
    shapes: NDArray[np.float32]
    blur: NDArray[np.float32]
    variant: NDArray[np.int64]
    z0: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.difference)


def chunk_files(folder: Path, split: str = "train") -> list[Path]:
    """Finished chunks of a split, in order: more may appear while a generation runs."""
    return sorted(folder.glob(f"{split}-*.npz"))


def load(folder: Path, split: str = "train", limit: int | None = None, skip: int = 0) -> Dataset:
    """Read the finished chunks of a split from number `skip` on, `limit` scenes at most. Raises NoScenes,
    OtherScenes, FileError.
    """
    parts = list(_read(folder, split, limit, skip))
    if not parts:
        raise NoScenes(
            f"found no {split}-*.npz in {folder}, expected scenes: name the folder that has them, or make some with "
            "python -m models.data"
        )
    variant = np.repeat(np.arange(len(parts)), [len(p["difference"]) for p in parts])
    rest = {k: np.concatenate([p[k] for p in parts]) for k in ("difference", "image", "shapes", "blur")}
    cut = slice(0, limit)
    z0 = np.stack([p["z0"] for p in parts])
    return Dataset(variant=variant[cut], z0=z0, **{k: v[cut] for k, v in rest.items()})


def _read(folder: Path, split: str, limit: int | None, skip: int) -> Iterator[dict[str, NDArray[Any]]]:
    count = 0
    for path in chunk_files(folder, split)[skip:]:
        if limit is not None and count >= limit:
            return
        part = read_npz(path)
        if lacks := {"difference", "image", "shapes", "blur", "z0"} - set(part):
            raise OtherScenes(
                f"{path}: found no array {min(lacks)!r}, expected scenes of this version: remove {folder}"
            )
        count += len(part["difference"])
        yield part


def specs(skin: str, split: str, n: int, seed: int, chunk: int = 1000, mesh: str = "training") -> list[ChunkSpec]:
    """Chunks that hold at least n scenes."""
    return [ChunkSpec(skin, split, k, chunk, seed, mesh) for k in range(-(-n // chunk))]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.data", description="Make training data for a skin.")
    parser.add_argument("--skin", default="square16", help="a shipped skin or a .toml file")
    parser.add_argument("--n", type=int, default=20000, help="training scenes")
    parser.add_argument("--valid", type=int, default=1000, help="held-out scenes")
    parser.add_argument("--out", type=Path, help="folder (default models/work/SKIN)")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="loky", help="joblib backend: loky, threading, dask, ray")
    parser.add_argument("--scheduler", help="address of a Dask scheduler")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    args = parser.parse_args(argv)
    folder = args.out or WORK / Path(args.skin).stem
    start = time.perf_counter()
    wanted = specs(args.skin, "valid", args.valid, args.seed) + specs(args.skin, "train", args.n, args.seed)
    made = generate(folder, wanted, args.jobs, args.backend, args.scheduler, args.quiet)
    took = time.perf_counter() - start
    print(f"{folder}: {made} scenes made in {took:.0f} s ({made / max(took, 1e-9):.1f}/s with {args.jobs} jobs)")


if __name__ == "__main__":
    # Workers look make_chunk up by its module's name, which must not be __main__.
    from models.data import main as importable

    command.run("models.data", importable)
