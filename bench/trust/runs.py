"""Sessions on several cores, one score for each row, kind of scan and checkout that is judged."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from bench import ROOT
from bench.json_file import write_json
from bench.trust.plans import PLANS
from bench.trust.score import WORST, TrustScore
from bench.trust.session import PlayedSession, SessionPlan
from bench.trust.stages import Judged, OtherCheckout, Today
from firmware_stub.worlds import table
from models.bundle import Bundle
from services.runtime.config import ScanMode, Skin

SCANS: tuple[ScanMode, ...] = ("full", "rolling")
OURS = ""  # the checkout that runs the benchmark, beside the paths of others
CODE = ("protocol", "models", "services", "firmware_stub", "simulation", "bench/trust")
SAY_EVERY_S = 20.0

Task = TypeVar("Task")
Found = TypeVar("Found")


@dataclass(frozen=True)
class SessionTask:
    """One session: for which checkouts, and where its recording goes if it fails."""

    plan: SessionPlan
    scan: str
    bundle: str
    checkouts: tuple[str, ...]
    recording: Path | None = None

    def key(self, checkout: str) -> str:
        """Everything that a score depends on but the code that makes it."""
        each = self.plan
        of = f"{each.plan} {each.row} {each.number} {each.seed} {each.seconds:g} {each.apart_m:g}"
        return f"{code(checkout)} {of} {self.scan} {self.bundle}"


class KeptScores:
    """Scores of sessions in a JSON file. None that other code made is used."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        text = path.read_text(encoding="utf-8") if path is not None and path.is_file() else "{}"
        self._known: dict[str, Any] = json.loads(text)

    def found(self, key: str) -> TrustScore | None:
        return TrustScore.of(self._known[key]) if key in self._known else None

    def keep(self, key: str, score: TrustScore) -> None:
        self._known[key] = score.to_dict()
        if self._path is not None:
            write_json(self._path, self._known)


@lru_cache(maxsize=4)
def code(checkout: str) -> str:
    """A hash of the checkout's code, and of what plays and judges here."""
    digest = hashlib.sha256()
    for root in {ROOT, Path(checkout) if checkout else ROOT}:
        for file in sorted(file for name in CODE for file in (root / name).rglob("*.py")):
            digest.update(file.read_bytes())
        for manifest in sorted((root / "models" / "bundles").glob("*/manifest.json")):
            digest.update(manifest.read_bytes())
    return digest.hexdigest()[:12]


def published_seed() -> str:
    """The commit that is checked out: the parent of the one that publishes what was found with it. Raises ValueError
    where there is none.
    """
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        raise ValueError("this is no git checkout, which would say the seed: give --seed TEXT") from None
    return found.stdout.strip()


def session_seed(seed: str, row: str, number: int) -> int:
    """Of one session: from the sha256 of the seed's text, the row's name and the session's number."""
    return int.from_bytes(hashlib.sha256(f"{seed} {row} {number}".encode()).digest()[:4], "big")


def skin_of(scan: str, bundle: str) -> Skin:
    """The skin that is judged, as skin.toml would have it."""
    return Skin.model_validate({"port": "stub", "bundle": bundle, "frame_id": "palm", "scan": scan})


@lru_cache(maxsize=4)
def _stages(checkout: str, scan: str, bundle: str) -> Judged:
    skin = skin_of(scan, bundle)
    return OtherCheckout(Path(checkout), skin) if checkout else Today(skin, Bundle.load(bundle))


def play(task: SessionTask) -> dict[str, TrustScore]:
    """One session, by checkout; a failing one is recorded, if anything is."""
    plan = task.plan
    sheet = table.sheet(plan.world, plan.seed)
    scene = PLANS[plan.plan].scene(plan, sheet)
    skin, keep = skin_of(task.scan, task.bundle), task.recording is not None
    played = PlayedSession(plan, scene, sheet, skin, Bundle.load(task.bundle), keep)
    scores = played.judged({each: _stages(each, task.scan, task.bundle) for each in task.checkouts})
    if task.recording is not None and any(failures(score) for score in scores.values()):
        played.record(task.recording)
    return scores


def failures(score: TrustScore) -> tuple[int, ...]:
    """How much of what must not be is in it, the worst kind first; empty: nothing."""
    found = tuple(
        sum(n for key, n in score.counts.items() if key == kind or key.startswith(f"{kind}/")) for kind in WORST
    )
    return found if any(found) else ()


@dataclass(frozen=True)
class TrustRun:
    """What the command line asks for. seconds: of a session of worlds, where not the plan's."""

    plan: str
    seed: str
    minutes: float
    checkouts: tuple[str, ...] = (OURS,)
    seconds: float | None = None
    apart_m: float = 0.028
    bundle: str = "square16"
    cores: int = 1
    recordings: Path | None = None

    def tasks(self, row: str, scan: str) -> list[SessionTask]:
        worlds, made = self.plan == "worlds", list[SessionTask]()
        seconds = self.seconds if self.seconds and worlds else PLANS[self.plan].seconds
        world = row if worlds else "plain"
        for n in range(max(1, round(60 * self.minutes / seconds))):
            plan = SessionPlan(world, session_seed(self.seed, row, n), seconds, self.apart_m, self.plan, row, n)
            where = self.recordings / f"{row}-{scan}-{n}.mcap".replace(" ", "-") if self.recordings else None
            made.append(SessionTask(plan, scan, self.bundle, self.checkouts, where))
        return made

    def scores(
        self, rows: Sequence[str], scans: Sequence[str], kept: KeptScores
    ) -> dict[tuple[str, str], dict[str, TrustScore]]:
        """(row, kind of scan) -> the score of each checkout; sessions that are kept count without being played."""
        total = {(row, scan): {each: TrustScore() for each in self.checkouts} for row in rows for scan in scans}
        lacking: list[SessionTask] = []
        for task in (task for row, scan in total for task in self.tasks(row, scan)):
            found = {each: kept.found(task.key(each)) for each in self.checkouts}
            for each, score in found.items():
                if score is not None:
                    total[task.plan.row, task.scan][each].add(score)
            if lacks := tuple(each for each, score in found.items() if score is None):
                lacking.append(replace(task, checkouts=lacks))
        for task, scores in zip(lacking, spread_work(play, lacking, self.cores, self.plan), strict=True):
            for each, score in scores.items():
                kept.keep(task.key(each), score)
                total[task.plan.row, task.scan][each].add(score)
        return total


def spread_work(work: Callable[[Task], Found], tasks: list[Task], cores: int, what: str) -> Iterator[Found]:
    """The results of all tasks, in their order. One core: in this process."""
    began = said = time.perf_counter()
    for done, result in enumerate(_results(work, tasks, cores), 1):
        if time.perf_counter() - said > SAY_EVERY_S:
            said = time.perf_counter()
            print(f"{what}: {done} of {len(tasks)} in {said - began:.0f} s", file=sys.stderr)
        yield result


def usable_cores() -> int:
    return len(os.sched_getaffinity(0))


def _results(work: Callable[[Task], Found], tasks: list[Task], cores: int) -> Iterator[Found]:
    if cores <= 1 or len(tasks) <= 1:
        yield from map(work, tasks)
        return
    context = multiprocessing.get_context("spawn")  # threads and network sessions do not survive a fork
    with ProcessPoolExecutor(min(cores, len(tasks)), mp_context=context) as pool:
        try:
            yield from pool.map(work, tasks)
        finally:
            pool.shutdown(cancel_futures=True)  # whoever ends us does not wait for the rest
