"""Presses at known places collected from frames as a service sends them, and what reads the file."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from models.shapes import Shape
from protocol.frames import Frame
from protocol.scan_setting import COHERENT
from services.calibration import collecting, presses_csv
from services.calibration.collecting import Collected, Collector
from services.calibration.force_fit import CalibrationError
from services.calibration.force_presses import of_file
from services.calibration.presses import read_presses
from services.calibration.seen import SeenTouch, TouchReader
from services.runtime.config import Skin
from tests.services.stub_skin import StubSkin

SKIN = Skin(port="stub", bundle="square16", frame_id="palm", network="none")
READER = TouchReader(SKIN, Bundle.load("square16"))
UNIT = 0.05  # m
SCAN_S = 0.045


class Frames:
    """Raw and image frames of the stub's skin, scan after scan, as they are asked for; `shapes` is what presses it.
    With `late` the raw frame of a scan comes after its image.
    """

    def __init__(self, late: bool = False) -> None:
        self.stub, self.late, self.now = StubSkin(80.0, skin=SKIN), late, 0.0
        self.shapes: tuple[Shape, ...] = ()
        self._ready: deque[Frame] = deque()

    def recv(self, timeout_s: float = 0.0) -> Frame | None:
        if timeout_s == 0.0:
            self._ready.clear()
            return None
        if not self._ready:
            self.now += SCAN_S
            raws: list[Frame] = []
            run = self.stub.pipeline.run
            self.stub.pipeline.run = lambda raw: (raws.append(raw), run(raw))[1]  # type: ignore[method-assign]
            image = self.stub.feel(self.shapes).image
            self.stub.pipeline.run = run  # type: ignore[method-assign]
            self._ready.extend([image, raws[0]] if self.late else [raws[0], image])
        return self._ready.popleft()

    def clock(self) -> float:
        return self.now


@pytest.mark.parametrize("late", [False, True])
def test_a_press_is_measured_against_the_scans_just_before(late: bool) -> None:
    frames = Frames(late)
    collector = Collector(frames, READER, frames.clock)
    before = collector.untouched()
    frames.shapes = (Shape("circle", 0.4, -0.2, 0.2, 0.3),)
    touched, seen = collector.pressed()
    sheet = frames.stub
    z0, z = (np.abs(sheet.analog.measure((t, t), sheet.pattern, COHERENT, 4e4, 0.0)[0]) for t in _true(frames.shapes))
    np.testing.assert_allclose(before, z0, rtol=5e-4)  # 80 dB
    np.testing.assert_allclose(touched, z, rtol=5e-4)
    assert np.abs(touched / before - 1).max() > 0.01
    assert (seen.x, seen.y) == pytest.approx((0.02, -0.01), abs=2e-3)


def _true(shapes: tuple[Shape, ...]) -> tuple[np.ndarray, np.ndarray]:
    from tests.services.stub_skin import transfer

    return transfer(), transfer(shapes)


def test_nobody_presses_or_something_touches_all_the_time() -> None:
    frames = Frames()
    collector = Collector(frames, READER, frames.clock, patience_s=5.0)
    with pytest.raises(CalibrationError, match="no steady press within 5 s: nothing touches"):
        collector.pressed()
    frames.shapes = (Shape("circle", 0.4, -0.2, 0.2, 0.3),)
    with pytest.raises(CalibrationError, match="no untouched scans within 5 s: something touches"):
        collector.untouched()


def test_the_file_is_what_register_and_calibrate_force_read(tmp_path: Path) -> None:
    bundle = Bundle.load("square16")
    seen = SeenTouch(0.0, 0.0, {})
    rng = np.random.default_rng(0)
    z0 = np.asarray(bundle.z0)
    presses = [Collected(0.001 * k, -0.002 * k, 1.0 + k, z0 * (1 + 1e-2 * rng.random(len(z0))), z0) for k in range(24)]
    file = tmp_path / "presses.npz"
    forces = collecting.write(file, presses, bundle.pattern)
    with np.load(file) as arrays:
        found = read_presses(dict(arrays), bundle)
    np.testing.assert_allclose(found.xy, [(p.x, p.y) for p in presses])
    np.testing.assert_allclose(found.difference, [p.touched / p.untouched - 1 for p in presses])
    assert forces == tmp_path / "presses.csv"
    rows: list[int] = []
    read = presses_csv.read(forces, None, lambda row: (rows.append(row), seen)[1])
    assert [p.force_n for p in read] == [p.force_n for p in presses] and rows == list(range(24))
    of_file(file, SKIN, bundle, lambda text: None)  # reads measurements and reference
    unknown = [Collected(0.0, 0.0, None, z0, z0)]
    assert collecting.write(tmp_path / "unknown.npz", unknown, bundle.pattern) is None


def test_places_are_spread_over_the_skin_and_away_from_its_edge() -> None:
    ell = 0.05 * np.array([[-1, -1], [1, -1], [1, 0], [0, 0], [0, 1], [-1, 1]])
    found = collecting.places(ell, 30, 0.006)
    assert found.shape == (30, 2)
    assert not ((found > -0.006 + 1e-9).all(axis=1)).any()  # none in the corner that is missing, nor near it
    assert (np.abs(found) <= 0.05 - 0.006 + 1e-9).all()
    apart = np.hypot(*(found[:, None] - found).transpose(2, 0, 1)) + np.eye(30)
    assert apart.min() > 0.007  # a lattice of 30 on 75 cm^2 would have 17 mm
    with pytest.raises(CalibrationError, match="no place of the skin is 60 mm from its outline"):
        collecting.places(ell, 1, 0.06)
