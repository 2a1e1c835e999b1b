"""A bundle: the folder a skin runs from, with a hash of every file in its manifest (numpy only).

    models/bundles/square16/manifest.json      geometry, pattern, image grid, provenance, measured figures, hashes
                            matrices.npz       see prereconstruction.Matrices
                            network.onnx       "full"
                            network_fast.onnx  "fast"
                            network_int8.onnx  "int8"

Networks may be missing. A bundle without any is a working bundle: the services then show the one-step image.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from models.prereconstruction import Matrices, PreReconstructor

SCHEMA = 1
BUNDLES = Path(__file__).parent / "bundles"
MAX_BYTES = 8 * 1024 * 1024
NETWORKS = {"full": "network.onnx", "fast": "network_fast.onnx", "int8": "network_int8.onnx"}
CLASSES = ("circle", "triangle", "rectangle", "square", "L")


class BundleError(Exception):
    """The bundle cannot be used; says what was found, what was expected and what to do."""


@dataclass(frozen=True)
class Bundle:
    """A bundle whose hashes were found right."""

    path: Path
    manifest: dict[str, Any]
    matrices: Matrices
    hash: str  # sha256 of manifest.json, which holds the hashes of everything else

    @property
    def name(self) -> str:
        return str(self.manifest["name"])

    @property
    def skin(self) -> dict[str, Any]:
        """Geometry: see models/geometry.py (`Skin`), as a plain dict."""
        return dict(self.manifest["skin"])

    @property
    def pattern(self) -> npt.NDArray[np.integer]:
        """(K, 4) drive+, drive-, sense+, sense-, 0-based."""
        return self.matrices.pattern

    @property
    def z0(self) -> npt.NDArray[np.floating]:
        """(K,) ohm: |Z| of the untouched skin as the forward model predicts it."""
        return self.matrices.z0

    @property
    def image_size(self) -> int:
        """Pixels along each side of the network's drop image."""
        return int(self.manifest["image"]["n"])

    @property
    def metres_per_unit(self) -> float:
        return float(self.manifest["image"]["metres_per_unit"])

    @property
    def metres_per_pixel(self) -> float:
        return self.metres_per_unit * 2.0 * float(self.manifest["image"]["half_width"]) / self.image_size

    def prereconstructor(self) -> PreReconstructor:
        return PreReconstructor(self.matrices)

    def network_path(self, variant: str = "full") -> Path | None:
        """The ONNX file of a variant, or None where this bundle ships none."""
        if variant not in NETWORKS:
            raise BundleError(f"network variant {variant!r} does not exist; choose one of {', '.join(NETWORKS)}")
        return self.path / NETWORKS[variant] if NETWORKS[variant] in self.manifest["files"] else None

    @staticmethod
    def load(name_or_path: str | os.PathLike[str]) -> Bundle:
        """Loads a shipped bundle by name or any by path, and checks each file's hash. Raises BundleError."""
        path = Path(name_or_path)
        if not (path / "manifest.json").is_file():
            path = BUNDLES / str(name_or_path)
        if not (path / "manifest.json").is_file():
            known = sorted(p.parent.name for p in BUNDLES.glob("*/manifest.json"))
            raise BundleError(
                f"no bundle {str(name_or_path)!r}: shipped are {', '.join(known) or 'none'}; "
                f"build one with `make train SKIN={Path(name_or_path).name}`"
            )
        text = (path / "manifest.json").read_bytes()
        try:
            manifest = json.loads(text)
            files = dict(manifest["files"])
        except (ValueError, KeyError, TypeError) as error:
            raise BundleError(
                f"{path / 'manifest.json'} is no bundle manifest ({error}): build the bundle again"
            ) from error
        if manifest.get("schema") != SCHEMA:
            raise BundleError(
                f"{path}: manifest schema {manifest.get('schema')}, this program reads {SCHEMA}: build the bundle again"
            )
        for name, expected in files.items():
            if not (path / name).is_file():
                raise BundleError(
                    f"{path / name} is missing, though the manifest lists it: restore it or build the bundle again"
                )
            found = sha256(path / name)
            if found != expected:
                raise BundleError(
                    f"{path / name}: sha256 {found[:12]}..., the manifest says {expected[:12]}...: "
                    "the file was changed or damaged; restore it or build the bundle again"
                )
        return Bundle(path, manifest, _read_matrices(path / "matrices.npz"), hashlib.sha256(text).hexdigest())


def write(
    path: Path, manifest: Mapping[str, Any], matrices: Matrices, networks: Mapping[str, bytes] | None = None
) -> Bundle:
    """Writes a bundle folder and loads it back. networks: variant -> ONNX bytes. `files` and `schema` are filled in
    here.

    The manifest is replaced last and at once, so a reader sees the old bundle, an error, or the new one, never a
    mixture that passes.
    """
    path.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {f.name: np.asarray(getattr(matrices, f.name)) for f in fields(Matrices)}
    np.savez_compressed(path / "matrices.npz", **arrays)
    networks = networks or {}
    for variant, name in NETWORKS.items():
        (path / name).unlink(missing_ok=True)
        if variant in networks:
            (path / name).write_bytes(networks[variant])
    names = ["matrices.npz", *(NETWORKS[v] for v in networks)]
    size = sum((path / name).stat().st_size for name in names)
    if size > MAX_BYTES:
        raise BundleError(
            f"{path}: {size / 2**20:.1f} MB, a bundle may have {MAX_BYTES // 2**20} MB: ship a smaller network"
        )
    return replace_manifest(
        path, {"schema": SCHEMA, **manifest, "files": {name: sha256(path / name) for name in names}}
    )


def replace_manifest(path: Path, full: Mapping[str, Any]) -> Bundle:
    """Another manifest for the files that are there, at once, and loads the bundle back."""
    handle, temporary = tempfile.mkstemp(dir=path, prefix=".manifest")
    with os.fdopen(handle, "w") as out:
        json.dump(full, out, indent=2)
        out.write("\n")
    os.chmod(temporary, 0o644)
    os.replace(temporary, path / "manifest.json")
    return Bundle.load(path)


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read_matrices(path: Path) -> Matrices:
    with np.load(path, allow_pickle=False) as data:
        missing = [f.name for f in fields(Matrices) if f.name not in data]
        if missing:
            raise BundleError(f"{path} lacks {', '.join(missing)}: build the bundle again")
        arrays = {f.name: data[f.name] for f in fields(Matrices)}
    arrays["scale_index"], arrays["normalisation"] = int(arrays["scale_index"]), str(arrays["normalisation"])
    arrays["model_error"] = float(arrays["model_error"])
    return Matrices(**arrays)
