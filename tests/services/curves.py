"""A skin solved by finite elements whose |Z| runs along a curve: raw frames in, contact frames out."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np

from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from firmware_stub.worlds import table
from models.mismatch import Mismatch
from models.rolling import order
from protocol.frames import Contact, ContactFrame, RawFrame
from services.pipeline import Pipeline
from services.runtime.config import Skin
from tests.services import stub_skin
from tests.services.stub_skin import bundle_of_square16 as bundle

SCAN_S, PARTS, NOISE = 0.0437, 10, 1e-4
FREE_S = 3.5  # untouched before anything happens: a baseline takes 64 scans
SKIN = Skin.model_validate({"port": "stub", "bundle": "square16", "frame_id": "palm"})
Curve = Callable[[np.ndarray], np.ndarray]  # seconds (K,) -> |Z| of each measurement at its own instant


@cache
def sheet() -> Sheet:
    return Sheet("square16", Mismatch(), mesh=table.MESH)


@cache
def impedance(*touches: Touch, background: float = 1.0) -> np.ndarray:
    return np.abs(sheet().model.read(sheet().transfer(World(touches, background=background))))


@cache
def turns() -> np.ndarray:
    return np.asarray(order(bundle().matrices, bundle().pattern, PARTS, bundle().half_width))


def between(*points: tuple[float, np.ndarray]) -> Curve:
    """|Z| that runs straight from point to point: (seconds, (K,) ohm)."""
    times, values = np.array([t for t, _ in points]), np.array([z for _, z in points])
    if len(times) == 1:
        return lambda t: values[0]
    each = np.arange(values.shape[1])

    def at(t: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        along = np.clip((t - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
        return values[k, each] + along * (values[k + 1, each] - values[k, each])

    return at


def press(*touches: Touch, ramp_s: float = 0.1, until_s: float = 60.0, left: float = 0.0) -> Curve:
    """From FREE_S on; `left` of it stays in the foam and fades in 20 s."""
    free, full = impedance(), impedance(*touches)
    rest = free + left * (full - free)
    begun = [(0.0, free), (FREE_S, free), (FREE_S + ramp_s, full)]
    return between(*begun, (until_s, full), (until_s + ramp_s, rest), (until_s + 20, free))


class Board:
    """Sends whole scans, or the newest values after each part of one."""

    def __init__(self, curve: Curve, parts: int = 1, seed: int = 1) -> None:
        self.curve, self.parts, self.rng = curve, parts, np.random.default_rng(seed)

    def frames(self, seconds: float, begin: float = 0.0) -> Iterator[RawFrame]:
        part_s = SCAN_S / self.parts
        rows = turns().reshape(self.parts, -1) if self.parts > 1 else np.arange(120)[None]
        z, measured, first = np.zeros(120), np.full(120, -np.inf), round(begin / part_s)
        for number in range(max(0, first - self.parts + 1), round(seconds / part_s)):
            own = rows[number % self.parts]
            instants = number * part_s + (np.arange(len(own)) + 0.5) / len(own) * part_s
            whole = np.zeros(120)
            whole[own] = instants
            z[own] = (self.curve(whole) * (1 + NOISE * self.rng.standard_normal(120)))[own]
            measured[own] = instants
            if np.isfinite(measured).all() and number >= first:
                yield self._frame(number, (number + 1) * part_s, part_s, z, measured, own)

    def _frame(self, number: int, end_s: float, part_s: float, z: np.ndarray, at: np.ndarray, own: Any) -> RawFrame:
        frame = RawFrame(skin="palm", scan=number, z=z.astype(np.complex64), status=np.zeros(120, np.uint8))
        frame.valid, frame.device_us = True, round((end_s - part_s) * 1e6)
        frame.stamps = {"sample": round((end_s - part_s / 2) * 1e9)}
        if self.parts > 1:
            frame.parts, frame.part = self.parts, number % self.parts + 1
            frame.age_us, frame.new = ((end_s - at) * 1e6).astype(np.float32), np.zeros(120, np.uint8)
            frame.new[own] = 1
        return frame


def stages_of(pipeline: Pipeline) -> tuple[Any, ...]:
    return pipeline.pre, pipeline.inference, pipeline.publishing


def new_pipeline() -> Pipeline:
    return Pipeline(SKIN, "palm", bundle())


def said(pipeline: Pipeline, frames: Iterator[RawFrame] | list[RawFrame]) -> list[ContactFrame]:
    """A part in which nothing touches makes none."""
    made = []
    for raw in frames:
        pipeline.prepare()
        made.append(pipeline.step(raw))
    return [frame for frame in made if frame is not None]


@cache
def _free(parts: int) -> list[dict[str, Any]]:
    pipeline = new_pipeline()
    frames = said(pipeline, Board(between((0.0, impedance())), parts, 2).frames(FREE_S))
    assert frames[-1].valid and not any(frame.contacts for frame in frames)
    return [stage.state() for stage in stages_of(pipeline)]


def free(parts: int = 1) -> Pipeline:
    """One that has known the untouched skin for FREE_S."""
    pipeline = new_pipeline()
    for stage, state in zip(stages_of(pipeline), deepcopy(_free(parts)), strict=True):
        stage.load(state)
    return pipeline


def run(curve: Curve, seconds: float, parts: int = 1, seed: int = 1) -> list[ContactFrame]:
    """All contact frames from FREE_S on; times are their stamps."""
    return said(free(parts), Board(curve, parts, seed).frames(seconds, FREE_S))


def at_s(frame: ContactFrame | RawFrame) -> float:
    return frame.stamps["sample"] * 1e-9


def between_s(frames: list[ContactFrame], begin: float, end: float = 99.0) -> list[ContactFrame]:
    return [frame for frame in frames if begin <= at_s(frame) < end]


def lasting(frame: ContactFrame) -> int:
    return len(stub_skin.lasting(frame))


def far_off(contact: Contact, touch: Touch) -> float:
    return float(np.hypot(contact.on_sheet[0] - touch.x, contact.on_sheet[1] - touch.y))


def shows(frames: list[ContactFrame], touches: int) -> bool:
    """Whether each is valid and shows so many, and there are some."""
    return bool(frames) and all(frame.valid and lasting(frame) == touches for frame in frames)


def ids(frames: list[ContactFrame]) -> set[int]:
    return {contact.id for frame in frames for contact in frame.contacts}
