"""Training data: reproducible, resumable, the same from any backend; right against a solution of its own."""

import numpy as np
import pytest

from models import data
from models.condensed import CondensedSheet
from models.forward import shared
from models.mismatch import anisotropy_root, soft_drop, soft_touched, turned
from models.shapes import Shape, drop_image, from_rows


def specs(split="train", chunks=2, size=3, seed=1):
    return data.specs("square16", split, chunks * size, seed, size, "inverse")


def test_a_run_is_taken_up_where_it_stopped_and_another_seed_is_refused(tmp_path_factory):
    folder, tmp_path = (tmp_path_factory.mktemp("data") for _ in range(2))
    data.generate(folder, specs(), quiet=True)
    data.generate(tmp_path, specs()[:1], quiet=True)
    kept = (tmp_path / specs()[0].file).stat().st_mtime_ns
    assert data.generate(tmp_path, specs(), quiet=True) == 3  # only the missing chunk
    assert (tmp_path / specs()[0].file).stat().st_mtime_ns == kept and not list(tmp_path.glob(".*.part"))
    for spec in specs():
        mine, theirs = np.load(tmp_path / spec.file), np.load(folder / spec.file)
        for key in theirs.files:
            np.testing.assert_array_equal(mine[key], theirs[key])
    everything = data.load(folder)
    assert len(everything) == 6 and len(data.load(folder, limit=5)) == 5
    np.testing.assert_array_equal(data.load(folder, skip=1).difference, everything.difference[3:])
    with pytest.raises(ValueError, match="another folder"):
        data.generate(folder, specs(seed=2), quiet=True)
    rows = [data.make_chunk(specs(split, 1, 1)[0])["shapes"] for split in ("train", "valid")]
    assert not np.allclose(rows[0][:, 0, 1:3], rows[1][:, 0, 1:3])  # splits do not share scenes


def test_differences_are_those_of_the_stored_shapes(monkeypatch):
    """A nominal chunk, solved again from its rows; the picture is the rows' too, and edges are soft as it says."""
    monkeypatch.setattr(data, "SOFT_SHARE", 0.5)
    chunk = data.make_chunk(data.ChunkSpec("square16", "test", 0, 6, 1, "inverse"))
    model, each = shared("square16", "inverse"), (chunk[k] for k in ("shapes", "blur", "difference", "image"))
    z0 = model.solve(1.0).impedances()
    assert not chunk["shift"].any() and 0 < np.count_nonzero(chunk["blur"]) < 6
    for rows, blur, difference, image in zip(*each, strict=True):
        scene, soft = from_rows(rows.astype(float)), float(blur)
        z = model.solve(soft_touched(model, scene, soft) if soft else model.touched(scene)).impedances()
        np.testing.assert_allclose(difference, z / z0 - 1, rtol=1e-4, atol=1e-7)
        wanted = soft_drop(scene, soft, data.IMAGE) if soft else drop_image(scene, data.IMAGE)
        np.testing.assert_allclose(image, wanted, atol=5e-4)


@pytest.mark.parametrize("blur", [0.0, 0.06])
def test_the_sheets_inverse_gives_what_a_solution_gives(blur):
    """On a coarse sheet that is anisotropic and uneven, with contact impedances of its own."""
    model, contact = shared("square16", "inverse"), 0.01 * np.linspace(0.7, 1.3, 16)
    field, root = 1 + 0.05 * model.centroids[:, :1], anisotropy_root(0.1, 0.4)
    untouched = turned(model.touched([]) * field, root)
    sheet, z0 = CondensedSheet(model, untouched, contact), model.solve(untouched, contact).impedances()
    np.testing.assert_allclose(sheet.impedances(untouched), z0, rtol=1e-5)
    scene = [Shape("hertz", 0, 0, 0.2, 0.3), Shape("L", 0.6, -0.5, 0.3, 0.6, 1.0)]
    conductivity = turned((soft_touched(model, scene, blur) if blur else model.touched(scene)) * field, root)
    d = model.solve(conductivity, contact).impedances() / z0 - 1
    np.testing.assert_allclose(sheet.impedances(conductivity) / z0 - 1, d, atol=1e-3 * np.abs(d).max())
