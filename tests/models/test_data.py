"""Training data: reproducible, resumable, the same from any backend; right against a solution of its own."""

import dataclasses
import json

import numpy as np
import pytest

from models import data
from models.forward import shared
from models.mismatch import soft_drop, soft_touched
from models.shapes import drop_image, from_rows
from tests import needs


def specs(split="train", chunks=2, size=3, seed=1):
    return data.specs("square16", split, chunks * size, seed, size, "inverse")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("data")
    data.generate(made, specs(), quiet=True)
    return made


def contents(folder):
    return {p.name: {k: v for k, v in np.load(p).items()} for p in sorted(folder.glob("*.npz"))}


def same(a, b):
    assert a.keys() == b.keys() and len(a) > 0
    for name in a:
        for key in a[name]:
            np.testing.assert_array_equal(a[name][key], b[name][key], err_msg=f"{name} {key}")


def test_a_run_can_be_stopped_and_taken_up(folder, tmp_path):
    data.generate(tmp_path, specs()[:1], quiet=True)
    kept = (tmp_path / specs()[0].file).stat().st_mtime_ns
    assert data.generate(tmp_path, specs(), quiet=True) == 3  # only the missing chunk
    assert (tmp_path / specs()[0].file).stat().st_mtime_ns == kept
    same(contents(tmp_path), contents(folder))
    assert not list(tmp_path.glob(".*.part"))


@pytest.mark.release
def test_a_local_dask_cluster_gives_the_same_files(folder, tmp_path):
    needs.PEERS.here()
    import distributed

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        data.generate(tmp_path, specs(), jobs=2, backend="dask", scheduler=cluster.scheduler_address, quiet=True)
        worked = [w for w, count in cluster.scheduler.workers.items() if count.metrics]
        assert len(worked) == 2
    same(contents(tmp_path), contents(folder))


def test_another_seed_is_refused_in_the_same_folder(folder):
    with pytest.raises(ValueError, match="another folder"):
        data.generate(folder, specs(seed=2), quiet=True)


def test_differences_are_those_of_the_stored_shapes(folder):
    """A nominal chunk, solved again from its rows; the picture is the rows' too."""
    for name, chunk in contents(folder).items():
        if chunk["shift"].any():
            continue
        model = shared("square16", "inverse")
        z0 = model.solve(1.0).impedances()
        for k in range(len(chunk["shapes"])):
            scene = from_rows(chunk["shapes"][k].astype(float))
            blur = float(chunk["blur"][k])
            z = model.solve(soft_touched(model, scene, blur) if blur else model.touched(scene)).impedances()
            np.testing.assert_allclose(chunk["difference"][k], z / z0 - 1, rtol=1e-4, atol=1e-7, err_msg=name)
            image = soft_drop(scene, blur, data.IMAGE) if blur else drop_image(scene, data.IMAGE)
            np.testing.assert_allclose(chunk["image"][k], image, atol=5e-4)
        return
    pytest.fail("no nominal chunk among those made: choose another seed for this test")


def test_variants_are_within_their_spread_and_have_their_own_baseline():
    """Four chunks of one scene: some nominal, the others each on a skin of its own."""
    chunks = [data.make_chunk(dataclasses.replace(s, size=1)) for s in specs(chunks=4)]
    moved = [c for c in chunks if c["shift"].any()]
    assert 0 < len(moved) < len(chunks)
    for c in moved:
        assert np.abs(c["contact_impedance"] / 0.01 - 1).max() <= data.CONTACT_SPREAD
        assert abs(c["background"] - 1) <= data.BACKGROUND_SPREAD
        assert np.abs(c["shift"]).max() <= 2 * data.SHIFT_SPREAD * 8 / 16 + 1e-12
    z0 = np.array([c["z0"] for c in moved])
    assert (np.ptp(z0, axis=0) > 0).all()
    for c in chunks:  # a touch only ever raises what a pair of electrodes sees of itself
        assert (c["difference"] > -1e-6).all() and c["difference"].max() > 1e-4


def test_loading_joins_chunks(folder):
    everything = data.load(folder)
    assert len(everything) == 6 and everything.z0.shape == (2, 120)
    np.testing.assert_array_equal(everything.variant, [0] * 3 + [1] * 3)
    assert len(data.load(folder, limit=5)) == 5
    np.testing.assert_array_equal(data.load(folder, skip=1).difference, everything.difference[3:])
    assert json.loads((folder / "data.json").read_text())["seed"] == 1
    with pytest.raises(FileNotFoundError, match="python -m models.data"):
        data.load(folder, "valid")


def test_splits_do_not_share_scenes():
    rows = [data.make_chunk(specs(split, 1, 2)[0])["shapes"] for split in ("train", "valid")]
    assert not np.allclose(rows[0][:, 0, 1:3], rows[1][:, 0, 1:3])


def test_scenes_of_a_skin_that_has_changed_since_are_refused(tmp_path):
    skin = tmp_path / "mine.toml"

    def make(width):
        skin.write_text(
            'name = "mine"\nunit = "mm"\nradius = 30\ncontact_impedance = 0.01\n'
            f"[electrodes]\nwidth = {width}\ncount = 8\n"
        )
        data.generate(tmp_path / "work", data.specs(str(skin), "train", 1, 1, 1, "inverse"), quiet=True)

    make(5)
    make(5)
    with pytest.raises(ValueError, match="as it was before its outline, electrodes or pattern changed: remove that"):
        make(6)
