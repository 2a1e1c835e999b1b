"""The stages behind the stub's sheet and analogue part, without board, link and time."""

from contextlib import contextmanager
from copy import deepcopy
from functools import cache

import numpy as np

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from firmware_stub.sheet import Sheet
from models.bundle import Bundle
from protocol.frames import ELECTRODE_STATES, RawFrame
from protocol.scan_setting import COHERENT
from services.pipeline import Pipeline, Result
from simulation.truth import lasting

SCAN_S = 0.045
METRES = 0.05  # per unit of the bundle's model
TARE_SCANS = 72


def whole_scan(z, number, status=None, **more):
    """A believed frame of a board that scans every 45 ms."""
    now = number * 45_000_000
    said = {"stamps": {"sample": now, "read": now + 1}, "source": "board", "valid": True, "valid_for_s": 0.5, **more}
    status = np.zeros(len(z), np.uint8) if status is None else status
    return RawFrame(**{"skin": "palm", "scan": number, "z": z.astype(np.complex64), "status": status, **said})


@cache
def bundle_of_square16():
    return Bundle.load("square16")


@cache
def sheet():
    return Sheet("square16")


@cache
def transfer(shapes=(), contacts=()):
    """(16, 16) ohm of the stub's sheet, touched. contacts: electrodes, and the factors on their contact impedances."""
    impedance = sheet().skin.contact_impedance.copy()
    for electrode, factor in contacts:
        impedance[electrode] *= factor
    return sheet().model.solve(sheet().model.touched(list(shapes)), impedance).transfer


class StubSkin:
    """The stub's analogue part, then the stages of square16; a tared one takes over the state of another."""

    def __init__(self, snr_db=80.0, tare=True, skin="square16", bundle=None):
        """bundle: that the skin names, where it is not square16."""
        bundle = bundle or bundle_of_square16()
        self.pattern, self.faults, self.scan = np.asarray(bundle.pattern), Faults(), 0
        copied = tare and skin == "square16"
        self.analog = Analog(BoardNoise(10 ** (-snr_db / 20)), self.faults, np.random.default_rng(4 if copied else 3))
        self.pipeline = Pipeline(skin, name="palm", bundle=bundle)
        if copied:
            for stage, state in zip(self.stages, deepcopy(_tared(snr_db)), strict=True):
                stage.load(state)
            self.scan = TARE_SCANS
        elif tare:
            assert self.rest(TARE_SCANS).contact.valid

    @property
    def stages(self):
        return self.pipeline.pre, self.pipeline.inference, self.pipeline.publishing

    @contextmanager
    def fault(self, name, **args):
        self.faults.inject(name, args, 0.0, 1e9)
        yield
        self.faults.clear(name)

    def rest(self, frames):
        for _ in range(frames):
            result = self.feel()
        return result

    def feel(self, shapes=(), contacts=()):
        return self.see(transfer(shapes, contacts))

    def felt(self, scans, shapes=(), contacts=()):
        return [self.feel(shapes, contacts) for _ in range(scans)]

    def see(self, t, end=None):
        """One scan of a sheet with these transfer impedances; end: with those when it ends, changing steadily."""
        return self.run(*self.measured(t, end))

    def measured(self, t, end=None):
        return self.analog.measure((t, t if end is None else end), self.pattern, COHERENT, 40_000.0, 0.0)

    def run(self, z, status=None):
        self.scan += 1
        return self.pipeline.run(whole_scan(z, self.scan, status))


@cache
def _tared(snr_db):
    skin = StubSkin(snr_db, tare=False)
    assert not skin.rest(TARE_SCANS).delta.touched
    return [stage.state() for stage in skin.stages]


def present(result):
    """What is said to press."""
    return lasting(result.contact)


def off_m(result, shape):
    """How far the one contact is from a touch."""
    (contact,) = present(result)
    return float(np.hypot(contact.position[0] - METRES * shape.x, contact.position[1] - METRES * shape.y))


def states(result):
    """The electrodes in each state but ok."""
    found = (result.delta if isinstance(result, Result) else result).electrodes
    return {name: np.flatnonzero(found == k).tolist() for k, name in enumerate(ELECTRODE_STATES) if k and k in found}
