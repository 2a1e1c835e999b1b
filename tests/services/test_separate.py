"""Files of separate scans: what touches is found live as it is offline, whatever the order of the rows."""

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import RawFrame
from services.calibration.presses import part
from services.calibration.register_command import register_presses
from services.estimation.initialisation.baseline import alike, noise_of_references
from services.pipeline import Pipeline
from services.recordings import file_source
from services.recordings.file_source import FileSource, RecordingSource, file_frame
from services.recordings.importing import import_arrays
from services.recordings.npz_file import Input, frames_of, load_npz, read_scans
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin
from tests.services.conftest import Board
from tests.services.stub_skin import lasting


@pytest.fixture(scope="module")
def presses(reference):
    return load_npz(reference / "hydrogel_disc16.npz")


@pytest.fixture(scope="module")
def registered(presses, tmp_path_factory):
    """The hydrogel skin, registered on the first 100 presses."""
    folder = tmp_path_factory.mktemp("skins") / "mine"
    register_presses(presses, "disc16", 100, folder)
    return Bundle.load(folder)


def skin_of(bundle, port="stub"):
    return Skin(port=port, bundle=str(bundle.path), frame_id="skin")


def live(data, bundle, twin=None):
    """What the stages make of the file's frames. twin: goes on from the state in the middle."""
    pipeline = Pipeline(skin_of(bundle), bundle=bundle)
    for scan, (values, kind) in enumerate(frames_of(data), start=1):
        frame = file_frame("skin", "opposite", scan, values, kind, scan * 45_000_000, data.separate)
        if twin is not None and scan == 15:
            twin.pre.load(pipeline.pre.state())
        made = pipeline.run(frame)
        if twin is not None and scan >= 15:
            other = twin.run(frame).delta
            assert np.array_equal(made.delta.difference, other.difference) and made.delta.touched == other.touched
            assert np.array_equal(made.delta.sigma, other.sigma)
        yield frame, made.contact


def present(frame):
    return [c.position[:2] for c in lasting(frame)]


def test_real_presses_are_found_live_as_offline(presses, registered):
    """40 of the presses that took no part in registration. (bench.real_presses has all 400.)"""
    data = read_scans(part(presses, slice(100, 140)), registered)
    offline = reconstruct(data, skin_of(registered), registered)
    seen = list(live(data, registered))
    assert not any(present(contact) for raw, contact in seen if raw.kind == "reference")
    agree = 0
    for row, contact in enumerate(contact for raw, contact in seen if raw.kind == "full"):
        assert contact.valid and "changing" not in contact.reasons and "separate" in contact.reasons
        places = present(contact)
        agree += len(places) == 1 and bool(np.hypot(*(places[0] - offline["position"][row, 0])) < 5e-4)
    assert agree >= 39


@pytest.mark.release
def test_the_order_of_the_rows_does_not_matter(presses, registered):
    """What is found in a shuffled file is what is found in the file as it was recorded, over hours of drift."""
    order, skin = np.random.default_rng(1).permutation(400) + 100, skin_of(registered)
    shuffled = {name: a if name == "pattern" else a[order] for name, a in presses.items()}
    mixed = reconstruct(read_scans(part(shuffled, slice(0, 60)), registered), skin, registered)
    data, rows = read_scans(presses, registered), order[:60]
    plain = reconstruct(Input(data.measurements[rows], None, data.reference[rows]), skin, registered)  # type: ignore[index]
    assert mixed["touched"].all() and plain["touched"].all()
    assert np.linalg.norm(mixed["position"][:, 0] - plain["position"][:, 0], axis=1).max() < 5e-4
    untouched = presses["untouched"].astype(float)
    order = np.random.default_rng(2).permutation(500)
    assert np.array_equal(noise_of_references(untouched), noise_of_references(untouched[order]))
    assert set(alike(untouched, 64)) == set(order[alike(untouched[order], 64)])
    # Neighbours in time differ by 0.2 %, others by 4 %: it is the former.
    assert 1e-3 < np.median(noise_of_references(untouched[order][:64])) < 5e-3


# on the simulated skin


@pytest.fixture(scope="module")
def touches():
    """Twenty presses of the bundle's own physics, each at a place of its own; gain drifts by a third between them."""
    board, rng = Board(Bundle.load("square16")), np.random.default_rng(5)
    m, places = board.m, rng.uniform(-0.5, 0.5, (20, 2))
    gain = np.exp(np.cumsum(0.02 * rng.standard_normal((20, 1)), axis=0))
    rows = m.z0 * (1 + np.array([board.disc(x, y, 0.25, 0.3) for x, y in places]))
    noise = 1 + 3e-4 * rng.standard_normal((2, 20, 120))
    return {"untouched": gain * m.z0 * noise[0], "touched": gain * rows * noise[1]}


def test_each_touch_begins_and_ends(touches):
    """Under an id of its own, though the next press may be at the same place. A state in the middle is gone on from."""
    bundle = Bundle.load("square16")
    ids, twin = [], Pipeline(skin_of(bundle), bundle=bundle)
    for raw, contact in live(read_scans(touches, bundle), bundle, twin):
        states = [c.state for c in contact.contacts]
        if raw.kind == "full":
            assert contact.valid and states == ["begin"], raw.scan
            ids += [c.id for c in contact.contacts]
        elif ids:
            assert states == ["end"] and contact.contacts[0].id == ids[-1]
    assert len(set(ids)) == 20


def test_a_scan_whose_reference_was_lost_is_not_valid(touches):
    bundle = Bundle.load("square16")
    pipeline = Pipeline(skin_of(bundle), bundle=bundle)
    data = read_scans(touches, bundle)
    for scan, (values, kind) in enumerate(frames_of(data), start=1):
        if scan == 31:
            assert kind == "reference"
            continue
        frame = file_frame("skin", "pairs", scan, values, kind, scan * 10**8, data.separate)
        contact = pipeline.run(frame).contact
        if kind == "full":
            assert contact.valid == (scan != 32), scan
            assert contact.valid or ("stale_baseline" in contact.reasons and not present(contact))
    assert pipeline.pre.health().messages == []


def test_ports_and_recordings_give_the_same_frames(touches, tmp_path, monkeypatch):
    """`port = "FILE.npz"` of presses in an order of its own, and `port = "FILE.mcap"` of what `skin import` made."""
    monkeypatch.setattr(file_source, "FILE_RATE_HZ", 1e4)
    bundle = Bundle.load("square16")
    order = np.random.default_rng(6).permutation(120)
    arrays = {name: a[:, order] for name, a in touches.items()} | {"pattern": np.asarray(bundle.pattern)[order]}
    path, recording = tmp_path / "presses.npz", tmp_path / "presses.mcap"
    np.savez(path, **arrays)
    import_arrays(arrays, path, recording, "square16", 1e4)
    expected = [(raw.z.tobytes(), raw.kind) for raw, _ in live(read_scans(touches, bundle), bundle)]
    for kind, port in ((FileSource, path), (RecordingSource, recording)):
        source = kind("skin", skin_of(bundle, str(port)), bundle)
        frames: list[RawFrame] = []
        for frame in source.frames():
            if source.problem:
                break
            frames += [frame] if frame is not None else []
        assert [(f.z.tobytes(), f.kind) for f in frames] == expected, source.problem
        assert all({"replay", "separate"} == set(f.reasons) for f in frames)
