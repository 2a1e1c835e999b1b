"""Sends frames through the runtime's own stages and compares each answer with the truth and with the promise.

The promise, whatever comes in: no exception, no NaN or infinity out, never `valid` on garbage. A `valid` frame is
garbage where its strongest contact lies further than FAR_M from the touch, or where nothing real touches at all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import metrics
from models.bundle import Bundle
from models.forward import ForwardModel, shared
from models.shapes import Array, Shape
from protocol.frames import Contact, FrameError, RawFrame, pack, unpack
from services.estimation.first.baseline import Baseline, take
from services.pipeline import Pipeline, Result
from services.runtime.config import ScanMode, Skin

Row = dict[str, Any]

SKIN = "square16"
TARE_FRAMES = 64
NOISE_FREE = 1e-6  # relative: what a float32 wire leaves
METRES = 0.05  # per model unit
FAR_M = 0.010  # a tenth of the side
FRAME_NS = 45_000_000  # the board's full scan

TOUCHES = (
    Shape("circle", 0.0, 0.0, 0.2, 0.15),
    Shape("circle", 0.4, 0.3, 0.25, 0.3),
    Shape("square", -0.5, 0.45, 0.3, 0.4, 0.5),
    Shape("L", -0.3, -0.4, 0.4, 0.3, 0.4),
    Shape("triangle", 0.35, -0.5, 0.35, 0.35, 0.9),
    Shape("rectangle", -0.1, 0.5, 0.35, 0.25, 0.6, 2.0),
    Shape("circle", 0.7, -0.65, 0.2, 0.5),
    Shape("circle", -0.7, 0.05, 0.15, 0.2),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """One touch with its noise-free |Z| (K,) and that of the same skin untouched [ohm]."""

    touch: Shape
    z: Array
    z0: Array


def solved(
    model: ForwardModel,
    touches: Sequence[Shape] = TOUCHES,
    background: float = 1.0,
    contact_impedance: ArrayLike | None = None,
) -> list[Scene]:
    """The touches, one by one, on this model's mesh."""
    z0 = np.abs(model.solve(background, contact_impedance).impedances())
    return [
        Scene(t, np.abs(model.solve(model.touched([t], background), contact_impedance).impedances()), z0)
        for t in touches
    ]


@dataclass(frozen=True, eq=False)
class Setting:
    """What every part of the report is run with."""

    bundle: Bundle
    quick: bool
    seed: int
    scan: ScanMode = "full"  # of a board at the end of a line; stages are given whole scans

    def model(self, mesh: str = "stub") -> ForwardModel:
        """ "stub": as far from the mesh of training and inverse as a real skin is allowed to be."""
        return shared(SKIN, mesh)

    def scenes(self) -> list[Scene]:
        if not _SOLVED:
            _SOLVED.extend(solved(self.model()))
        return list(_SOLVED)

    def rng(self, *names: str) -> np.random.Generator:
        """Each part draws its own numbers: one more row in one of them changes no other."""
        return np.random.default_rng([self.seed, *"".join(names).encode()])


_SOLVED: list[Scene] = []  # of the stub's mesh: solving them takes seconds, once a process


def share(decibel: float) -> float:
    """Relative noise of so many dB; infinite dB are noise-free."""
    return max(10 ** (-decibel / 20), NOISE_FREE)


def noisy(z: Array, relative: float | Array, rng: np.random.Generator, n: int | None = None) -> Array:
    """|Z| with noise relative to each (one share, or K of them); n: (n, K) frames."""
    return np.asarray(z * (1 + relative * rng.standard_normal(z.shape if n is None else (n, *z.shape))))


@dataclass
class Answer:
    """What the stages made of one frame. broken: how it broke the promise."""

    valid: bool = False
    touched: bool = False
    contacts: list[Contact] = field(default_factory=list)  # those that did not end, strongest first
    image: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    reasons: tuple[str, ...] = ()
    broken: list[str] = field(default_factory=list)

    def place(self) -> Array | None:
        """(2,) of the strongest contact [m]."""
        return np.array(self.contacts[0].position[:2]) if self.contacts else None

    def force(self) -> float | None:
        return self.contacts[0].force_n if self.contacts else None


class InProcessStages:
    """The stages of one skin, in this process."""

    def __init__(self, bundle: Bundle, network: str = "full") -> None:
        skin = Skin.model_validate({"port": "stub", "bundle": str(bundle.path), "network": network})
        self.pipeline = Pipeline(skin, bundle=bundle)
        self.scan = 0

    def tare(self, z0: Array, relative: float | Array, rng: np.random.Generator) -> Baseline:
        """The baseline of TARE_FRAMES frames of the untouched skin. Raises NoBaseline."""
        return take(noisy(z0, relative, rng, TARE_FRAMES), self.pipeline.pre.pre, "bench", 0)

    def begin(self, baseline: Baseline | None) -> None:
        """Forget everything; this baseline from now on, or none."""
        self.pipeline.reset()
        if baseline is not None:
            copied = Baseline(**{**baseline.to_dict(), "z0": baseline.z0.copy()})  # it is followed in place
            self.pipeline.pre.set_baseline(copied)

    def see(self, z: NDArray[Any], status: NDArray[np.uint8] | None = None) -> Answer:
        """One frame of complex or real Z (K,) through all stages."""
        self.scan += 1
        with np.errstate(all="ignore"):
            wire = np.asarray(z).astype(np.complex64)
        raw = RawFrame(
            skin="skin",
            scan=self.scan,
            z=wire,
            status=np.zeros(len(z), np.uint8) if status is None else status,
            stamps={"sample": self.scan * FRAME_NS},
            source="board",
            valid=True,
            valid_for_s=0.1,
            board="bench",
        )
        try:
            with np.errstate(all="ignore"):
                result = self.pipeline.run(raw)
        except Exception as error:  # the promise is that there is none
            return Answer(broken=[f"crash: {type(error).__name__}: {error}"])
        contact = result.contact
        present = [c for c in contact.contacts if c.state != "end"]
        broken = not_finite(result)
        return Answer(contact.valid, result.delta.touched, present, result.image.image, tuple(contact.reasons), broken)

    def once(self, baseline: Baseline, z: NDArray[Any], status: NDArray[np.uint8] | None = None) -> Answer:
        """Answer one frame by itself, without memory of the one before."""
        self.begin(baseline)
        return self.see(z, status)


def not_finite(result: Result) -> list[str]:
    """Where NaN or infinity left a stage, and frames that the wire would not take."""
    found = []
    for name, array in (
        ("delta.difference", result.delta.difference),
        ("delta.score", np.array([result.delta.score, result.delta.threshold])),
        ("image.image", result.image.image),
        ("image.sigma", result.image.sigma),
        ("image.classes", result.image.classes),
    ):
        if not np.isfinite(array).all():
            found.append(f"not finite: {name}")
    if np.isnan(result.delta.sigma).any():
        found.append("not a number: delta.sigma")  # infinity says that a measurement is not used
    try:
        read = unpack(pack(result.contact))
    except (FrameError, ValueError, TypeError) as error:
        return [*found, f"no contact frame: {error}"]
    if "non_finite" in read.reasons and "non_finite" not in result.contact.reasons:
        found.append("not finite: contact")
    return found


def off(answer: Answer, touch: Shape) -> float | None:
    """Metres between the strongest contact and the touch's centroid."""
    place = answer.place()
    return None if place is None else float(np.hypot(*(place - METRES * touch.centroid)))


def judged(answer: Answer, touch: Shape | None) -> list[str]:
    """How this answer broke the promise. touch None: nothing real was measured."""
    if not answer.valid:
        return answer.broken
    if touch is None:
        return [*answer.broken, "valid on garbage" + (", with contacts" if answer.contacts else "")]
    distance = off(answer, touch)
    return [
        *answer.broken,
        *(["valid contact far from the touch"] if distance is not None and distance > FAR_M else []),
    ]


def summary(answers: Iterable[tuple[Answer, Shape | None]], doubtful: bool = False) -> Row:
    """Errors over the valid frames with a contact (doubtful: also over others), shares over all, and every way the
    promise was broken.
    """
    pairs = list(answers)
    broken: Counter[str] = Counter()
    position, force, overlap = [], [], []
    missed = 0
    for answer, touch in pairs:
        broken.update(judged(answer, touch))
        if touch is None or not (answer.valid or doubtful):
            continue
        distance, newtons = off(answer, touch), answer.force()
        if distance is None:
            missed += 1
            continue
        position.append(100 * distance / (METRES * metrics.SIDE))
        if newtons is not None:
            force.append(float(metrics.relative_error(newtons, touch.force(METRES))))
        if answer.image.size:
            overlap.append(mean_iou(answer.image, touch))
    return {
        "frames": len(pairs),
        "valid_%": 100 * float(np.mean([a.valid for a, _ in pairs])) if pairs else None,
        "missed": missed,
        "position_%": _mean(position),
        "position_max_%": max(position, default=None),
        "force_%": _mean(force),
        "mean_iou": _mean(overlap),
        "broken": dict(broken),
    }


def mean_iou(image: NDArray[np.floating], touch: Shape) -> float:
    mask = metrics.touch_masks(np.asarray(image, float), [touch])[0]
    return metrics.iou(mask, touch.fraction(len(image), covered=True) > 0.5)[0]


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
