"""What a broken board may send: NaN and infinity, dead electrodes, clipped converters, noise without a skin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from bench.stability.run import Answer, InProcessStages, Row, Setting, judged, noisy, share, summary
from models.shapes import Array, Shape
from protocol.frames import STATUS_CLIPPED, STATUS_OPEN
from services.estimation.first.baseline import Baseline, NoBaseline, take

USUAL_DB = 70.0
COUNTS = (1, 2, 3, 5, 10, 20, 40, 59, 60, 61, 90, 119, 120)
FEW = (1, 10, 60, 120)
NOT_NUMBERS = {
    "NaN": complex(np.nan, np.nan),
    "infinity": complex(np.inf, 0.0),
    "minus infinity": complex(-np.inf, np.nan),
}
ODD_NUMBERS = {
    "zero": complex(0.0, 0.0),
    "minus zero": complex(-0.0, -0.0),
    "denormal": complex(1e-41, -1e-42),
    "smallest normal": complex(1.2e-38, 0.0),
    "tiny": complex(1e-20, 0.0),
    "huge": complex(1e20, 0.0),
    "largest float": complex(3.4e38, 3.4e38),
}
RANDOM = {"quick": 400, "full": 10_000}
ELECTRODES = 16
STRAY_OHM = 1e6  # an open input: next to no current


def replaced(values: dict[str, complex]) -> Callable[[Setting], Iterator[Row]]:
    """A part: some channels of a touched frame hold such a value."""

    def part(setting: Setting) -> Iterator[Row]:
        runner, rng, scenes = InProcessStages(setting.bundle), setting.rng("channels"), setting.scenes()
        baseline = runner.tare(scenes[0].z0, share(USUAL_DB), rng)
        for name, value in values.items():
            for count in COUNTS if not setting.quick else FEW:
                found: list[tuple[Answer, Shape | None]] = []
                for scene in scenes[:2] if setting.quick else scenes:
                    z = noisy(scene.z, share(USUAL_DB), rng).astype(complex)
                    z[rng.permutation(len(z))[:count]] = value
                    found.append((runner.once(baseline, z), scene.touch if count < len(z) else None))
                yield {"case": f"{name} in {count}", "value": count, "kind": name, **summary(found)}

    return part


def dead(setting: Setting) -> Iterator[Row]:
    """Electrodes without contact: the board flags them, sends NaN, or measures next to no current unflagged."""
    runner, rng, scenes = InProcessStages(setting.bundle), setting.rng("dead"), setting.scenes()
    baseline = runner.tare(scenes[0].z0, share(USUAL_DB), rng)
    pattern = np.asarray(setting.bundle.pattern)
    for kind in ("flagged", "NaN", "unflagged"):
        for count in range(1, ELECTRODES) if not setting.quick else (1, 2, 3, 8, 15):
            found: list[tuple[Answer, Shape | None]] = []
            for scene in scenes[1:4] if setting.quick else scenes * 3:
                lost = np.isin(pattern, rng.permutation(ELECTRODES)[:count]).any(axis=1)
                z, status = noisy(scene.z, share(USUAL_DB), rng), np.zeros(len(scene.z), np.uint8)
                z[lost] = np.nan if kind == "NaN" else STRAY_OHM * rng.uniform(0.5, 2, int(lost.sum()))
                if kind == "flagged":
                    status[lost] = STATUS_OPEN
                found.append((runner.once(baseline, z, status), scene.touch if not lost.all() else None))
            yield {"case": f"{count} {kind}", "value": count, "kind": kind, **summary(found)}


def saturated(setting: Setting) -> Iterator[Row]:
    """Clipped channels: a plausible |Z|, too low, with the converter's flag and without."""
    runner, rng, scenes = InProcessStages(setting.bundle), setting.rng("saturated"), setting.scenes()
    baseline = runner.tare(scenes[0].z0, share(USUAL_DB), rng)
    for kind in ("flagged", "unflagged"):
        for count in COUNTS if not setting.quick else FEW:
            found: list[tuple[Answer, Shape | None]] = []
            for scene in scenes[1:4] if setting.quick else scenes * 2:
                z, status = noisy(scene.z, share(USUAL_DB), rng), np.zeros(len(scene.z), np.uint8)
                largest = np.argsort(-z)[:count]  # those that a converter clips first
                z[largest] = z[largest].min() * rng.uniform(0.6, 0.95)
                if kind == "flagged":
                    status[largest] = STATUS_CLIPPED
                found.append((runner.once(baseline, z, status), scene.touch if count < len(z) else None))
            yield {"case": f"{count} {kind}", "value": count, "kind": kind, **summary(found)}


def constant(setting: Setting) -> Iterator[Row]:
    """Frames that are all alike, no difference at all, and references of zero."""
    runner, rng, scenes = InProcessStages(setting.bundle), setting.rng("constant"), setting.scenes()
    z0, touched = scenes[0].z0, scenes[1]
    baseline = runner.tare(z0, share(USUAL_DB), rng)
    nothing = [(runner.once(baseline, baseline.z0), None) for _ in range(1)]
    yield {"case": "no difference at all", **_untouched([a for a, _ in nothing])}
    yield {"case": "the same frame from the start", **_stream(runner, np.tile(z0, (200, 1)), None)}
    for name, value in (("ones", 1.0), ("zeros", 0.0), ("NaN", np.nan), ("denormals", 1e-41)):
        flat = np.full((200, len(z0)), value)
        yield {"case": f"all {name} from the start", **_stream(runner, flat, None)}
    same = np.vstack([np.tile(z0, (80, 1)), np.tile(touched.z, (20, 1))])
    yield {"case": "equal tare, then equal touched frames", **_stream(runner, same, touched.touch, last=20)}
    for count in (1, 15, 59, 61, 119, 120):
        lost = rng.permutation(len(z0))[:count]
        zeroed, sigma = baseline.z0.copy(), baseline.sigma.copy()
        zeroed[lost] = 0.0
        saved = Baseline(zeroed, sigma, baseline.frames, "bench", 0).to_dict()
        try:
            answer = runner.once(Baseline.from_dict(saved, len(z0)), noisy(touched.z, share(USUAL_DB), rng))
        except NoBaseline:  # as a process would find it at start
            answer = Answer()
        truth = touched.touch if count < len(z0) else None
        yield {"case": f"reference zero in {count}", "value": count, **summary([(answer, truth)])}


def random_frames(setting: Setting) -> Iterator[Row]:
    """Frames that no skin made, each on its own against a good tare; as a stream; as a tare; and what comes after."""
    runner, rng, scenes = InProcessStages(setting.bundle), setting.rng("random"), setting.scenes()
    z0 = scenes[0].z0
    baseline = runner.tare(z0, share(USUAL_DB), rng)
    n = RANDOM["quick" if setting.quick else "full"]
    for name, draw in FAMILIES.items():
        answers = [(runner.once(baseline, *draw(z0, rng)), None) for _ in range(n // len(FAMILIES))]
        yield {"case": name, "value": len(answers), **summary(answers)}
    runner.begin(baseline)
    broken: Counter[str] = Counter()
    valid = 0
    families = list(FAMILIES.values())
    for _ in range(n // 10):
        answer = runner.see(*families[rng.integers(len(families))](z0, rng))
        broken.update(judged(answer, None))
        valid += answer.valid
    yield {"case": "all kinds in one stream", "frames": n // 10, "valid_%": 1000 * valid / n, "broken": dict(broken)}
    after = [runner.see(noisy(z0, share(USUAL_DB), rng)) for _ in range(200)]
    after += [runner.see(noisy(scenes[1].z, share(USUAL_DB), rng)) for _ in range(20)]
    well = summary([(a, scenes[1].touch) for a in after[-20:]])
    if not after[-1].valid or not after[-1].contacts:
        well["broken"]["not well again after 200 good frames"] = 1
    yield {"case": "a touch, 200 good frames later", **well}
    yield {"case": "random tares", **_random_tares(runner, z0, rng, max(2 * len(FAMILIES), n // 400))}


def _random_tares(runner: InProcessStages, z0: Array, rng: np.random.Generator, n: int) -> Row:
    """Tares of frames that no skin made: refused, or in doubt, or at least nothing valid against them."""
    answers: list[tuple[Answer, Shape | None]] = []
    families = [draw for name, draw in FAMILIES.items() if name != GAIN]  # another gain is another skin, and a good one
    for k in range(n):
        draw = families[k % len(families)]
        with np.errstate(all="ignore"):
            z, status = draw(z0, rng)
            frames = np.abs(z) * (1 + 1e-4 * rng.standard_normal((64, len(z0))))
        try:
            with np.errstate(all="ignore"):
                baseline = take(frames, runner.pipeline.pre.pre, "bench", 0)
            answers.append((runner.once(baseline, frames[0], status), None))
        except NoBaseline:
            answers.append((Answer(), None))
        except Exception as error:  # the promise is that there is none
            answers.append((Answer(broken=[f"crash: {type(error).__name__}: {error}"]), None))
    return summary(answers)


def _stream(runner: InProcessStages, frames: Array, touch: Shape | None, last: int = 0) -> Row:
    """A cold start on these frames; errors of the last ones, crashes of all."""
    runner.begin(None)
    answers = [runner.see(z) for z in frames]
    if touch is not None:
        row = summary([(a, touch) for a in answers[-last:]])
        row["broken"] |= dict(Counter(b for a in answers[:-last] for b in a.broken))
        return row
    return _untouched(answers)


def _untouched(answers: list[Answer]) -> Row:
    """Frames in which nothing touches: valid is right, a contact is not."""
    broken = Counter(b for a in answers for b in a.broken)
    broken["valid contact where nothing touches"] += sum(a.valid and bool(a.contacts) for a in answers)
    valid = 100 * float(np.mean([a.valid for a in answers]))
    return {"frames": len(answers), "valid_%": valid, "broken": {k: v for k, v in broken.items() if v}}


# frames that no skin made: |Z0| and a generator -> Z (K,), status (K,)
Made = tuple[NDArray[np.complexfloating], NDArray[np.uint8]]


def _plain(z: NDArray[np.complexfloating] | Array) -> Made:
    return np.asarray(z, complex), np.zeros(len(z), np.uint8)


def _bits(z0: Array, rng: np.random.Generator) -> Made:
    words = rng.integers(0, 2**32, 2 * len(z0), dtype=np.uint32).view(np.float32)
    with np.errstate(all="ignore"):
        return _plain(words[0::2] + 1j * words[1::2].astype(complex))


GAIN = "|Z0| x one factor"
FAMILIES: dict[str, Callable[[Array, np.random.Generator], Made]] = {
    "random bits": _bits,
    "any magnitude": lambda z0, rng: _plain(
        10.0 ** rng.uniform(-30, 30, len(z0)) * np.exp(2j * np.pi * rng.random(len(z0)))
    ),
    "normal": lambda z0, rng: _plain(z0.mean() * (rng.standard_normal(len(z0)) + 1j * rng.standard_normal(len(z0)))),
    "|Z0| exchanged": lambda z0, rng: _plain(rng.permutation(z0)),
    "|Z0| x e^N(0, 1)": lambda z0, rng: _plain(z0 * np.exp(rng.standard_normal(len(z0)))),
    "|Z0| x e^N(0, 0.3)": lambda z0, rng: _plain(z0 * np.exp(0.3 * rng.standard_normal(len(z0)))),
    "|Z0| + 10 % noise": lambda z0, rng: _plain(z0 * (1 + 0.1 * rng.standard_normal(len(z0)))),
    "|Z0| + up to 20 %": lambda z0, rng: _plain(z0 * (1 + 0.2 * rng.random(len(z0)))),
    GAIN: lambda z0, rng: _plain(z0 * 10.0 ** (rng.choice([-1, 1]) * rng.uniform(0.05, 3))),
    "|Z0| with random status": lambda z0, rng: (z0.astype(complex), rng.integers(0, 16, len(z0)).astype(np.uint8)),
}

PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "not numbers in some channels": replaced(NOT_NUMBERS),
    "odd numbers in some channels": replaced(ODD_NUMBERS),
    "dead electrodes": dead,
    "saturated channels": saturated,
    "constant frames, zero references": constant,
    "random frames": random_frames,
}
