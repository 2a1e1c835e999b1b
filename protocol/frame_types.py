"""The frames: one dataclass per topic, every field with its type, range and unit beside it.

WIRE.md's tables are printed from these. `frames.pack` and `frames.unpack` turn them into messages and back; which
topic carries which frame is in topics.py.

Frames start out invalid and earn `valid`. Fields of the header have defaults, so that a stage sets only what it
knows: session, seq and host are filled in by the publisher, the stamps by the runner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .fields import UINT64_MAX, Array, Bool, Float, Int, Text, Vector, Version, wire
from .records import ListOf, MapOf, Maybe, Record, Tree

SCHEMA = 3
"""Version of the frames' layout: raised when a field changes its meaning, goes, or is added without a default. Readers
accept all up to theirs. 2: `valid_for_s` counts from `sample`, not from `publish`; a held image is sent once. 3: the
pre-reconstruction is a topic of its own.
"""

STAMPS = ("sample", "read", "preprocess", "infer", "publish")
SOURCES = ("board", "stub", "replay")
REASONS = {
    "stale_baseline": "the baseline is too old or does not fit: tare",
    "touched_at_start": "something has touched the skin since the service began: free it, or tare if nothing touches",
    "saturated": "a measurement was beyond what the board measures: converter clipped, or RTIA overrange",
    "fifo": "the board lost or mixed up measurements: FIFO error or missed interrupt",
    "electrode_open": "an electrode has no contact with the skin",
    "electrode_short": "two electrodes are connected to each other",
    "electrode_swapped": "two electrodes' wires are exchanged",
    "electrode_drift": "an electrode's contact with the skin is changing: its measurements do not count",
    "multiplexer": "the board's multiplexer does not switch to the electrodes it is told to",
    "degraded": "several electrodes are missing: positions and forces are less certain than they say",
    "gap": "scans are missing just before this one",
    "low_snr": "the measurements are too noisy for the stated uncertainty",
    "out_of_distribution": "the measurements look like nothing the model was trained on",
    "coarse": "from the first parts of a scan since the touch began: that something touches, roughly where",
    "changing": "the touch came, went or changed while it was scanned: that something touches, but only roughly where",
    "extrapolated": "a force beyond the calibrated range",
    "late": "measured longer ago than it may be acted on: what brought it was held up",
    "clock": "the sample time is uncertain: the board's clock is not known well enough, or it jumped",
    "gain": "all measurements changed by one common factor: the board's gain stepped, and the baseline with it",
    "frozen": "the board sends the same scan again and again, with new numbers and times",
    "uncalibrated_force": "the skin has no force law: forces are nil",
    "replay": "from a recording",
    "separate": "a scan that stands by itself, from a file of such: it does not follow the frame before it in time",
    "non_finite": "set by the reader: a measured field holds NaN or infinity",
}
"""The reasons in use and what they mean; a reader accepts others too."""

SHAPES = ("circle", "triangle", "rectangle", "square", "L")
ELECTRODE_STATES = ("ok", "open", "short", "unknown", "drifting", "swapped", "stuck")
STATUS_CLIPPED, STATUS_OPEN, STATUS_RTIA, STATUS_FIFO = 1, 2, 4, 8
"""Bits of a measurement's status: converter clipped (ADCMIN/ADCMAX); current out of range (open electrode); RTIA
overrange; FIFO error or missed interrupt.
"""

NAME = r"[A-Za-z0-9_.\-]{1,64}"
_NAME = Text(64, form=NAME)
_COUNT = Int(0)


def _empty(dtype: str, dimensions: int) -> Any:
    return lambda: np.zeros((0,) * dimensions, dtype)


class Heard:
    """What a reader notes of a frame beside its fields: not on the wire, and not set on a frame that was made here."""

    __slots__ = ("valid_as_sent", "_ended")
    valid_as_sent: bool  # by the producer, where the reader's `non_finite` hides it
    _ended: list[Contact]

    @property
    def ended(self) -> list[Contact]:
        """Contacts that have ended: a client (client.py) takes them out of `contacts`."""
        return getattr(self, "_ended", [])

    def note_ended(self, ended: list[Contact]) -> None:
        self._ended = ended

    def note_valid(self, valid: bool) -> None:
        self.valid_as_sent = valid


@dataclass(slots=True, kw_only=True, eq=False)
class Frame(Heard):
    """The header: what every frame carries."""

    schema: int = wire(Version(1, SCHEMA), "version of this layout", SCHEMA, always=True)
    skin: str = wire(_NAME, "name of the skin, as in the topic")
    session: str = wire(
        Text(16, form="[0-9a-f]{16}"), "random, new each time the producer starts", "0" * 16, always=True
    )
    seq: int = wire(_COUNT, "number of this frame: counts up by one, per topic, in this session", 0, always=True)
    scan: int = wire(_COUNT, "the board's number of the scan, or part of one, that this frame comes from", 0)
    part: int = wire(Int(0, 10), "of a scan in parts: the part measured last, from 1 on; 0: a whole scan", 0)
    host: str = wire(
        Text(64), "host whose monotonic clock the stamps are of (its boot id): where it was measured", "", always=True
    )
    stamps: dict[str, int] = wire(
        MapOf(Int(0, unit="ns"), STAMPS, 16),
        "monotonic ns: `sample` = middle of the scan, the others = that stage was done",
        dict,
        always=True,
    )
    time_ns: int = wire(Int(0, unit="ns"), "`sample` since 1970, by CLOCK_REALTIME; 0: not known", 0)
    sample_sigma_ns: int = wire(Int(0, unit="ns"), "standard uncertainty of `sample`", 0, always=True)
    source: str = wire(Text(choices=SOURCES), "where the measurements come from", "board", always=True)
    valid: bool = wire(Bool(), "whether the payload may be acted on; false where missing", False)
    reasons: list[str] = wire(ListOf(Text(64), 64), "why it is not valid, or what to know although it is", list)
    valid_for_s: float = wire(
        Float(0, unit="s"), "how long after `sample` the frame may be acted on (a replayed one: after `read`)", 0.0
    )


AFTER = "of a scan in parts: scan of the delta frame before it, also where that was skipped; 0: not known"


@dataclass(slots=True, kw_only=True, eq=False)
class EstimatedTouch:
    """One touch at `sample`, as the measurements tell it: a disc of as much area and action."""

    id: int = wire(_COUNT, "stays the same while the touch lasts; unique in a session of preprocessing")
    began: bool = wire(Bool(), "seen to begin; false: it may have been there for long", True)
    age_s: float = wire(Float(unit="s"), "since it was first seen", 0.0)
    position: list[float] = wire(Vector(2, "m"), "x, y on the sheet")
    velocity: list[float] = wire(Vector(2, "m/s"), "of `position`; 0 where it is steady", lambda: [0.0, 0.0])
    sigma: list[float] = wire(Vector(3), "as a contact's `position_sigma`")
    radius_m: float = wire(Float(0, unit="m"), "of the disc")
    radius_sigma: float = wire(Float(0), "standard uncertainty of the radius's logarithm")
    drop: float = wire(Float(0, unit="S/m"), "conductivity drop, mean over the disc")
    drop_sigma: float = wire(Float(0, unit="S/m"), "its standard uncertainty")
    strength: float = wire(
        Float(0, unit="S/m m^2"), "drop / (1 - drop / 2) summed over the touch: what the measurements tell best"
    )
    strength_sigma: float = wire(Float(0, unit="S/m m^2"), "its standard uncertainty")
    z2: float = wire(Float(0), "how much it explains: squared sigmas of its strength", 0.0)
    unexplained: float = wire(Float(0), "share of the measured change that is left", 0.0)


@dataclass(slots=True, kw_only=True, eq=False)
class RawFrame(Frame):
    """One scan of the board, in the pattern's order. Of a scan in parts: the newest value of each measurement, after
    each part; `sample` is the middle of the newest one.
    """

    same_length: ClassVar[tuple[str, ...]] = ("z", "status")

    z: NDArray[np.complex64] = wire(Array("<c8", ("K",)), "impedance (or raw quotient) of each measurement")
    status: NDArray[np.uint8] = wire(
        Array("|u1", ("K",)), "bits: 1 converter clipped, 2 current out of range, 4 RTIA overrange, 8 FIFO or missed"
    )
    device_us: int = wire(Int(0, UINT64_MAX, "us"), "board's clock at the start of the scan", 0)
    config: int = wire(Int(0, 65535), "board's configuration that was scanned", 0)
    kind: str = wire(
        Text(choices=("full", "sentinel", "reference")),
        "whole pattern; a short list (in old recordings only); or, from imported files only, a scan known to be "
        "untouched",
        "full",
    )
    board: str = wire(Text(64), "unique id of the board", "")
    pattern: str = wire(_NAME, "name of the drive pattern", "pairs")
    unit: str = wire(Text(choices=("ohm", "counts")), "unit of z", "ohm")
    parts: int = wire(Int(1, 10), "in how many parts the board measures a scan", 1)
    age_us: NDArray[np.float32] = wire(
        Array("<f4", ("K",), "us", or_empty=True),
        "by how much each value is older than the end of the newest; empty: measured in the pattern's order",
        _empty("<f4", 1),
    )
    new: NDArray[np.uint8] = wire(
        Array("|u1", ("K",), or_empty=True), "1: measured in the newest part; empty: all are new", _empty("|u1", 1)
    )


@dataclass(slots=True, kw_only=True, eq=False)
class DeltaFrame(Frame):
    """One scan against the baseline, prepared for the network."""

    same_length: ClassVar[tuple[str, ...]] = ("difference", "sigma")

    touched: bool = wire(Bool(), "whether anything touches", False, always=True)
    held: bool = wire(Bool(), "nothing changed since the frame last reconstructed", False)
    reconstructed: int = wire(_COUNT, "scan of the frame last reconstructed in this touch; 0 while untouched", 0)
    score: float = wire(Float(), "noise-whitened statistic that `touched` was decided by", 0.0)
    threshold: float = wire(Float(), "what `score` is compared with", 0.0)
    difference: NDArray[np.float32] = wire(
        Array("<f4", ("K",)), "|Z|/|Z0| - 1; 0 where `sigma` is infinite", _empty("<f4", 1)
    )
    sigma: NDArray[np.float32] = wire(
        Array("<f4", ("K",), gaps=True), "standard uncertainty of `difference`; infinite: not used", _empty("<f4", 1)
    )
    averaged: int = wire(
        _COUNT, "scans that `difference` is the mean of, to be reconstructed; 0: no reconstruction is needed", 0
    )
    tare_frames: int = wire(_COUNT, "scans that the baseline is the mean of; 0: there is none", 0)
    electrodes: NDArray[np.uint8] = wire(
        Array("|u1", ("E",)),
        "state of each electrode: " + ", ".join(f"{k} {state}" for k, state in enumerate(ELECTRODE_STATES)),
        lambda: np.zeros(16, "u1"),
    )
    calibration: str = wire(
        Text(64, form="(?:[0-9a-f]{64})?"), "hash of the bundle as it was calibrated to this skin; empty: as it is", ""
    )
    after: int = wire(_COUNT, AFTER, 0)
    estimates: list[EstimatedTouch] = wire(
        ListOf(Record(EstimatedTouch), 16), "the touches at `sample`, as the measurements tell them", list
    )


@dataclass(slots=True, kw_only=True, eq=False)
class StackFrame(Frame):
    """The pre-reconstruction of a delta frame, formed of its `difference` and `sigma`: what a network reads."""

    reconstructed: int = wire(_COUNT, "scan that it was made of", 0)
    stack: NDArray[np.float32] = wire(
        Array("<f4", ("C", "h", "w")), "images [iy, ix], one for each lambda, row 0 lowest y", _empty("<f4", 3)
    )
    context: NDArray[np.float32] = wire(
        Array("<f4", ("n",)), "what the network is told beside them (noise level, ...)", _empty("<f4", 1)
    )
    scale: float = wire(Float(unit="S/m"), "the network's output times this is in S/m", 1.0)


@dataclass(slots=True, kw_only=True, eq=False)
class PartFrame(Frame):
    """What the newest part of a scan says between two delta frames, which say all else: the touches by now."""

    after: int = wire(_COUNT, "scan of the delta frame before it: the image of that scan shows these touches", 0)
    estimates: list[EstimatedTouch] = wire(
        ListOf(Record(EstimatedTouch), 16), "the touches at `sample`, as the measurements tell them", list
    )


@dataclass(slots=True, kw_only=True, eq=False)
class LocatedTouch:
    """One touch as a registered skin's response map finds it."""

    position: list[float] = wire(Vector(2, "m"), "x, y in the skin's frame")
    sigma: list[float] = wire(Vector(3), "as a contact's `position_sigma`")
    amplitude: float = wire(Float(0), "beside the registration's mean press", 1.0)
    indentation_m: float | None = wire(Maybe(Float(0, unit="m")), "as a contact's, or nil", None)
    force_n: float | None = wire(Maybe(Float(0, unit="N")), "how hard, where the skin was registered with forces", None)
    value_sigma: float | None = wire(Maybe(Float(0)), "standard uncertainty of depth or force, or nil", None)


@dataclass(slots=True, kw_only=True, eq=False)
class ImageFrame(Frame):
    """The conductivity drop over the skin's bounding box. A held frame's image was sent before: see the rules for
    readers.
    """

    touched: bool = wire(Bool(), "whether anything touches", False, always=True)
    held: bool = wire(Bool(), "the image is that of an earlier frame: nothing changed since", False)
    reconstructed: int = wire(_COUNT, "scan that the image was reconstructed from; 0 where there is none", 0)
    image: NDArray[np.float32] = wire(
        Array("<f4", ("H", "W"), "S/m", or_empty=True),
        "conductivity drop [iy, ix], positive where touched, row 0 lowest y; empty while untouched or held",
        _empty("<f4", 2),
    )
    sigma: NDArray[np.float32] = wire(
        Array("<f4", ("H", "W"), "S/m", or_empty=True), "its standard uncertainty, or empty", _empty("<f4", 2)
    )
    classes: NDArray[np.float32] = wire(
        Array("<f4", (len(SHAPES), "h", "w"), or_empty=True),
        "probability of " + ", ".join(SHAPES) + ", on a coarser grid over the same box; or empty",
        _empty("<f4", 3),
    )
    metres_per_pixel: float = wire(Float(0, unit="m"), "side of a pixel of `image`", 0.0)
    origin: list[float] = wire(Vector(2, "m"), "x, y of the image's lower left corner", lambda: [0.0, 0.0])
    residual: float | None = wire(
        Maybe(Float(0)), "share of the measured change that the image does not explain, or nil", None
    )
    noise: float | None = wire(
        Maybe(Float(0)), "rms `sigma` of the delta frame that the image was made of (relative), or nil", None
    )
    touches: list[LocatedTouch] = wire(
        ListOf(Record(LocatedTouch), 16), "of a registered skin: where its touches are, sent with the image", list
    )
    after: int = wire(_COUNT, AFTER, 0)
    estimates: list[EstimatedTouch] = wire(
        ListOf(Record(EstimatedTouch), 16), "the touches at `sample`, as the measurements tell them", list
    )


@dataclass(slots=True, kw_only=True, eq=False)
class Contact:
    """One touch."""

    id: int = wire(_COUNT, "stays the same while the touch lasts; unique in a session")
    state: str = wire(
        Text(choices=("begin", "hold", "end")),
        "first frame of the touch; in between, or not known to be the first; last one. Of a scan in parts `begin` and "
        "`end` stay for 50 ms",
        "hold",
    )
    position: list[float] = wire(Vector(3, "m"), "centroid of the contact patch, in the frame `frame_id`")
    velocity: list[float] = wire(Vector(3, "m/s"), "of `position`", lambda: [0.0] * 3)
    normal: list[float] = wire(Vector(3), "unit vector out of the skin", lambda: [0.0, 0.0, 1.0])
    orientation: float = wire(Float(unit="rad"), "angle of the patch's longest axis to x, -pi/2 to pi/2", 0.0)
    area_m2: float = wire(Float(0, unit="m^2"), "area of the contact patch", 0.0)
    force_n: float | None = wire(Maybe(Float(unit="N")), "normal force; nil where the skin has no force law", None)
    force_sigma_n: float | None = wire(Maybe(Float(0, unit="N")), "its standard uncertainty, or nil", None)
    wrench: list[float] = wire(
        Vector(6), "Fx, Fy, Fz [N], Tx, Ty, Tz [N m] on the skin, at its frame's origin", lambda: [0.0] * 6
    )
    shape: str = wire(Text(32), "most probable of " + ", ".join(SHAPES) + "; or unknown", "unknown")
    shape_probability: float | None = wire(Maybe(Float(0, 1)), "of `shape`, or nil", None)
    confidence: float = wire(Float(0, 1), "probability that this is a touch", 1.0)
    position_sigma: list[float] | None = wire(
        Maybe(Vector(3)),
        "standard uncertainty of `position` along the longest and the shortest axis of its ellipse [m], angle of the "
        "longest to x [rad]; nil where nobody measured it; 2.15 times the axes hold 90 %",
        None,
    )
    indentation_m: float | None = wire(
        Maybe(Float(0, unit="m")), "how deep the touch presses; nil where the skin was not registered with depths", None
    )
    indentation_sigma_m: float | None = wire(Maybe(Float(0, unit="m")), "its standard uncertainty, or nil", None)
    pressure_pa: float | None = wire(
        Maybe(Float(0, unit="Pa")),
        "pressure on the skin where it is highest in the patch; nil where nobody knows; of a force that is "
        "`extrapolated` because the foam gives way no more, a lower bound, as `force_n` is",
        None,
    )
    pressure_sigma_pa: float | None = wire(Maybe(Float(0, unit="Pa")), "its standard uncertainty, or nil", None)
    sheet: list[float] | None = wire(
        Maybe(Vector(2, "m")), "x, y on the unrolled sheet, as images have it; nil: those of `position`", None
    )

    @property
    def on_sheet(self) -> tuple[float, float]:
        """x, y [m] on the sheet, as images and the stub's truth have it, whatever the skin is wrapped round."""
        x, y = self.position[:2] if self.sheet is None else self.sheet
        return x, y


@dataclass(slots=True, kw_only=True, eq=False)
class ContactFrame(Frame):
    """All touches: published at the board's full-scan rate also when there is none, so that silence means fault. Of a
    scan in parts more often while something touches; `rate_hz` in info says how often.
    """

    held: bool = wire(Bool(), "the contacts are those of an earlier frame: nothing changed since", False)
    frame_id: str = wire(Text(128), "name of the coordinate frame of positions and wrenches", "")
    force_calibrated: bool = wire(Bool(), "whether forces come from a calibration of this skin", False)
    quality: float | None = wire(
        Maybe(Float(0, 1)), "share of the measured change that the image explains; nil while untouched", None
    )
    contacts: list[Contact] = wire(ListOf(Record(Contact), 256), "the touches, strongest first", list, always=True)


@dataclass(slots=True, kw_only=True, eq=False)
class ForceFrame(Frame):
    """The total load alone: small, for fast loops."""

    wrench: list[float] = wire(
        Vector(6), "Fx, Fy, Fz [N], Tx, Ty, Tz [N m] on the skin, at its frame's origin", lambda: [0.0] * 6, always=True
    )
    force_n: float | None = wire(Maybe(Float(unit="N")), "sum of the normal forces, or nil", None)
    force_sigma_n: float | None = wire(Maybe(Float(0, unit="N")), "its standard uncertainty, or nil", None)


@dataclass(slots=True, kw_only=True, eq=False)
class ShapeFrame(Frame):
    """What the touches look like; one entry per contact in each list, in the same order."""

    same_length: ClassVar[tuple[str, ...]] = ("ids", "outlines", "orientation", "probabilities")

    ids: list[int] = wire(ListOf(_COUNT, 256), "`id` of the contact", list)
    outlines: list[list[list[float]]] = wire(
        ListOf(ListOf(Vector(2, "m"), 4096), 256), "its outline, a closed polygon of (x, y), counter-clockwise", list
    )
    orientation: list[float] = wire(ListOf(Float(unit="rad"), 256), "angle of its longest axis to x", list)
    probabilities: list[list[float]] = wire(
        ListOf(Vector(len(SHAPES)), 256), "probability of " + ", ".join(SHAPES), list
    )


VERDICTS = ("pass", "note", "refuse", "not asked", "cannot")
"""What a judgement may say: nothing is wrong; to know, the frame may be acted on; it may not; an earlier one decided;
this skin or board has no means to tell.
"""


@dataclass(slots=True, kw_only=True, eq=False)
class JudgementsFrame(Frame):
    """Why the delta or part frame of this scan says what it says: every decision on the way to it, one entry per
    decision in each list, in the same order. `valid` and `reasons` are that frame's. Of a part of a scan also where it
    made no part frame, because nothing touches.
    """

    same_length: ClassVar[tuple[str, ...]] = ("names", "statistics", "expected", "ratios", "verdicts", "where")

    names: list[str] = wire(ListOf(Text(64), 256), "what was asked, in few letters: `open`, `gap`, `touch`, ...", list)
    statistics: list[float] = wire(ListOf(Float(), 256), "what was found, in the unit of `expected`", list)
    expected: list[float] = wire(ListOf(Float(), 256), "its limit where nothing is wrong", list)
    ratios: list[float] = wire(ListOf(Float(), 256), "statistic / expected; the verdict turns at 1", list)
    verdicts: list[str] = wire(ListOf(Text(choices=VERDICTS), 256), "what follows for the frame", list)
    where: list[int] = wire(ListOf(Int(-1), 256), "electrode or touch that it is about; -1: the scan", list)


@dataclass(slots=True, kw_only=True, eq=False)
class StatusFrame(Frame):
    """How a process is: once a second, and at once when something changes."""

    process: str = wire(_NAME, "who says so")
    level: str = wire(Text(choices=("OK", "WARN", "ERROR", "STALE")), "in one word", "STALE")
    messages: list[str] = wire(ListOf(Text(1024), 64), "what is the matter and what to do about it", list)
    rates: dict[str, float] = wire(MapOf(Float(0, unit="Hz")), "frames per second, by topic", dict)
    drops: dict[str, int] = wire(MapOf(_COUNT), "frames lost or skipped since the start, by cause", dict)
    counters: dict[str, int] = wire(MapOf(_COUNT), "other counts since the start", dict)
    latency: dict[str, float] = wire(
        MapOf(Float(), ("p50", "p99")), "milliseconds (not s) from `sample` to this process's output", dict
    )
    cpu: float = wire(Float(0), "share of one core used since the last status", 0.0)


INFO_KEYS = {
    "bundle": "name of the model bundle",
    "bundle_hash": "sha256 over the whole of it, as its file SHA256 says",
    "geometry": "map: outline (n, 2) [m], electrodes (E, 2) [m], metres_per_unit, name",
    "pattern": "name of the drive pattern",
    "stack": "map: lambda_squared of each plane of `stack`; one_step: the plane whose lambda is nearest that "
    "of the published one-step image",
    "frame_id": "name of the skin's coordinate frame",
    "parent_frame_id": "name of the frame that `pose` is given in",
    "pose": "x, y, z [m], qx, qy, qz, qw: the skin's frame in its parent",
    "surface": "map: kind (cylinder), radius_m, axis_degrees: what the sheet is wrapped round; or nil: it lies flat",
    "units": "map: name of a field -> its unit",
    "rate_hz": "map: least, the rate at which contact and force frames come also while nothing touches: fewer are a "
    'fault; touched, the rate that they reach while a touch is followed (`scan = "rolling"`: with every part); or nil: '
    "not yet known",
    "force_law": "map: kind and parameters of the force law, or nil",
    "symmetry": "whether the image of a held touch becomes the mean over the skin's symmetries (`touch` in skin.toml): "
    "on, or why not",
    "mounting": "map: what the calibration to this very skin found (contacts, shifts, field, anisotropy, remarks); "
    "missing where the bundle is used as it is. `bundle_hash` covers it",
    "calibration_hash": "sha256 of the calibration file, or nil",
    "baseline": "array (K,): |Z0| as frames are compared with it; sent again when drift moved it by 2e-4, at most "
    "every 5 s",
    "baseline_sigma": "array (K,): standard deviation of the frames that the baseline was taken from",
    "baseline_hash": "sha256 of the bytes of `baseline` and `baseline_sigma`",
    "baseline_revision": "counts up whenever another baseline is used, or drift moves it; of this `baseline`",
    "tare_sample_ns": "stamp `sample` of the newest frame of the tare, or what it would be by this host's clock",
    "tare_age_s": "seconds since the tare when this frame was made",
    "tare": "map: taken_by (start, command, file), restored (by a later process), frames, board, bundle_hash, doubt",
    "state": "map: the stages' temporal state, for lossless replay",
}
"""Keys in use in InfoFrame.info; a process leaves out what it does not know and may add others."""


@dataclass(slots=True, kw_only=True, eq=False)
class InfoFrame(Frame):
    """What changes rarely: given to each new subscriber."""

    process: str = wire(_NAME, "who says so", "preprocessing")
    info: dict[str, Any] = wire(MapOf(Tree(), tuple(INFO_KEYS), 1024), "see the keys below", dict)


@dataclass(slots=True, kw_only=True, eq=False)
class TrueTouch:
    """What the stub's skin is really touched by."""

    shape: str = wire(Text(32), "kind: circle, triangle, rectangle, square, L, ellipse, hertz")
    x: float = wire(Float(unit="m"), "centre, in the skin's frame")
    y: float = wire(Float(unit="m"), "centre, in the skin's frame")
    radius_m: float = wire(Float(0, unit="m"), "circumscribed radius")
    rotation: float = wire(Float(unit="rad"), "counter-clockwise", 0.0)
    aspect: float = wire(Float(0), "ratio of a rectangle's sides or an ellipse's axes", 1.0)
    drop: float = wire(Float(unit="S/m"), "conductivity drop inside")
    force_n: float | None = wire(Maybe(Float(unit="N")), "force that belongs to the drop, or nil", None)
    outline: list[list[float]] | None = wire(
        Maybe(ListOf(Vector(2, "m"), 4096)), "closed polygon of (x, y), or nil", None
    )


@dataclass(slots=True, kw_only=True, eq=False)
class TruthFrame(Frame):
    """What really touches at the middle of the scan; only a stub knows. `publish`: the scan's last byte had left."""

    touches: list[TrueTouch] = wire(ListOf(Record(TrueTouch), 256), "the touches", list, always=True)


@dataclass(slots=True, kw_only=True, eq=False)
class ReferenceFrame(Frame):
    """The force on the skin by an arm's force-torque sensor or a scale. `sample`: when that measured it, as well as its
    reader knows; a constant delay is found. `source` is `board`. `valid` false: not to be used (saturated, starting).
    """

    force_n: float = wire(
        Float(unit="N"), "normal force of all that touches the skin, above 0 where it presses; any constant offset"
    )
