"""Transfer impedances over time: solved at key poses, interpolated in between. A still scene costs no solves."""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .timeline import Timeline, WorldSegment
from .world import World, blend, steps_between

Matrix = NDArray[np.float64]

MOST_SOLVES_HZ = 7.0  # faster movements get fewer key poses, and a coarser interpolation
LOOK_AHEAD_S = 1.0
KEPT = 4096  # solved worlds (2 kB each): a looping scene is solved once
THREAD_SHARE = 0.25  # of one core the solving thread allows itself
SOLVER_NICE = 10


class Field:
    """Answers `over(start, end)` for a timeline.

    solve: World -> (n, n) transfer impedances. With `threaded`, a thread solves the poses ahead of time and a question
    never waits: a pose that is not ready is replaced by the nearest that is (counted in `late`). Without it, poses are
    solved when they are asked for: exact, for simulated time.
    """

    def __init__(self, solve: Callable[[World], Matrix], timeline: Timeline, *, threaded: bool = False) -> None:
        self._solve = solve
        self._timeline = timeline
        self._recent = timeline, timeline.segment(0.0)
        self._solved: OrderedDict[World, Matrix] = OrderedDict()
        self._lock = threading.Lock()
        self._wake = threading.Condition(self._lock)
        self._wanted: list[World] = []
        self._last: Matrix | None = None
        self._stopped = False
        self.solves = 0
        self.late = 0
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._work, name="solver", daemon=True)
            self._thread.start()

    # --- the timeline ---

    @property
    def timeline(self) -> Timeline:
        return self._timeline

    def play(self, timeline: Timeline, at: float) -> None:
        """From now on `timeline`, whose world at `at` (s) is solved before this returns."""
        segment = timeline.segment(at)
        self._solved_now(_nodes(segment)[0])
        self._timeline = timeline
        self.prepare(at)

    def segment(self, t: float) -> WorldSegment:
        """The timeline's segment around t; the last one asked for is kept."""
        timeline, segment = self._recent
        if timeline is not self._timeline or not segment.start <= t < segment.end:
            timeline = self._timeline
            segment = timeline.segment(t)
            self._recent = timeline, segment
        return segment

    # --- questions ---

    def over(self, start: float, end: float) -> tuple[Matrix, Matrix]:
        """Transfer matrices (n, n) at both ends of a scan. A jump during the scan is felt from the next scan on."""
        segment = self.segment(start)
        first = self._at(segment, start)
        if segment.first == segment.last:
            return first, first
        return first, self._at(segment, min(end, segment.end))

    def prepare(self, now: float) -> None:
        """Ask the thread for the poses of the next second, soonest first."""
        if self._thread is None:
            return
        t, wanted = now, []
        while t <= now + LOOK_AHEAD_S:
            segment = self._timeline.segment(t)
            nodes = _nodes(segment)
            if len(nodes) > 1:
                step = (segment.end - segment.start) / (len(nodes) - 1)
                low = max(0, int((t - segment.start) / step) - 1)
                high = int((now + LOOK_AHEAD_S - segment.start) / step) + 3
                nodes = nodes[low:high]
            wanted += nodes
            t = max(segment.end, t + 1e-6)
        with self._lock:
            self._wanted = [world for world in dict.fromkeys(wanted) if world not in self._solved]
            if self._wanted:
                self._wake.notify()

    def close(self) -> None:
        with self._lock:
            self._stopped = True
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(2.0)

    # --- poses ---

    def _at(self, segment: WorldSegment, t: float) -> Matrix:
        nodes = _nodes(segment)
        m = len(nodes) - 1
        if m == 0:
            matrix = self._get(nodes[0])
        else:
            s = min(max((t - segment.start) / (segment.end - segment.start), 0.0), 1.0) * m
            first = min(max(int(s) - 1, 0), max(m - 3, 0))
            used = range(first, min(first + 4, m + 1))
            around = [self._get(nodes[k]) for k in used]
            have = [(abs(s - k), part) for k, part in zip(used, around, strict=True) if part is not None]
            if len(have) == len(around):
                matrix = np.tensordot(_lagrange(s, list(used)), np.array(around), 1)
            else:
                matrix = min(have, key=lambda pair: pair[0])[1] if have else None
        if matrix is None:
            self.late += 1
            matrix = self._last if self._last is not None else self._solved_now(nodes[0])
        self._last = matrix
        return matrix

    def _get(self, world: World) -> Matrix | None:
        if self._thread is None:
            return self._solved_now(world)
        with self._lock:
            return self._solved.get(world)

    def _solved_now(self, world: World) -> Matrix:
        with self._lock:
            if world in self._solved:
                self._solved.move_to_end(world)
                return self._solved[world]
        matrix = self._solve(world)
        self.solves += 1
        with self._lock:
            self._solved[world] = matrix
            while len(self._solved) > KEPT:
                self._solved.popitem(last=False)
        return matrix

    def _work(self) -> None:
        # A real board's physics costs the host nothing, so this thread yields to all others.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), SOLVER_NICE)
        while True:
            with self._lock:
                while not self._wanted and not self._stopped:
                    self._wake.wait()
                if self._stopped:
                    return
                world = self._wanted.pop(0)
            began = time.thread_time()
            self._solved_now(world)
            time.sleep((time.thread_time() - began) * (1 / THREAD_SHARE - 1))


@lru_cache(maxsize=64)
def _nodes(segment: WorldSegment) -> list[World]:
    """The key poses of a segment, evenly spaced in time."""
    if segment.first == segment.last:
        return [segment.first.rounded()]
    m = steps_between(segment.first, segment.last)
    m = min(m, max(2, int((segment.end - segment.start) * MOST_SOLVES_HZ)))
    return [blend(segment.first, segment.last, k / m).rounded() for k in range(m + 1)]


def _lagrange(s: float, nodes: list[int]) -> NDArray[np.float64]:
    """Weights of the polynomial through the given integer nodes, at s."""
    weights = np.ones(len(nodes))
    for i, a in enumerate(nodes):
        for b in nodes:
            if b != a:
                weights[i] *= (s - b) / (a - b)
    return weights
