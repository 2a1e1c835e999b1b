"""A bundle is read whole and unchanged, or refused with a reason a person can act on."""

import json

import numpy as np
import pytest

from models import bundle
from models.bundle import Bundle, BundleError
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
