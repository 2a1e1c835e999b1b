"""Contacts over time: a touch keeps its id, through crossings and one lost frame; no id is used twice in a session."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

REACH_M = 0.015  # a touch that jumps further between two frames is another touch
LOST_FRAMES = 1  # frames a touch may be missing before it ends
VELOCITY_S = 0.1  # time constant of the velocity's smoothing
LONGEST_PREDICTION_S = 0.2  # a velocity says nothing about longer gaps


@dataclass
class Track:
    """One touch that lasts."""

    id: int
    x: float
    y: float
    vx: float
    vy: float
    seen_ns: int  # sample time of the frame in which it was last seen
    missing: int  # frames since then
    age: int  # frames in which it was seen


class Tracker:
    def __init__(self) -> None:
        self._next_id = 1
        self.tracks: list[Track] = []

    def reset(self) -> None:
        """End everything. Ids go on counting: none is used again in a session."""
        self.tracks = []

    def update(self, positions: list[tuple[float, float]], sample_ns: int) -> tuple[list[Track], list[Track]]:
        """Positions [m] of one frame -> (the track of each position, in their order; tracks that ended)."""
        pairs = self._assign(positions, sample_ns)
        found: list[Track] = []
        kept: set[int] = set()
        for index, (x, y) in enumerate(positions):
            track = self.tracks[pairs[index]] if index in pairs else None
            if track is None:
                track = Track(self._next_id, x, y, 0.0, 0.0, sample_ns, 0, 0)
                self._next_id += 1
            else:
                kept.add(track.id)
                _move(track, x, y, sample_ns)
            track.age += 1
            found.append(track)
        ended: list[Track] = []
        coasting: list[Track] = []
        for track in self.tracks:
            if track.id not in kept:
                track.missing += 1
                (ended if track.missing > LOST_FRAMES else coasting).append(track)
        self.tracks = found + coasting
        return found, ended

    def _assign(self, positions: list[tuple[float, float]], sample_ns: int) -> dict[int, int]:
        """Position index -> track index: least total distance to the predicted places, within reach."""
        if not positions or not self.tracks:
            return {}
        from scipy.optimize import linear_sum_assignment  # here: slow to import, see services/publisher.py

        ahead = [min(max(0.0, (sample_ns - t.seen_ns) * 1e-9), LONGEST_PREDICTION_S) for t in self.tracks]
        predicted = np.array([(t.x + t.vx * s, t.y + t.vy * s) for t, s in zip(self.tracks, ahead, strict=True)])
        distance = np.linalg.norm(np.array(positions)[:, None] - predicted[None], axis=2)
        rows, columns = linear_sum_assignment(np.minimum(distance, REACH_M))
        return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if distance[r, c] < REACH_M}

    def state(self) -> dict[str, Any]:
        return {"next_id": self._next_id, "tracks": [asdict(t) for t in self.tracks]}

    def load(self, state: dict[str, Any]) -> None:
        self._next_id = int(state["next_id"])
        self.tracks = [Track(**t) for t in state["tracks"]]


def _move(track: Track, x: float, y: float, sample_ns: int) -> None:
    seconds = (sample_ns - track.seen_ns) * 1e-9
    if seconds > 1e-6:
        weight = seconds / (seconds + VELOCITY_S)
        track.vx += weight * ((x - track.x) / seconds - track.vx)
        track.vy += weight * ((y - track.y) / seconds - track.vy)
        track.seen_ns = sample_ns
    track.x, track.y, track.missing = x, y, 0
