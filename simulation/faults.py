"""The faults of a board as tests and benchmarks inject them: how each is drawn, what names it, how soon all is well."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_stub.faults import FAULTS, MUXES
from firmware_stub.timeline import Cue
from simulation.scenes import ContactCurves, step

MEASUREMENT, GAIN, BOARD = 1.0, 2.0, 3.0  # seconds after its end within which frames are valid again
CONTACT_RISES = "contact rises"  # no fault of the board: an electrode that lifts, which a script does to the sheet
Arguments = dict[str, Any]


@dataclass(frozen=True)
class FaultRow:
    """One fault. draw: arguments of a case. names: reasons of frames, or states of an electrode, that name it; what
    acquisition says of the board does too where `board`. No name: nobody can tell, frames must only not be wrong.
    """

    fault: str
    recovery_s: float
    names: tuple[str, ...] = ()
    board: bool = False
    draw: Callable[[np.random.Generator], Arguments] = lambda rng: {}
    label: str = ""

    @property
    def title(self) -> str:
        return self.label or self.fault

    def cues(self, args: Mapping[str, Any], at: float, seconds: float) -> tuple[Cue, ...]:
        """In force from `at` for so long; what is sticky ends by a power cycle."""
        if self.fault == CONTACT_RISES:
            return ()
        ends = (Cue(at + seconds, "power_cycle", {}, 0.1),) if FAULTS[self.fault].sticky else ()
        return (Cue(at, self.fault, dict(args), seconds), *ends)

    def contact(self, args: Mapping[str, Any], at: float, seconds: float) -> ContactCurves:
        """What the fault does to contact impedances meanwhile."""
        return (step(args["electrode"], args["times"], at, at + seconds),) if self.fault == CONTACT_RISES else ()


def _electrode(rng: np.random.Generator) -> Arguments:
    return {"electrode": int(rng.integers(16))}


def _two(rng: np.random.Generator) -> Arguments:
    return {"electrodes": [int(e) for e in rng.permutation(16)[:2]]}


def _mux(rng: np.random.Generator) -> Arguments:
    return {"mux": MUXES[rng.integers(4)]}


def _bit(rng: np.random.Generator) -> Arguments:
    return {**_mux(rng), "bit": int(rng.integers(4)), "value": int(rng.integers(2))}


def _small_gain(rng: np.random.Generator) -> Arguments:
    return {"factor": float(1 + rng.choice([-1, 1]) * 0.05 * 50.0 ** -rng.random())}


def _large_gain(rng: np.random.Generator) -> Arguments:
    return {"gain": float(1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2))}


def _silent(rng: np.random.Generator) -> Arguments:
    return {"silent": True}


def _overrange(rng: np.random.Generator) -> Arguments:
    return {"gain": float(rng.uniform(2, 4))}  # less does not reach the limit with the gain resistor of skin.toml


def _overrange_silent(rng: np.random.Generator) -> Arguments:
    return _overrange(rng) | _silent(rng)


def _rises(rng: np.random.Generator) -> Arguments:
    return {"electrode": int(rng.integers(16)), "times": float(1.15 * 9.0 ** rng.random())}


FIFO = ("fifo",)
ROWS = (
    FaultRow("wrong_chip_id", BOARD, board=True),
    FaultRow("brown_out", BOARD, ("multiplexer",), board=True),
    FaultRow("brown_out", BOARD, ("multiplexer",), board=True, draw=_silent, label="brown_out, silent"),
    FaultRow("stale_rtia", GAIN, ("gain",), draw=_large_gain),
    FaultRow("gain", GAIN, ("gain",), draw=_small_gain),
    FaultRow("clipped", MEASUREMENT, ("saturated",)),
    FaultRow("clipped", MEASUREMENT, draw=_silent, label="clipped, silent"),
    FaultRow("rtia_overrange", MEASUREMENT, ("saturated",), draw=_overrange),
    FaultRow("rtia_overrange", MEASUREMENT, draw=_overrange_silent, label="rtia_overrange, silent"),
    FaultRow("missed_interrupt", MEASUREMENT, FIFO),
    FaultRow("missed_interrupt", MEASUREMENT, draw=_silent, label="missed_interrupt, silent"),
    FaultRow("fifo_overflow", MEASUREMENT, FIFO),
    FaultRow("fifo_overflow", MEASUREMENT, draw=_silent, label="fifo_overflow, silent"),
    FaultRow("fifo_underflow", MEASUREMENT, FIFO),
    FaultRow("fifo_underflow", MEASUREMENT, draw=_silent, label="fifo_underflow, silent"),
    FaultRow("fifo_misaligned", MEASUREMENT, (*FIFO, "multiplexer")),
    FaultRow("fifo_misaligned", MEASUREMENT, draw=_silent, label="fifo_misaligned, silent"),
    FaultRow("electrode_open", MEASUREMENT, ("open", "electrode_open"), draw=_electrode),
    FaultRow("electrodes_shorted", MEASUREMENT, ("short", "electrode_short"), draw=_two),
    FaultRow("electrodes_swapped", MEASUREMENT, ("swapped", "electrode_swapped"), draw=_two),
    FaultRow(CONTACT_RISES, MEASUREMENT, ("drifting", "open", "electrode_drift", "electrode_open"), draw=_rises),
    FaultRow("mux_stuck", MEASUREMENT, ("multiplexer",), draw=_bit),
    FaultRow("mux_disabled", MEASUREMENT, ("multiplexer",), draw=_mux),
    FaultRow("partial_frames", MEASUREMENT, ("gap",)),
    FaultRow("sequence_gaps", MEASUREMENT, ("gap",)),
    FaultRow("late_frames", MEASUREMENT),
    FaultRow("repeated_frames", MEASUREMENT),
    FaultRow("line_noise", MEASUREMENT, ("gap",)),
    FaultRow("clock_jump", BOARD, ("clock",), board=True),
    FaultRow("frozen", MEASUREMENT, ("frozen",)),
    FaultRow("wrong_schema", BOARD, board=True),
    FaultRow("hang", BOARD, board=True),
    FaultRow("unplug", BOARD, board=True),
    FaultRow("power_cycle", BOARD, board=True),
)


def row_of(title: str) -> FaultRow:
    """Raises KeyError."""
    return {row.title: row for row in ROWS}[title]
