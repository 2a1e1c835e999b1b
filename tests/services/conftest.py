"""Fixtures of the services' tests: frames made by the bundle's own linear model."""

import numpy as np
import pytest

import services  # noqa: F401  (one thread for the numerical libraries, before numpy starts them)
from models.bundle import Bundle
from protocol.frames import DeltaFrame
from services.preprocessing import Preprocessing
from services.runtime.config import Skin
from tests import needs
from tests.services.stub_skin import whole_scan

FRAME_NS = 45_000_000


@pytest.fixture(scope="session")
def bundle():
    return Bundle.load("square16")


@pytest.fixture
def skin():
    return Skin(port="stub", bundle="square16", frame_id="palm", network="none")


class Board:
    """Raw frames of a skin that obeys the bundle's linearised model."""

    def __init__(self, bundle, snr_db=80.0, seed=0):
        self.m, self.rng, self.scan = bundle.matrices, np.random.default_rng(seed), 0
        self.frame_ns, self._now = FRAME_NS, 0
        self.sigma = 10 ** (-snr_db / 20)
        h, w = self.m.inside.shape
        side = -1 + 2 * (np.arange(8 * h) + 0.5) / (8 * h)
        self._x, self._y, self._block = side[None, :], side[:, None], (h, 8, w, 8)

    def disc(self, x, y, radius, drop):
        """(K,) relative difference of a disc; model units, S/m."""
        inside = (self._x - x) ** 2 + (self._y - y) ** 2 < radius**2
        pixels = inside.reshape(self._block).mean(axis=(1, 3)) * drop
        return np.asarray(self.m.jacobian @ pixels.ravel())

    def frame(self, difference=0.0, board="b1", source="board"):
        """The next frame, `difference` (K,) relative to the untouched skin."""
        self.scan, self._now = self.scan + 1, self._now + self.frame_ns
        z = self.m.z0 * (1 + difference) * (1 + self.sigma * self.rng.standard_normal(len(self.m.z0)))
        stamps = {"sample": self._now, "read": self._now + 1_000_000}
        return whole_scan(z, self.scan, stamps=stamps, source=source, board=board)


@pytest.fixture
def board(bundle):
    return Board(bundle)


class Fed:
    """Preprocessing, and the board that feeds it."""

    def __init__(self, skin, bundle, board):
        self.stage, self.board, self.skin, self.bundle = Preprocessing("palm", skin, bundle), board, skin, bundle

    def run(self, frame):
        (out,) = self.stage.everything(frame, frozenset({"delta"}))
        assert isinstance(out, DeltaFrame) and np.isfinite(out.difference).all()
        return out

    def feel(self, difference=0.0, scans=1, source="board"):
        return [self.run(self.board.frame(difference, source=source)) for _ in range(scans)]

    def tared(self):
        out = self.feel(scans=72)[-1]
        assert out.valid and not out.touched
        return self

    def again(self):
        """Another that is fed by the same board."""
        return Fed(self.skin, self.bundle, self.board)

    def tare(self, **args):
        return self.stage.command("tare", args)

    @property
    def problem(self):
        return (self.stage.health().messages or [""])[0]


@pytest.fixture
def fed(skin, bundle, board):
    return Fed(skin, bundle, board)


@pytest.fixture
def tared(fed):
    return fed.tared()


@pytest.fixture(scope="session")
def reference():
    """The folder of the reference data."""
    return needs.reference("eidors_reference.npz").parent
