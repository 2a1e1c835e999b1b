"""Files of separate scans: what touches is found live as it is offline, whatever the order of the rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame
from services.calibration.presses import part
from services.calibration.register_command import register_presses
from services.estimation.first.references import alike, noise_of_references
from services.pipeline import Pipeline
from services.recordings import file_source
from services.recordings.file_source import FileSource, RecordingSource, file_frame
from services.recordings.importing import import_arrays
from services.recordings.npz_file import Input, frames_of, load_npz, read_scans
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def presses(reference: Path) -> Arrays:
    return load_npz(reference / "hydrogel_disc16.npz")


@pytest.fixture(scope="module")
def registered(presses: Arrays, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The hydrogel skin, registered on the first 100 presses."""
    folder = tmp_path_factory.mktemp("skins") / "mine"
    register_presses(presses, "disc16", 100, folder)
    return Bundle.load(folder)


def skin_of(bundle: Bundle, port: str = "stub") -> Skin:
    return Skin(port=port, bundle=str(bundle.path), frame_id="skin")


def live(data: Input, bundle: Bundle) -> Iterator[tuple[RawFrame, ContactFrame]]:
    """What the processes make of the file's frames, as they come from a port or a replay."""
    pipeline = Pipeline(skin_of(bundle), bundle=bundle)
    for scan, (values, kind) in enumerate(frames_of(data), start=1):
        frame = file_frame("skin", "opposite", scan, values, kind, scan * 45_000_000, data.separate)
        yield frame, pipeline.run(frame).contact


def present(frame: ContactFrame) -> list[list[float]]:
    return [c.position[:2] for c in frame.contacts if c.state != "end"]


def test_real_presses_are_found_live_as_offline(presses: Arrays, registered: Bundle) -> None:
    """60 of the presses that took no part in registration. (bench.real_presses has all 400.)"""
    data = read_scans(part(presses, slice(100, 160)), registered)
    offline = reconstruct(data, skin_of(registered), registered)
    seen = list(live(data, registered))
    assert not any(present(contact) for raw, contact in seen if raw.kind == "reference")
    agree = 0
    for row, contact in enumerate(contact for raw, contact in seen if raw.kind == "full"):
        assert contact.valid and "changing" not in contact.reasons and "separate" in contact.reasons
        places = present(contact)
        agree += len(places) == 1 and bool(np.hypot(*(places[0] - offline["position"][row, 0])) < 5e-4)
    assert agree >= 59


def test_the_order_of_the_rows_does_not_matter(presses: Arrays, registered: Bundle) -> None:
    """What is found in a shuffled file is what is found in the file as it was recorded, over hours of drift."""
    order = np.random.default_rng(1).permutation(400) + 100
    shuffled = {name: a if name == "pattern" else a[order] for name, a in presses.items()}
    mixed = reconstruct(read_scans(part(shuffled, slice(0, 60)), registered), skin_of(registered), registered)
    data = read_scans(presses, registered)
    rows = order[:60]
    plain = reconstruct(
        Input(data.measurements[rows], None, data.reference[rows]),  # type: ignore[index]
        skin_of(registered),
        registered,
    )
    assert mixed["touched"].all() and plain["touched"].all()
    assert np.linalg.norm(mixed["position"][:, 0] - plain["position"][:, 0], axis=1).max() < 5e-4


def test_noise_is_the_same_in_any_order(presses: Arrays) -> None:
    untouched = presses["untouched"].astype(float)
    order = np.random.default_rng(2).permutation(500)
    assert np.array_equal(noise_of_references(untouched), noise_of_references(untouched[order]))
    assert set(alike(untouched, 64)) == set(order[alike(untouched[order], 64)])
    # Neighbours in time differ by 0.2 %, others by 4 %: it is the former.
    assert 1e-3 < np.median(noise_of_references(untouched[order][:64])) < 5e-3


@pytest.mark.parametrize("counts", [1e-6, 1.0, 1e9])
def test_noise_of_any_scale_and_number_of_scans(counts: float) -> None:
    rng = np.random.default_rng(3)
    for scans in (2, 10, 100):
        gain = np.exp(rng.normal(size=(scans, 1)))
        rows = counts * gain * rng.uniform(1, 9, 192) * (1 + 2e-3 * rng.standard_normal((scans, 192)))
        rows[0, 5] = np.nan
        assert np.isclose(np.median(noise_of_references(rows)), 2e-3, rtol=0.3)
        twice = np.concatenate([rows, rows])
        assert np.allclose(noise_of_references(twice), noise_of_references(rows)), "a row that stands there twice"


# on the simulated skin


@pytest.fixture(scope="module")
def touches() -> Arrays:
    """Twenty presses of the bundle's own physics, each at a place of its own; gain drifts by a third between them."""
    m, rng = Bundle.load("square16").matrices, np.random.default_rng(5)
    side = -1 + 2 * (np.arange(24) + 0.5) / 24
    gain = np.exp(np.cumsum(0.02 * rng.standard_normal((20, 1)), axis=0))
    drops = [
        0.3 * (np.hypot(side[None] - x, side[:, None] - y) < 0.25).ravel() for x, y in rng.uniform(-0.5, 0.5, (20, 2))
    ]
    rows = m.z0 * (1 + np.array(drops) @ m.jacobian.T)
    noise = 1 + 3e-4 * rng.standard_normal((2, 20, 120))
    return {"untouched": gain * m.z0 * noise[0], "touched": gain * rows * noise[1]}


def test_each_touch_begins_and_ends(touches: Arrays) -> None:
    """Under an id of its own, though the next press may be at the same place."""
    bundle = Bundle.load("square16")
    ids = []
    for raw, contact in live(read_scans(touches, bundle), bundle):
        states = [c.state for c in contact.contacts]
        if raw.kind == "full":
            assert contact.valid and states == ["begin"], raw.scan
            ids += [c.id for c in contact.contacts]
        elif ids:
            assert states == ["end"] and contact.contacts[0].id == ids[-1]
    assert len(set(ids)) == 20


def test_a_scan_whose_reference_was_lost_is_not_valid(touches: Arrays) -> None:
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


def test_measurements_missing_from_one_reference_are_missing_there_only(touches: Arrays) -> None:
    bundle = Bundle.load("square16")
    whole = [present(c) for raw, c in live(read_scans(touches, bundle), bundle) if raw.kind == "full"]
    untouched = touches["untouched"].copy()
    untouched[3, ::10] = np.nan
    data = read_scans({**touches, "untouched": untouched}, bundle)
    for row, (raw, contact) in enumerate(each for each in live(data, bundle) if each[0].kind == "full"):
        assert contact.valid and len(present(contact)) == 1, raw.scan
        assert np.hypot(*np.subtract(present(contact)[0], whole[row][0])) < (3e-3 if row == 3 else 5e-4)


def test_a_state_in_the_middle_goes_on_bit_by_bit(touches: Arrays) -> None:
    bundle = Bundle.load("square16")
    first, second = (Pipeline(skin_of(bundle), bundle=bundle) for _ in range(2))
    data = read_scans(touches, bundle)
    for scan, (values, kind) in enumerate(frames_of(data), start=1):
        frame = file_frame("skin", "pairs", scan, values, kind, scan * 10**8, data.separate)
        if scan == 15:
            second.pre.load(first.pre.state())
        one = first.run(frame).delta
        if scan >= 15:
            other = second.run(frame).delta
            assert np.array_equal(one.difference, other.difference) and one.threshold == other.threshold
            assert np.array_equal(one.sigma, other.sigma) and one.touched == other.touched


def test_ports_and_recordings_give_the_same_frames(
    touches: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
