"""Bundles and npz files: read whole and unchanged, or refused early with a reason a person can act on."""

import json
import struct
import zipfile

import numpy as np
import pytest

from models import bundle
from models.bundle import Bundle, BundleError
from models.bundle_check import Wrong
from models.files import FileError
from models.npz import read_npz
from models.response_file import arrays_of_tables, tables_of
from models.skin_limits import BUNDLE_BYTES
from tests.models.test_prereconstruction import matrices

MANIFEST = {"name": "tiny", "skin": {}, "image": {"n": 96, "half_width": 1.0, "metres_per_unit": 0.05}}


@pytest.fixture
def made(tmp_path):
    return bundle.write(tmp_path / "tiny", MANIFEST, matrices(), {"full": b"network", "fast": b"fast one"})


def resealed(path, change):
    """A bundle made wrongly: its hashes are right, its numbers are not."""
    change(manifest := json.loads((path / "manifest.json").read_text()))
    (path / "manifest.json").write_text(json.dumps(manifest))
    bundle.seal(path)


def test_what_is_written_is_read(made):
    read, source = Bundle.load(made.path), matrices()
    assert np.array_equal(read.matrices.gram, source.gram) and np.array_equal(read.pattern, source.pattern)
    assert read.network_path("full").read_bytes() == b"network" and read.network_path("int8") is None
    assert read.metres_per_pixel == pytest.approx(0.1 / 96)
    line = (made.path / "SHA256").read_text()  # as sha256sum finds it
    assert line == f"{made.hash}  manifest.json\n" == f"{bundle.sha256(made.path / 'manifest.json')}  manifest.json\n"


def test_one_network_is_replaced_while_the_others_stay(made):
    again = bundle.replace_network(made, "fast", b"faster", {"fast": {"parameters": 2}})
    assert [again.network_path(variant).read_bytes() for variant in ("fast", "full")] == [b"faster", b"network"]
    assert again.manifest["network"] == {"fast": {"parameters": 2}} and again.hash != made.hash


@pytest.mark.parametrize(("name", "content", "message"), [
    ("network.onnx", b"Network", r"network.onnx: sha256 .* changed or damaged"),
    ("manifest.json", (b"0.05", b"0.06"), r"manifest.json: sha256 .* SHA256 beside it says .* changed or damaged"),
    ("manifest.json", (b'"schema": 1', b'"schema": 99'), "schema 99, this program reads 1"),
    ("matrices.npz", None, r"matrices.npz is missing"),
    ("SHA256", None, "SHA256 is missing.*models.bundle"),
    ("SHA256", b"0" * 64, "no line"),
    ("manifest.json", b"[]", "no bundle manifest"),
])  # fmt: skip
def test_a_bundle_that_was_changed_is_refused(made, name, content, message):
    path = made.path / name
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content if isinstance(content, bytes) else path.read_bytes().replace(*content))
    with pytest.raises(BundleError, match=message):
        Bundle.load(made.path)


WRONG_MANIFEST = {
    "image.metres_per_unit": lambda m: m["image"].update(metres_per_unit=-1.0),
    "image.half_width": lambda m: m["image"].update(half_width=float("inf")),
    "image.n": lambda m: m["image"].update(n=10**9),
    "normalisation": lambda m: m.update(normalisation="measured"),
    "skin": lambda m: m.update(skin={"name": "x", "electrodes": 3}),
    "found '../../secret'": lambda m: m["files"].update({"../../secret": "0" * 64}),
}
WRONG_MATRICES = [
    *(("gram", np.eye(19)), ("z0", np.r_[np.zeros(1), np.ones(19)]), ("jacobian", np.full((20, 36), np.nan))),
    *(("pattern", np.full((20, 4), 7)), ("ladder", np.array([1e-3, 1e-1])), ("scale_index", 2)),
    ("model_error", np.inf),
]


@pytest.mark.parametrize(("says", "change"), WRONG_MANIFEST.items())
def test_a_manifest_with_numbers_that_cannot_be_is_refused(made, says, change):
    resealed(made.path, change)
    with pytest.raises(BundleError, match=says):
        Bundle.load(made.path)


@pytest.mark.parametrize(("name", "value"), WRONG_MATRICES)
def test_matrices_that_do_not_fit_each_other_are_refused(tmp_path, name, value):
    with pytest.raises(BundleError, match=f"matrices.npz: {name}.*found"):
        bundle.write(tmp_path / "wrong", MANIFEST, matrices(**{name: value}))


def test_what_is_too_large_is_refused(tmp_path):
    with pytest.raises(BundleError, match="a bundle may have 8 MB"):
        bundle.write(tmp_path / "big", MANIFEST, matrices(), {"full": bytes(9 * 2**20)})


def test_shipped_bundles_load_and_another_name_lists_them():
    for name in ("square16", "disc16"):
        loaded = Bundle.load(name)
        assert loaded.name == name and len(loaded.z0) == len(loaded.pattern)
        assert sum(f.stat().st_size for f in loaded.path.iterdir()) <= BUNDLE_BYTES
    with pytest.raises(BundleError, match=r"no bundle 'nowhere'.*square16.*make train SKIN=nowhere"):
        Bundle.load("nowhere")


def test_the_shipped_square_has_response_tables_that_a_bundle_without_them_lacks(tmp_path):
    """Those of an earlier version, which had more."""
    shipped = Bundle.load("square16")
    tables = shipped.response()
    assert {"modes", "strength"} < set(read_npz(shipped.path / "response.npz")) and tables.inside.shape == (24, 24)
    without = bundle.write(tmp_path / "without", shipped.manifest, shipped.matrices)
    with pytest.raises(BundleError, match="has no response.npz: add it with `python -m models.build"):
        without.response()
    again = bundle.add_response(without, tables)
    assert again.has_response > without.has_response and again.hash != without.hash
    assert np.array_equal(again.response().fields, tables.fields)
    arrays = arrays_of_tables(tables)
    for name, wrong in (("fields", np.zeros((2, 16, 3))), ("fields", tables.fields * np.inf), ("inside", np.eye(4))):
        with pytest.raises(Wrong, match="response.npz"):
            tables_of(arrays | {name: wrong}, 16)


def npy(shape, dtype, data):
    """A member whose header says what we like."""
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as made:
        for name, content in members.items():
            made.writestr(name, content)
    return path


def test_arrays_are_read_as_numpy_reads_them(tmp_path):
    values = np.random.default_rng(0).standard_normal((7, 3))
    arrays = {"fortran": np.asfortranarray(values), "complex": (values + 1j).astype("c8"), "one": np.array(3)}
    arrays |= {"big_endian": np.arange(5, dtype=">i4"), "none": np.zeros((0, 120)), "text": np.array("model")}
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz")
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            assert np.array_equal(found[name], array) and found[name].dtype == array.dtype


DENSE, MANY = npy((5 * 2**20,), "<f8", bytes(5 * 2**23)), {f"{k}.npy": b"" for k in range(300)}
WRONG = {
    "is object": {"a.npy": npy((1,), "|O", b"x")},
    "has 8 bytes, expected 8796093022208": {"a.npy": npy((2**40,), "<f8", bytes(8))},
    "no npz of plain arrays": {"a.npy": b"hello"},
    "is a zip of 'xl/a.xml'": {"xl/a.xml": b"<x/>"},
    "found 300 arrays": MANY,
    "unpack to .* no measurements pack so well": {"a.npy": DENSE},
}


def test_what_is_no_plain_array_is_refused(tmp_path):
    for says, members in WRONG.items():
        with pytest.raises(FileError, match=says):
            read_npz(archive(tmp_path / "a.npz", members))
    with pytest.raises(FileError, match="expected deflate"):
        read_npz(archive(tmp_path / "a.npz", {"a.npy": npy((2**17,), "<f8", bytes(2**20))}, zipfile.ZIP_LZMA))
    np.save(tmp_path / "a.npy", np.ones(3))
    with pytest.raises(FileError, match="one bare array, expected named ones"):
        read_npz(tmp_path / "a.npy")
    path = archive(tmp_path / "a.npz", {"a.npy": npy((2**22,), "<f8", bytes(2**25))})
    content, real = path.read_bytes(), struct.pack("<I", 2**25 + 128)
    assert content.count(real) == 2
    path.write_bytes(content.replace(real, struct.pack("<I", 136)))  # its directory lies: 32 MB are packed there
    with pytest.raises(FileError):
        read_npz(path)
