"""Transfer impedances at any instant: solved at key poses, interpolated in between. A still scene costs no solves."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from protocol.pause import pause

from .timeline import Timeline, WorldSegment
from .world import World, blend, steps_between

Matrix = NDArray[np.float64]

COARSE_HZ = 7.0  # about so many poses a second are solved first, then those between them
HISTORY_S = 10.0  # for so long it is known what was played before: a scan may have begun under it
LOOK_AHEAD_S = 1.0
KEPT = 4096  # solved worlds (2 kB each): a looping scene is solved once
THREAD_SHARE = 0.25  # of one core the solving thread allows itself
SOLVER_NICE = 10


class Field:
    """Answers `over(instants)` for what was played: a timeline, from an instant on.

    solve: World -> (n, n) transfer impedances. With `threaded`, a thread solves the poses ahead of time and a question
    never waits: a pose that is not ready is bridged by those around it that are (`late` counts the questions). Without
    it, poses are solved when they are asked for: exact, for simulated time.
    """

    def __init__(self, solve: Callable[[World], Matrix], timeline: Timeline, *, threaded: bool = False) -> None:
        self._solve = solve
        self._played: tuple[tuple[float, Timeline], ...] = ((-math.inf, timeline),)  # from when on, what
        self._recent = timeline, timeline.segment(0.0)
        self._asked = -math.inf  # the newest instant that was measured
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
        """The one that was played last."""
        return self._played[-1][1]

    def play(self, timeline: Timeline, at: float) -> None:
        """`timeline` from `at` (s) on, and what was played before until then. Its world at `at` is solved before this
        returns. What was measured by then stays as it was: nothing is felt before it was played.
        """
        self._solved_now(_nodes(timeline.segment(at))[0])
        with self._lock:
            since = max(at, self._asked)
            ends = [begin for begin, _ in self._played[1:]] + [math.inf]
            kept = [each for each, end in zip(self._played, ends, strict=True) if end > since - HISTORY_S]
            self._played = (*kept, (since, timeline))
        self.prepare(at)

    def solve_all(self, timeline: Timeline) -> int:
        """Solve every pose of a script before it is played; returns how many there are. Raises ValueError where they
        are more than are kept.
        """
        script, t, worlds = timeline.script, timeline.start, dict[World, None]()
        while t < timeline.start + script.duration:
            segment = timeline.segment(t)
            worlds.update(dict.fromkeys(_nodes(segment)))
            t = segment.end
        if len(worlds) > KEPT:
            raise ValueError(f"scene {script.name!r} has {len(worlds)} poses: expected at most {KEPT} to solve ahead")
        for world in worlds:
            self._solved_now(world)
        return len(worlds)

    def at(self, t: float) -> World:
        return self.segment(t).at(t)

    def segment(self, t: float) -> WorldSegment:
        """The segment around t of what was played then; the last one asked for is kept."""
        timeline, _ = self._playing(t)
        recent, segment = self._recent
        if recent is not timeline or not segment.start <= t < segment.end:
            segment = timeline.segment(t)
            self._recent = timeline, segment
        return segment

    def _playing(self, t: float) -> tuple[Timeline, float]:
        """What is played at t, and until when."""
        played, k = self._played, -1
        while played[k][0] > t:
            k -= 1
        return played[k][1], math.inf if k == -1 else played[k + 1][0]

    # --- questions ---

    def over(self, instants: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transfer matrices (m, n, n), and the weight (k, m) of each at each of the instants [s], which do not
        decrease: what is played then, jumps and ramps included, and nothing after it.
        """
        with self._lock:
            self._asked = max(self._asked, float(instants[-1]))
        parts: list[tuple[list[Matrix], NDArray[np.float64]]] = []
        begin, late = 0, False
        while begin < len(instants):
            t = float(instants[begin])
            segment = self.segment(t)
            stop = min(segment.end, self._playing(t)[1])
            end = max(begin + 1, int(np.searchsorted(instants, stop, side="left")))
            matrices, weights, complete = self._along(segment, instants[begin:end])
            parts.append((matrices, weights))
            begin, late = end, late or not complete
        self.late += late
        self._last = parts[-1][0][-1]
        return np.array([matrix for matrices, _ in parts for matrix in matrices]), block_diag(*(w for _, w in parts))

    def prepare(self, now: float) -> None:
        """Ask the thread for the poses of the next second, soonest first."""
        if self._thread is None:
            return
        t, wanted, timeline = now, [], self.timeline
        while t <= now + LOOK_AHEAD_S:
            segment = timeline.segment(t)
            nodes = _nodes(segment)
            if len(nodes) > 1:
                step = (segment.end - segment.start) / (len(nodes) - 1)
                low = max(0, int((t - segment.start) / step) - 1)
                high = int((now + LOOK_AHEAD_S - segment.start) / step) + 3
                nodes = _coarse_first(nodes[low:high], (min(high, len(nodes)) - low) * step)
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

    def _along(
        self, segment: WorldSegment, instants: NDArray[np.float64]
    ) -> tuple[list[Matrix], NDArray[np.float64], bool]:
        """Matrices (m of (n, n)), weights (k, m) at instants of one segment, and whether all its poses were solved."""
        nodes = _nodes(segment)
        m = len(nodes) - 1
        if m == 0:
            s = np.zeros(len(instants))
        else:
            s = ((instants - segment.start) / (segment.end - segment.start)).clip(0.0, 1.0) * m
        first = (s.astype(int) - 1).clip(0, max(m - 3, 0))
        rows: list[tuple[NDArray[np.intp], list[int], NDArray[np.float64]]] = []
        found: dict[int, Matrix] = {}
        complete = True
        for k in np.unique(first).tolist():
            here = np.flatnonzero(first == k)
            used = list(range(k, min(k + 4, m + 1)))
            found |= {node: got for node in used if node not in found and (got := self._get(nodes[node])) is not None}
            if not all(node in found for node in used):
                complete = False
                used = self._solved_around(nodes, float(s[here].mean()), found)
            if used:
                rows.append((here, used, _lagrange(s[here], used)))
        if not complete and sum(len(here) for here, *_ in rows) < len(s):  # nothing is solved hereabouts
            only = self._last if self._last is not None else self._solved_now(nodes[0])
            return [only], np.ones((len(s), 1)), False
        order = sorted(set[int]().union(*(used for _, used, _ in rows)))
        weights = np.zeros((len(s), len(order)))
        for here, used, share in rows:
            weights[np.ix_(here, np.searchsorted(order, used))] = share
        return [found[node] for node in order], weights, complete

    def _solved_around(self, nodes: list[World], s: float, found: dict[int, Matrix]) -> list[int]:
        """Up to two solved poses on each side of s; the nearest alone where there are none on one side."""
        with self._lock:
            solved = {k: self._solved[world] for k, world in enumerate(nodes) if world in self._solved}
        below, above = [k for k in solved if k <= s][-2:], [k for k in solved if k > s][:2]
        used = below + above if below and above else below[-1:] + above[:1]
        found |= {k: solved[k] for k in used}
        return used

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
            pause((time.thread_time() - began) * (1 / THREAD_SHARE - 1))


@lru_cache(maxsize=64)
def _nodes(segment: WorldSegment) -> list[World]:
    """The key poses of a segment, evenly spaced in time."""
    if segment.first == segment.last:
        return [segment.first.rounded()]
    m = max(1, steps_between(segment.first, segment.last))
    return [blend(segment.first, segment.last, k / m).rounded() for k in range(m + 1)]


def _coarse_first(nodes: list[World], seconds: float) -> list[World]:
    """COARSE_HZ of them a second, then the others."""
    stride = math.ceil(max(1.0, len(nodes) / max(2.0, seconds * COARSE_HZ)))
    return nodes[::stride] + [world for k, world in enumerate(nodes) if k % stride]


def _lagrange(s: NDArray[np.float64], nodes: list[int]) -> NDArray[np.float64]:
    """(k, len(nodes)) weights of the polynomial through the given integer nodes, at s (k,)."""
    weights = np.ones((len(s), len(nodes)))
    for i, a in enumerate(nodes):
        for b in nodes:
            if b != a:
                weights[:, i] *= (s - b) / (a - b)
    return weights
