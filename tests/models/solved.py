"""The square skin on a mesh that no bundle was built on, and what touches do to it: solved once for all tests."""

from functools import cache

import numpy as np

from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from firmware_stub.worlds import table
from models.bundle import Bundle
from models.measurement.tables import SkinTables, tables_of

UNIT_M = 0.05


@cache
def sheet() -> Sheet:
    return Sheet("square16", mesh=table.MESH)


@cache
def untouched() -> np.ndarray:
    return np.abs(sheet().model.read(sheet().transfer(World())))


@cache
def change(*touches: Touch) -> np.ndarray:
    """(K,) of |Z|, relative, by finite elements."""
    found = np.abs(sheet().model.read(sheet().transfer(World(touches)))) / untouched() - 1
    found.flags.writeable = False
    return found


def log_change(conductivity: np.ndarray | float = 1.0, contact: np.ndarray | None = None) -> np.ndarray:
    """(K,) of log |Z| of the sheet without touches; conductivity and contact impedances as ForwardModel takes them."""
    return np.log(np.abs(sheet().model.solve(conductivity, contact).impedances()) / untouched())


@cache
def tables() -> SkinTables:
    return tables_of(Bundle.load("square16")).relative_to(untouched())


def action_of(touch: Touch) -> float:
    return touch.drop / (1 - touch.drop / 2) * np.pi * (touch.radius / UNIT_M) ** 2
