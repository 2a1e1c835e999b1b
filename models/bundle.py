"""A bundle: the folder a skin runs from, one hash over all of it (numpy only).

    models/bundles/square16/SHA256             the bundle's hash: of manifest.json; `sha256sum -c SHA256` reads it
                            manifest.json      geometry, pattern, image grid, provenance, measured figures, hashes
                            matrices.npz       see prereconstruction.Matrices
                            network.onnx       "full"
                            network_fast.onnx  "fast"
                            network_int8.onnx  "int8"
                            locator.npz        of a registered skin: see locator.LocatorArrays
                            response.npz       its fields while nothing touches: see response_file.py

The manifest holds the hash of every other file, so the manifest's own hash covers the whole. Networks may be missing. A
bundle without any is a working bundle: the services then show the one-step image.

    python -m models.bundle FOLDER             writes SHA256 anew, after a change of the manifest by hand
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from models.bundle_check import Wrong, check
from models.files import FileError, read_bytes
from models.locator_arrays import LocatorArrays, arrays_of
from models.npz import read_npz
from models.onnx_external import external_data
from models.prereconstruction import Matrices, PreReconstructor
from models.response_file import ResponseTables, arrays_of_tables, tables_of
from models.skin_limits import BUNDLE_BYTES, NAME, NETWORKS_BYTES
from protocol.errors import EitskinError
from protocol.whole_file import whole_file, write_whole

SCHEMA = 1
BUNDLES = Path(__file__).parent / "bundles"
MAX_MANIFEST = 1024 * 1024
MAX_MATRICES = 64 * 1024 * 1024  # unpacked
SEAL = "SHA256"
LOCATOR, RESPONSE = "locator.npz", "response.npz"
NETWORKS = {"full": "network.onnx", "fast": "network_fast.onnx", "int8": "network_int8.onnx"}
CLASSES = ("circle", "triangle", "rectangle", "square", "L")


class BundleError(EitskinError):
    """The bundle cannot be used; says what was found, what was expected and what to do."""


@dataclass(frozen=True)
class Bundle:
    """A bundle whose hashes were found right. Two are equal where their hashes are."""

    path: Path = field(compare=False)
    manifest: dict[str, Any] = field(compare=False)
    matrices: Matrices = field(compare=False)
    hash: str  # of the whole: sha256 of manifest.json, which holds the hashes of everything else; as SHA256 says
    # of a registered skin: what finds touches by the measured response map
    locator: LocatorArrays | None = field(default=None, compare=False)
    # of a calibrated one: its response tables' as it is mounted
    mounted_fields: npt.NDArray[np.float32] | None = field(default=None, compare=False)

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
    def half_width(self) -> float:
        """Model units: half the side of every image, about the origin."""
        return float(self.manifest["image"]["half_width"])

    @property
    def metres_per_pixel(self) -> float:
        return self.metres_per_unit * 2.0 * self.half_width / self.image_size

    @property
    def image_origin(self) -> tuple[float, float]:
        """(x, y) [m] of the corner of an image's first pixel."""
        corner = -self.metres_per_unit * self.half_width
        return corner, corner

    def prereconstructor(self) -> PreReconstructor:
        return PreReconstructor(self.matrices)

    def network_path(self, variant: str = "full") -> Path | None:
        """The ONNX file of a variant, or None where this bundle ships none."""
        if variant not in NETWORKS:
            raise BundleError(f"network variant {variant!r} does not exist; choose one of {', '.join(NETWORKS)}")
        return self.path / NETWORKS[variant] if NETWORKS[variant] in self.manifest["files"] else None

    @property
    def has_response(self) -> bool:
        """Whether it ships its fields, finer than its Jacobian."""
        return RESPONSE in self.manifest["files"]

    def response(self) -> ResponseTables:
        """Read when asked for: who only reconstructs does without. Raises BundleError, also where there are none."""
        if not self.has_response:
            raise BundleError(
                f"{self.path} has no {RESPONSE}: add it with `python -m models.build --skin {self.name} --response`"
            )
        try:
            return tables_of(read_npz(self.path / RESPONSE, MAX_MATRICES), self.matrices.contact.shape[1])
        except (FileError, Wrong) as why:
            raise BundleError(f"{self.path}: {why}: build the bundle again") from None

    @staticmethod
    def load(name_or_path: str | os.PathLike[str]) -> Bundle:
        """Loads a shipped bundle by name, else one by path, and checks each file's hash. Raises BundleError.

        A name is a shipped bundle's first, whatever lies in the working folder.
        """
        given = Path(name_or_path)
        path = BUNDLES / given.name if len(given.parts) == 1 else given
        if not (path / "manifest.json").is_file():
            path = given
        if not (path / "manifest.json").is_file():
            known = sorted(p.parent.name for p in BUNDLES.glob("*/manifest.json"))
            raise BundleError(
                f"no bundle {str(name_or_path)!r}: shipped are {', '.join(known) or 'none'}; "
                f"build one with `make train SKIN={Path(name_or_path).name}`"
            )
        text = _read(path / "manifest.json", MAX_MANIFEST)
        digest = hashlib.sha256(text).hexdigest()
        manifest = _manifest(path, text)
        sealed = _sealed(path)
        if sealed != digest:
            raise BundleError(
                f"{path / 'manifest.json'}: sha256 {digest[:12]}..., {SEAL} beside it says {sealed[:12]}...: "
                "the manifest was changed or damaged; restore it or build the bundle again"
            )
        for name, expected in manifest["files"].items():
            if not (path / name).exists():
                raise BundleError(
                    f"{path / name} is missing, though the manifest lists it: restore it or build the bundle again"
                )
            content = _read(path / name, BUNDLE_BYTES)
            found = hashlib.sha256(content).hexdigest()
            if found != expected:
                raise BundleError(
                    f"{path / name}: sha256 {found[:12]}..., the manifest says {expected[:12]}...: "
                    "the file was changed or damaged; restore it or build the bundle again"
                )
            if name in NETWORKS.values():
                with contextlib.suppress(ValueError):  # whoever runs it says that it is none
                    _whole(path / name, content)
        matrices = _read_matrices(path / "matrices.npz")
        try:
            check(manifest, matrices)
        except Wrong as why:
            raise BundleError(f"{path}: {why}: build the bundle again") from None
        locator = _read_locator(path / LOCATOR, len(matrices.pattern)) if LOCATOR in manifest["files"] else None
        return Bundle(path, manifest, matrices, digest, locator)


def write(
    path: Path,
    manifest: Mapping[str, Any],
    matrices: Matrices,
    networks: Mapping[str, bytes] | None = None,
    locator: LocatorArrays | None = None,
    response: ResponseTables | None = None,
) -> Bundle:
    """Writes a bundle folder and loads it back. networks: variant -> ONNX bytes. `files` and `schema` are filled in
    here.

    The manifest and then its hash are replaced last, each at once, so a reader sees the old bundle, an error, or the
    new one, never a mixture that passes.
    """
    path.mkdir(parents=True, exist_ok=True)
    networks = networks or {}
    arrays: dict[str, Mapping[str, Any]] = {"matrices.npz": _fields(matrices)}
    if locator is not None:
        arrays[LOCATOR] = _fields(locator)
    if response is not None:
        arrays[RESPONSE] = arrays_of_tables(response)
    with contextlib.ExitStack() as places:  # all files take their place together, or none does
        parts = {}
        for name in (*arrays, *(NETWORKS[variant] for variant in networks)):
            parts[name] = places.enter_context(whole_file(path / name))
        for name, held in arrays.items():
            np.savez_compressed(parts[name], **held)
        for variant, content in networks.items():
            parts[NETWORKS[variant]].write_bytes(content)
        size = sum(part.stat().st_size for part in parts.values())
        _check_size(path, size)
    for name in {*NETWORKS.values(), LOCATOR, RESPONSE} - parts.keys():
        (path / name).unlink(missing_ok=True)
    return replace_manifest(
        path, {"schema": SCHEMA, **manifest, "files": {name: sha256(path / name) for name in parts}}
    )


def _fields(of: Matrices | LocatorArrays) -> dict[str, Any]:
    return {f.name: np.asarray(getattr(of, f.name)) for f in fields(of)}


def check_room(path: Path, matrices: Matrices, response: ResponseTables | None = None, more: int = 0) -> None:
    """Before a training: whether the bundle will have room for what it makes. Raises BundleError.

    more: bytes of other files.
    """
    packed = io.BytesIO()
    np.savez_compressed(packed, **_fields(matrices))
    if response is not None:
        np.savez_compressed(packed, **arrays_of_tables(response))
    _check_size(path, packed.getbuffer().nbytes + NETWORKS_BYTES + more)


def _check_size(path: Path, size: int) -> None:
    if size > BUNDLE_BYTES:
        raise BundleError(
            f"{path}: {size / 2**20:.1f} MB, a bundle may have {BUNDLE_BYTES // 2**20} MB: take a pattern with fewer "
            "measurements, or a smaller network"
        )


def add_response(bundle: Bundle, response: ResponseTables) -> Bundle:
    """The bundle there is, with these tables."""
    with whole_file(bundle.path / RESPONSE) as part:
        np.savez_compressed(part, **arrays_of_tables(response))
    files = {**bundle.manifest["files"], RESPONSE: sha256(bundle.path / RESPONSE)}
    added = replace_manifest(bundle.path, {**bundle.manifest, "files": files})
    added.response()
    return added


def replace_network(bundle: Bundle, variant: str, content: bytes, said: Mapping[str, Any]) -> Bundle:
    """The bundle there is with another network of this variant. said: the manifest's `network`, of all variants."""
    name = NETWORKS[variant]
    write_whole(bundle.path / name, content)
    files = {**bundle.manifest["files"], name: sha256(bundle.path / name)}
    return replace_manifest(bundle.path, {**bundle.manifest, "network": said, "files": files})


def replace_manifest(path: Path, full: Mapping[str, Any]) -> Bundle:
    """Another manifest for the files that are there, at once, and loads the bundle back."""
    write_whole(path / "manifest.json", json.dumps(full, indent=2, allow_nan=False) + "\n", 0o644)
    seal(path)
    return Bundle.load(path)


def seal(path: Path) -> str:
    """Writes the bundle's hash beside its manifest, and returns it."""
    found = sha256(path / "manifest.json")
    write_whole(path / SEAL, f"{found}  manifest.json\n", 0o644)
    return found


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read(path: Path, most: int) -> bytes:
    try:
        return read_bytes(path, most)
    except FileError as why:
        raise BundleError(f"{why}: restore it or build the bundle again") from None


def read_network(path: Path) -> bytes:
    """The content of an ONNX file that holds all of its weights. Raises BundleError."""
    content = _read(path, BUNDLE_BYTES)
    try:
        _whole(path, content)
    except ValueError as why:
        raise BundleError(f"{path} is no network that can be run ({why}): build the bundle again") from None
    return content


def _whole(path: Path, content: bytes) -> None:
    """Raises BundleError for a network whose weights are elsewhere, ValueError for what is no network."""
    elsewhere = external_data(content)
    if elsewhere:
        raise BundleError(
            f"{path} keeps weights in another file ({elsewhere}), which no hash covers; expected all of them inside: "
            "export it as one file and build the bundle again"
        )


def _manifest(path: Path, text: bytes) -> dict[str, Any]:
    """What the manifest says, as far as the files need it: its schema, and names and hashes of files we know."""
    place = path / "manifest.json"
    try:
        manifest = json.loads(text)
        files = dict(manifest["files"])
        schema, name = manifest.get("schema"), manifest["name"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BundleError(f"{place} is no bundle manifest ({str(error)[:80]}): build the bundle again") from None
    if schema != SCHEMA:
        raise BundleError(f"{path}: manifest schema {schema}, this program reads {SCHEMA}: build the bundle again")
    known = ("matrices.npz", LOCATOR, RESPONSE, *NETWORKS.values())
    for file, digest in files.items():
        if file not in known or not (isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)):
            raise BundleError(
                f"{place}: files: found {file!r:.80}, expected names of {', '.join(known)} and their sha256"
            )
    if "matrices.npz" not in files or not (isinstance(name, str) and re.fullmatch(NAME, name)):
        raise BundleError(
            f"{place}: found the name {name!r:.80} and files {', '.join(files) or 'none'}; "
            "expected a name of letters, digits, - . _ and at least matrices.npz: build the bundle again"
        )
    return {**manifest, "files": files}


def _sealed(path: Path) -> str:
    """The hash that was written when the bundle was made."""
    if not (path / SEAL).exists():
        raise BundleError(
            f"{path / SEAL} is missing, the hash of the whole bundle: restore it, build the bundle again, or, where "
            f"you know that its manifest is right, run `python -m models.bundle {path}`"
        )
    found = re.fullmatch(rb"([0-9a-f]{64})  manifest\.json\n?", _read(path / SEAL, 1024))
    if found is None:
        raise BundleError(f"{path / SEAL}: found no line `<sha256>  manifest.json`: build the bundle again")
    return found[1].decode()


def _read_matrices(path: Path) -> Matrices:
    try:
        data = read_npz(path, MAX_MATRICES)
    except FileError as why:
        raise BundleError(f"{why}: build the bundle again") from None
    missing = [f.name for f in fields(Matrices) if f.name not in data]
    if missing:
        raise BundleError(f"{path} lacks {', '.join(missing)}: build the bundle again")
    try:
        return matrices_of({f.name: data[f.name] for f in fields(Matrices)})
    except (TypeError, ValueError) as why:
        raise BundleError(f"{path}: {why}: build the bundle again") from None


def matrices_of(arrays: Mapping[str, Any]) -> Matrices:
    """Matrices of what an npz file holds by their names. Raises TypeError or ValueError."""
    scalars = {"scale_index": int(arrays["scale_index"]), "normalisation": str(arrays["normalisation"])}
    return Matrices(**{**arrays, **scalars, "model_error": float(arrays["model_error"])})


def _read_locator(path: Path, measurements: int) -> LocatorArrays:
    try:
        return arrays_of(read_npz(path, MAX_MATRICES), measurements)
    except (FileError, ValueError, TypeError) as why:
        raise BundleError(f"{path}: {why}: register the skin again") from None


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        print(f"{seal(Path(folder))}  {folder}")
        Bundle.load(folder)
