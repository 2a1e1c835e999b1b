"""The same work on several cores: each process has one sheet and one pipeline, and keeps what it solved."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing.util import Finalize
from typing import TypeVar

import services  # noqa: F401  (one thread for the numerical libraries, before numpy starts them)
from bench.reliability.scenes import SolvedSheet
from bench.reliability.session import new_pipeline
from services.pipeline import Pipeline

Task = TypeVar("Task")
Found = TypeVar("Found")
SAY_EVERY_S = 20.0
SAVED = 100  # new solutions are written at once


@lru_cache(maxsize=1)
def sheet() -> SolvedSheet:
    made = SolvedSheet()
    Finalize(None, made.close, exitpriority=1)  # of this process, worker or not
    return made


@lru_cache(maxsize=8)
def pipeline(bundle: str = "square16", **settings: object) -> Pipeline:
    """Made once in a process. Whoever uses it resets it first, as `Session` does."""
    return new_pipeline(bundle, **settings)


def spread(work: Callable[[Task], Found], tasks: Iterable[Task], cores: int, what: str) -> Iterator[Found]:
    """The results of all tasks, in their order. One core: in this process."""
    waiting = list(tasks)
    began = said = time.perf_counter()
    for done, result in enumerate(_results(partial(_kept, work), waiting, cores), 1):
        if time.perf_counter() - said > SAY_EVERY_S:
            said = time.perf_counter()
            print(f"{what}: {done} of {len(waiting)} in {said - began:.0f} s", file=sys.stderr)
        yield result


def cores() -> int:
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


def _kept(work: Callable[[Task], Found], task: Task) -> Found:
    try:
        return work(task)
    finally:
        if sheet.cache_info().currsize:  # it was used
            sheet().close(least=SAVED)
