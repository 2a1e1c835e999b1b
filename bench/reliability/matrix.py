"""The fault matrix: every fault of the stub x what touches meanwhile x places, each from a fresh start.

The time line of a case: SECONDS below. What is counted of the frames from the fault's beginning on:

- wrong: valid frames with a contact further than FAR_M from every true touch, and how many of them say `changing`;
- unseen: valid frames, not `changing`, in which a touch that presses all the time has no contact;
- named: whether something that a person can act on named the fault while it lasted, where it can be named at all;
- again_s: from the fault's end to the first of WELL_FRAMES valid frames in a row; a sticky fault ends by a power cycle.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.reliability.counts import Counts
from bench.reliability.scenes import SolvedSheet, press, script, touches_at_random
from bench.reliability.session import Moment, Session
from firmware_stub.faults import FAULTS, MUXES
from firmware_stub.timeline import Cue, PiecewiseLinear, TouchPath
from firmware_stub.world import Touch
from protocol.frames import ELECTRODE_STATES
from services.pipeline import Pipeline

PRESS_S, FAULT_S, FAULT_END_S, RELEASE_S, END_S = 6.0, 7.0, 8.5, 11.5, 15.0
BEGINS_S = 7.7  # a touch that begins during the fault
SLIDE_M = 0.03
WELL_FRAMES = 5
NEVER = math.inf  # not valid again before the case ended

MEASUREMENT, GAIN, BOARD = 1.0, 2.0, 3.0  # seconds after its end within which frames are valid again
CONTACT_RISES = "contact rises"  # no fault of the board: an electrode that lifts, which a scene does to the sheet
SITUATIONS = ("untouched", "held", "sliding", "begins")


@dataclass(frozen=True)
class Row:
    """One row of the matrix. draw: arguments of a case. names: a reason, or an electrode's state, that names it; the
    sentence of acquisition counts too. Empty: nobody can tell, the answer must only not be wrong.
    """

    fault: str
    recovery_s: float
    names: tuple[str, ...] = ()
    board: bool = False  # acquisition says it, in words
    draw: Callable[[np.random.Generator], dict[str, Any]] = lambda rng: {}
    label: str = ""

    @property
    def title(self) -> str:
        return self.label or self.fault


def _electrode(rng: np.random.Generator) -> dict[str, Any]:
    return {"electrode": int(rng.integers(16))}


def _two(rng: np.random.Generator) -> dict[str, Any]:
    return {"electrodes": [int(e) for e in rng.permutation(16)[:2]]}


def _mux(rng: np.random.Generator) -> dict[str, Any]:
    return {"mux": MUXES[rng.integers(4)]}


def _bit(rng: np.random.Generator) -> dict[str, Any]:
    return {**_mux(rng), "bit": int(rng.integers(4)), "value": int(rng.integers(2))}


def _small_gain(rng: np.random.Generator) -> dict[str, Any]:
    return {"factor": float(1 + rng.choice([-1, 1]) * 0.05 * 50.0 ** -rng.random())}


def _large_gain(rng: np.random.Generator) -> dict[str, Any]:
    return {"gain": float(1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2))}


def _silent(rng: np.random.Generator) -> dict[str, Any]:
    return {"silent": True}


def _overrange(rng: np.random.Generator) -> dict[str, Any]:
    return {"gain": float(rng.uniform(2, 4))}  # less does not reach the limit with the gain resistor of skin.toml


def _rises(rng: np.random.Generator) -> dict[str, Any]:
    return {"electrode": int(rng.integers(16)), "times": float(1.15 * 9.0 ** rng.random())}


FIFO = ("fifo",)
ROWS = (
    Row("wrong_chip_id", BOARD, board=True),
    Row("brown_out", BOARD, ("multiplexer",), board=True),
    Row("brown_out", BOARD, ("multiplexer",), board=True, draw=_silent, label="brown_out, silent"),
    Row("stale_rtia", GAIN, ("gain",), draw=_large_gain),
    Row("gain", GAIN, ("gain",), draw=_small_gain),
    Row("clipped", MEASUREMENT, ("saturated",)),
    Row("clipped", MEASUREMENT, draw=_silent, label="clipped, silent"),
    Row("rtia_overrange", MEASUREMENT, ("saturated",), draw=_overrange),
    Row(
        "rtia_overrange",
        MEASUREMENT,
        draw=lambda rng: _overrange(rng) | _silent(rng),
        label="rtia_overrange, silent",
    ),
    Row("missed_interrupt", MEASUREMENT, FIFO),
    Row("missed_interrupt", MEASUREMENT, draw=_silent, label="missed_interrupt, silent"),
    Row("fifo_overflow", MEASUREMENT, FIFO),
    Row("fifo_overflow", MEASUREMENT, draw=_silent, label="fifo_overflow, silent"),
    Row("fifo_underflow", MEASUREMENT, FIFO),
    Row("fifo_underflow", MEASUREMENT, draw=_silent, label="fifo_underflow, silent"),
    Row("fifo_misaligned", MEASUREMENT, (*FIFO, "multiplexer")),
    Row("fifo_misaligned", MEASUREMENT, draw=_silent, label="fifo_misaligned, silent"),
    Row("electrode_open", MEASUREMENT, ("open",), draw=_electrode),
    Row("electrodes_shorted", MEASUREMENT, ("short",), draw=_two),
    Row("electrodes_swapped", MEASUREMENT, ("swapped",), draw=_two),
    Row(CONTACT_RISES, MEASUREMENT, ("drifting", "open"), draw=_rises),
    Row("mux_stuck", MEASUREMENT, ("multiplexer",), draw=_bit),
    Row("mux_disabled", MEASUREMENT, ("multiplexer",), draw=_mux),
    Row("partial_frames", MEASUREMENT, ("gap",)),
    Row("sequence_gaps", MEASUREMENT, ("gap",)),
    Row("late_frames", MEASUREMENT),
    Row("repeated_frames", MEASUREMENT),
    Row("line_noise", MEASUREMENT, ("gap",)),
    Row("clock_jump", BOARD, ("clock",), board=True),
    Row("frozen", MEASUREMENT, ("frozen",)),
    Row("wrong_schema", BOARD, board=True),
    Row("hang", BOARD, board=True),
    Row("unplug", BOARD, board=True),
    Row("power_cycle", BOARD, board=True),
)


@dataclass
class FaultScore(Counts):
    """What was counted of one case, or of several (`add`)."""

    cases: int = 0
    frames: int = 0  # from the fault's beginning on
    valid: int = 0
    wrong: int = 0
    wrong_changing: int = 0
    unseen: int = 0
    during: int = 0  # frames while the fault was in force
    during_valid: int = 0
    nameable: int = 0  # cases whose fault has a name
    named: int = 0
    late: int = 0  # cases that were valid again too late
    again_s: list[float] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)  # in frames while the fault was in force
    worst: list[str] = field(default_factory=list)  # cases that were wrong, for a person

    def row(self) -> dict[str, Any]:
        finite = [t for t in self.again_s if math.isfinite(t)]
        return {
            "cases": self.cases,
            "frames": self.frames,
            "nameable": self.nameable,
            "named": self.named,
            "wrong": self.wrong,
            "wrong_changing": self.wrong_changing,
            "unseen": self.unseen,
            "named_%": 100 * self.named / self.nameable if self.nameable else None,
            "again_most_s": max(self.again_s, default=None),
            "again_median_s": float(np.median(self.again_s)) if finite else None,
            "late": self.late,
            "invalid_%": 100 * (1 - self.valid / max(self.frames, 1)),
            "during_invalid_%": 100 * (1 - self.during_valid / max(self.during, 1)) if self.during else None,
            "reasons": dict(self.reasons.most_common(4)),
            "worst": self.worst[:5],
        }


def tracks_of(situation: str, touch: Touch) -> tuple[TouchPath, ...]:
    """What touches: not, all the time, on its way, or from the middle of the fault on."""
    if situation == "untouched":
        return ()
    if situation == "begins":
        return (press(touch, BEGINS_S, RELEASE_S),)
    away = math.copysign(SLIDE_M, -touch.x if touch.x else 1.0)
    return (press(touch, PRESS_S, RELEASE_S, (touch.x + away, touch.y) if situation == "sliding" else None),)


def contact_of(row: Row, args: dict[str, Any]) -> tuple[tuple[int | None, PiecewiseLinear], ...]:
    if row.fault != CONTACT_RISES:
        return ()
    jump = 1e-3
    times = (0.0, FAULT_S - jump, FAULT_S, FAULT_END_S - jump, FAULT_END_S)
    return ((args["electrode"], PiecewiseLinear(times, (1.0, 1.0, args["times"], args["times"], 1.0))),)


def cues_of(row: Row, args: dict[str, Any]) -> tuple[Cue, ...]:
    if row.fault == CONTACT_RISES:
        return ()
    cue = Cue(FAULT_S, row.fault, args, FAULT_END_S - FAULT_S)
    ends = (Cue(FAULT_END_S, "power_cycle", {}, 0.1),) if FAULTS[row.fault].sticky else ()
    return (cue, *ends)


def run_case(sheet: SolvedSheet, pipeline: Pipeline, row: Row, situation: str, touch: Touch, seed: int) -> FaultScore:
    """One fault at one place."""
    rng = np.random.default_rng([seed, *row.title.encode()])
    args = row.draw(rng)
    session = Session(
        sheet, script(tracks_of(situation, touch), cues_of(row, args), contact_of(row, args)), seed, pipeline
    )
    moments = list(session.run(END_S))
    session.close()
    said = [text for at, text in session.problems if text and at >= FAULT_S]
    score = judged(row, moments, bool(said))
    if score.wrong:
        where = f"({touch.x * 1e3:+.0f}, {touch.y * 1e3:+.0f}) mm, {touch.force_n:.1f} N"
        score.worst = [f"{row.title} {args or ''}, {situation} at {where}: {score.wrong} frames"]
    return score


def judged(row: Row, moments: Sequence[Moment], said: bool) -> FaultScore:
    """said: whether acquisition said in words that something is wrong with the board."""
    # A fault takes hold of the scan under way; one that ends by itself leaves the scan that begins after it alone.
    end_s = FAULT_END_S if row.fault != "power_cycle" else FAULT_S
    after = [m for m in moments if m.read_s >= FAULT_S]
    during = [m for m in after if m.middle_s < end_s]
    wrong = [m for m in after if m.phantoms()]
    score = FaultScore(
        cases=1,
        frames=len(after),
        valid=sum(m.valid for m in after),
        wrong=len(wrong),
        wrong_changing=sum(m.changing for m in wrong),
        unseen=sum(m.valid and not m.changing and bool(m.unseen()) for m in after),
        during=len(during),
        during_valid=sum(m.valid for m in during),
        reasons=Counter(reason for m in during for reason in m.reasons),
    )
    if row.names or row.board:
        score.nameable = 1
        heard = {reason for m in during for reason in m.reasons}
        heard |= {ELECTRODE_STATES[e] for m in during for e in m.electrodes}
        score.named = int(bool(heard & set(row.names)) or (row.board and said))
    score.again_s = [valid_again(moments, end_s)]
    score.late = int(score.again_s[0] > row.recovery_s)
    return score


def valid_again(moments: Sequence[Moment], end_s: float, well: int = WELL_FRAMES) -> float:
    """Seconds from end_s to the first of `well` frames in a row that are valid; NEVER where there are none."""
    run: list[float] = []
    for m in moments:
        if m.read_s < end_s:
            continue
        run = [*run, m.read_s] if m.valid else []
        if len(run) == well:
            return max(0.0, run[0] - end_s)
    return NEVER


def places(count: int, seed: int) -> list[Touch]:
    return touches_at_random(count, seed)
