"""A bundle is read whole and unchanged, or refused with a reason a person can act on."""

import json
import zipfile

import numpy as np
import pytest

from models import bundle
from models.bundle import Bundle, BundleError
from models.bundle_check import Wrong
from models.response_file import arrays_of_tables, tables_of
from models.shapes import Shape
from models.touch_response import ResponseTables, TouchResponse
from tests.models.test_prereconstruction import matrices

MANIFEST = {"name": "tiny", "skin": {}, "image": {"n": 96, "half_width": 1.0, "metres_per_unit": 0.05}}


@pytest.fixture
def made(tmp_path):
    return bundle.write(tmp_path / "tiny", MANIFEST, matrices(), {"full": b"network", "fast": b"fast one"})


def test_what_is_written_is_read(made):
    read, source = Bundle.load(made.path), matrices()
    assert np.array_equal(read.matrices.gram, source.gram) and read.matrices.gram.dtype == np.float64
    assert np.array_equal(read.pattern, source.pattern)
    assert read.matrices.normalisation == "model" and read.matrices.scale_index == 0
    assert read.network_path("full").read_bytes() == b"network"
    assert read.network_path("int8") is None
    assert read.metres_per_pixel == pytest.approx(0.1 / 96)


def test_hash_covers_every_file(made):
    again = bundle.write(made.path, MANIFEST, matrices(), {"full": b"another"})
    assert again.hash != made.hash
    assert again.network_path("fast") is None and not (made.path / "network_fast.onnx").exists()


def test_one_network_is_replaced_and_the_others_stay(made):
    said = {"full": {"parameters": 3}, "fast": {"parameters": 2}}
    again = bundle.replace_network(made, "fast", b"faster", said)
    found = [again.network_path(variant).read_bytes() for variant in ("fast", "full")]
    assert found == [b"faster", b"network"]
    assert again.manifest["files"]["network.onnx"] == made.manifest["files"]["network.onnx"]
    assert again.manifest["network"] == said and again.hash != made.hash


def test_a_changed_byte_is_refused(made):
    (made.path / "network.onnx").write_bytes(b"Network")
    with pytest.raises(BundleError, match=r"network.onnx: sha256 .* changed or damaged"):
        Bundle.load(made.path)


def test_a_missing_file_is_named(made):
    (made.path / "matrices.npz").unlink()
    with pytest.raises(BundleError, match=r"matrices.npz is missing"):
        Bundle.load(made.path)


@pytest.mark.parametrize(
    "text, message", [("{", "no bundle manifest"), ("{}", "no bundle manifest"), ("[]", "no bundle manifest")]
)
def test_a_broken_manifest_is_refused(made, text, message):
    (made.path / "manifest.json").write_text(text)
    with pytest.raises(BundleError, match=message):
        Bundle.load(made.path)


def test_another_schema_is_refused(made):
    manifest = json.loads((made.path / "manifest.json").read_text())
    (made.path / "manifest.json").write_text(json.dumps({**manifest, "schema": 99}))
    with pytest.raises(BundleError, match="schema 99, this program reads 1"):
        Bundle.load(made.path)


def test_an_unknown_name_lists_the_shipped():
    with pytest.raises(BundleError, match=r"no bundle 'nowhere'.*square16.*make train SKIN=nowhere"):
        Bundle.load("nowhere")


def test_too_large_a_bundle_is_refused(tmp_path):
    with pytest.raises(BundleError, match="a bundle may have 8 MB"):
        bundle.write(tmp_path / "big", MANIFEST, matrices(), {"full": bytes(9 * 2**20)})


def test_shipped_bundles_load():
    names = sorted(p.parent.name for p in bundle.BUNDLES.glob("*/manifest.json"))
    assert "square16" in names
    for name in names:
        loaded = Bundle.load(name)
        assert loaded.name == name and len(loaded.z0) == len(loaded.pattern)
        assert sum(f.stat().st_size for f in loaded.path.iterdir()) <= bundle.MAX_BYTES


def resealed(path, change):
    """A bundle made wrongly: its hashes are right, its numbers are not."""
    manifest = json.loads((path / "manifest.json").read_text())
    change(manifest)
    (path / "manifest.json").write_text(json.dumps(manifest))
    bundle.seal(path)


def test_a_changed_manifest_is_refused_though_every_file_s_hash_is_right(made):
    text = (made.path / "manifest.json").read_text()
    (made.path / "manifest.json").write_text(text.replace("0.05", "0.06"))
    with pytest.raises(BundleError, match=r"manifest.json: sha256 .* SHA256 beside it says .* changed or damaged"):
        Bundle.load(made.path)


def test_the_hash_is_the_one_that_sha256sum_finds(made):
    line = (made.path / "SHA256").read_text()
    assert line == f"{made.hash}  manifest.json\n" == f"{bundle.sha256(made.path / 'manifest.json')}  manifest.json\n"


@pytest.mark.parametrize(
    "content, says", [(None, "SHA256 is missing.*models.bundle"), (b"", "no line"), (b"0" * 64, "no line")]
)
def test_a_bundle_without_its_hash_is_refused(made, content, says):
    (made.path / "SHA256").unlink()
    if content is not None:
        (made.path / "SHA256").write_bytes(content)
    with pytest.raises(BundleError, match=says):
        Bundle.load(made.path)


CHANGES = {
    "image.metres_per_unit": lambda m: m["image"].update(metres_per_unit=-1.0),
    "image.half_width": lambda m: m["image"].update(half_width=float("inf")),
    "image.n": lambda m: m["image"].update(n=10**9),
    "image.stack": lambda m: m["image"].update(stack=[9, 24, 24]),
    "network.full.x": lambda m: m.update(network={"full": {"x": float("nan")}}),
    "normalisation": lambda m: m.update(normalisation="measured"),
    "prior.ladder": lambda m: m.update(prior={"ladder": [1.0]}),
    "one_step.lambda": lambda m: m.update(one_step={"lambda": 0}),
    "skin": lambda m: m.update(skin={"name": "x", "electrodes": 3}),
    "deeper nesting": lambda m: m.update(notes=json.loads("[" * 50 + "]" * 50)),
    "found the name": lambda m: m.update(name="../x"),
    "found '../../secret'": lambda m: m["files"].update({"../../secret": "0" * 64}),
    "sha256": lambda m: m["files"].update({"network.onnx": 3}),
    "no bundle manifest": lambda m: m.update(files=[1]),
    "files none": lambda m: m.update(files={}),
}


@pytest.mark.parametrize("says", CHANGES)
def test_a_manifest_with_numbers_that_cannot_be_is_refused(made, says):
    resealed(made.path, CHANGES[says])
    with pytest.raises(BundleError) as refused:
        Bundle.load(made.path)
    assert says in str(refused.value) and str(made.path) in str(refused.value)


WRONG = {
    "gram": np.eye(19),
    "z0": np.r_[np.zeros(1), np.ones(19)],
    "jacobian": np.full((20, 36), np.nan),
    "pattern": np.full((20, 4), 7),
    "inside": np.zeros((6, 6), bool),
    "contact": np.zeros((19, 4)),
    "back": np.zeros((36, 20), complex),
    "ladder": np.array([1e-3, 1e-1]),
    "level": np.array([0.0, 1.0]),
    "scale_index": 2,
    "normalisation": "guessed",
    "model_error": np.inf,
}


@pytest.mark.parametrize("name", WRONG)
def test_matrices_that_do_not_fit_each_other_are_refused(tmp_path, name):
    with pytest.raises(BundleError, match=f"matrices.npz: {name}: found|matrices.npz: {name}.*found"):
        bundle.write(tmp_path / "wrong", MANIFEST, matrices(**{name: WRONG[name]}))


def test_matrices_that_unpack_to_gigabytes_are_not_unpacked(made):
    import hashlib

    with zipfile.ZipFile(made.path / "matrices.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("gram.npy", "w") as member:
            for _ in range(100):
                member.write(bytes(2**20))
    digest = hashlib.sha256((made.path / "matrices.npz").read_bytes()).hexdigest()
    resealed(made.path, lambda m: m["files"].update({"matrices.npz": digest}))
    with pytest.raises(BundleError, match="unpack to 104857600, expected at most"):
        Bundle.load(made.path)


def test_the_shipped_square_has_response_tables_that_a_bundle_without_them_lacks(tmp_path):
    shipped = Bundle.load("square16")
    tables = shipped.response()
    response = TouchResponse(tables, shipped.pattern, shipped.z0)
    d = response.of(Shape("circle", 0.2, -0.1, 0.25, 0.2))
    linear = shipped.matrices.jacobian @ -np.log(1 - 0.2 * Shape("circle", 0.2, -0.1, 0.25, 1.0).fraction(24)).ravel()
    assert np.linalg.norm(d - linear) < 0.1 * np.linalg.norm(linear)  # the Jacobian is the mesh's, the tables are not
    (tmp_path / "without").mkdir()
    without = bundle.write(tmp_path / "without", shipped.manifest, shipped.matrices)
    assert not without.has_response
    with pytest.raises(BundleError, match="has no response.npz: add it with `python -m models.build"):
        without.response()
    again = bundle.add_response(without, tables)
    assert again.has_response and again.hash != without.hash
    assert TouchResponse(again.response(), shipped.pattern, shipped.z0).of(
        Shape("circle", 0.2, -0.1, 0.25, 0.2)
    ) == pytest.approx(d, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize(
    "name, value",
    [
        ("fields", np.zeros((2, 16, 3), np.float16)),
        ("modes", np.full((32, 4), np.nan, np.float16)),
        ("strength", np.zeros(5, np.float32)),
        ("inside", np.zeros((4, 4), bool)),
        ("inside", None),
    ],
)
def test_response_tables_that_cannot_be_are_refused(name, value):
    rng = np.random.default_rng(0)
    tables = ResponseTables(
        rng.normal(size=(2, 16, 2)).astype(np.float32),
        rng.normal(size=(2, 2, 16, 16)).astype(np.float32),
        np.ones((4, 4), bool),
    )
    arrays = arrays_of_tables(tables)
    tables_of(arrays, 2)
    wrong = {key: each for key, each in {**arrays, name: value}.items() if each is not None}
    with pytest.raises(Wrong, match="response.npz"):
        tables_of(wrong, 2)
