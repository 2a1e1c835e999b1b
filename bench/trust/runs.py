"""Sessions on several cores, one score for each world and kind of scan."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from bench.reliability import workers
from bench.trust import candidates as of_name
from bench.trust.candidate import Candidate
from bench.trust.kept import KeptScore, session_seed
from bench.trust.score import WORST, TrustScore
from bench.trust.session import PlayedSession, SessionPlan
from firmware_stub.worlds import table
from models.bundle import Bundle
from services.runtime.config import Skin

SCANS = ("full", "rolling")
SESSION_S, QUICK_S = 60.0, 13.0
RECORDINGS = 3  # of a world and kind of scan: its worst sessions


@dataclass(frozen=True)
class SessionTask:
    """One session: for which candidates, name -> MODULE:CLASS, and where its recording goes if it fails."""

    plan: SessionPlan
    scan: str
    bundle: str
    candidates: tuple[tuple[str, str], ...]
    recording: Path | None


@lru_cache(maxsize=4)
def _made(name: str, text: str, scan: str, bundle: str) -> Candidate:
    """The candidate of this name: two that are of one class are two."""
    return of_name.kind_of(text)(skin_of(scan, bundle), Bundle.load(bundle))


def skin_of(scan: str, bundle: str) -> Skin:
    """The skin that is judged, as skin.toml would have it."""
    return Skin.model_validate({"port": "stub", "bundle": bundle, "frame_id": "palm", "scan": scan})


def play(task: SessionTask) -> dict[str, TrustScore]:
    """Play one session; a failing one is recorded."""
    sheet = table.sheet(task.plan.world, task.plan.seed)
    played = PlayedSession(task.plan, sheet, skin_of(task.scan, task.bundle), Bundle.load(task.bundle))
    scores = played.judged({name: _made(name, text, task.scan, task.bundle) for name, text in task.candidates})
    if task.recording is not None and any(failures(score) for score in scores.values()):
        played.record(task.recording)
    return scores


def failures(score: TrustScore) -> tuple[int, ...]:
    """How much of what must not be is in it, the worst kind first; empty: nothing."""
    found = tuple(
        sum(n for key, n in score.counts.items() if key == kind or key.startswith(f"{kind}/")) for kind in WORST
    )
    return found if any(found) else ()


def run(
    world: str,
    scan: str,
    seed: str,
    minutes: float,
    *,
    candidates: Sequence[tuple[str, str]] = (("today", of_name.TODAY),),
    session_s: float = SESSION_S,
    apart_m: float = 0.028,
    bundle: str = "square16",
    cores: int = 1,
    folder: Path | None = None,
) -> dict[str, TrustScore]:
    """Simulate until each candidate's score has so many minutes, those of earlier runs included."""
    of = f"{world}-{scan}-{session_s:.0f}s-{1e3 * apart_m:.0f}mm"
    names = " ".join(text for _, text in candidates)
    shadow = "" if len(candidates) == 1 else f"-of-{hashlib.sha256(names.encode()).hexdigest()[:12]}"
    places = {name: f"{of}{shadow}" + f"-{at}" * bool(shadow) for at, (name, _) in enumerate(candidates)}
    kept = {name: KeptScore(place, seed, folder) for name, place in places.items()}
    first = min(each.number for each in kept.values())
    wanted = round(60 * minutes / session_s)
    where = kept[candidates[0][0]].recordings
    tasks = [
        SessionTask(
            SessionPlan(world, session_seed(seed, world, n), session_s, apart_m),
            scan,
            bundle,
            tuple(candidates),
            where / f"{n}.mcap",
        )
        for n in range(first, wanted)
    ]
    rated: list[tuple[tuple[int, ...], Path]] = []
    for n, scores in enumerate(workers.spread(play, tasks, cores, f"{world}, {scan}"), first):
        for name, score in scores.items():
            if kept[name].number == n:
                kept[name].add(score)
        rated.append((max(failures(score) for score in scores.values()), where / f"{n}.mcap"))
        rated = _pruned(rated)
    return {name: each.score for name, each in kept.items()}


def _pruned(rated: list[tuple[tuple[int, ...], Path]]) -> list[tuple[tuple[int, ...], Path]]:
    """The worst recordings of this run; the others are deleted."""
    order = sorted((each for each in rated if each[0]), reverse=True)
    for _, path in order[RECORDINGS:]:
        path.unlink(missing_ok=True)
    return order[:RECORDINGS]
