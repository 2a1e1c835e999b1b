"""Touches that grow into one patch and come out of it again.

A merged patch is one contact; its track keeps its id. The touches in it (`Track.inside`) move on with the velocities
they had, but together they stay where the patch is. When the patch falls apart, each part becomes the touch whose
predicted place and size fit it. So two fingers that slide through each other keep their ids.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from services.contacts.motion import Patch, Track, size_cost

MERGED_S = 5.0  # how long a touch inside another's patch is kept
DROWNED_S = 1.0  # one that drowns beside it, or was lifted there
WEAK = 0.5  # of the size of a patch: a touch that drowns beside it
BESIDE_M = 0.010  # from the patch's edge, where it does
MARGIN_M = 0.012  # from the patch's edge, where a part of it may come out
INSIDE_SIGMA_M = 0.003  # of where a touch inside a patch should be, at first
INSIDE_SIGMA_M_S = 0.010  # by how much it grows: fingers stop and turn back


def host_of(track: Track, hosts: Sequence[tuple[Track, Patch]], sample_ns: int) -> tuple[Track, float] | None:
    """The track whose patch covers the place where a lost touch should be, or hides it; and how long to wait for that
    touch [s].
    """
    x, y = track.ahead(sample_ns)
    distance = [math.hypot(x - s.x, y - s.y) - s.reach for _, s in hosts]
    nearest = min(range(len(hosts)), key=lambda k: distance[k], default=None)
    if nearest is None:
        return None
    host, patch = hosts[nearest]
    if distance[nearest] < 0:
        return host, MERGED_S
    drowns = distance[nearest] < BESIDE_M and track.size < WEAK * patch.size
    return (host, DROWNED_S) if drowns else None


def absorb(host: Track, tracks: Sequence[Track], since_ns: int, wait_s: float) -> None:
    """The tracks are inside the host's patch from then on, and are waited for so long."""
    if not host.inside:
        host.inside = [host.ghost()]
    host.inside += tracks
    host.since_ns = since_ns
    for track in tracks:
        track.until_ns = since_ns + int(wait_s * 1e9)


def give_up(host: Track, sample_ns: int) -> list[Track]:
    """Drop touches that were inside for too long."""
    late = [t for t in others(host) if sample_ns > t.until_ns]
    if late:
        host.inside = [t for t in host.inside if not any(t is one for one in late)]
    if len(host.inside) == 1:
        host.inside = []
    return late


def others(host: Track) -> list[Track]:
    """The touches inside a patch other than the one that gave it its id."""
    return [t for t in host.inside if t.id != host.id]


def follow(host: Track, patch: Patch, sample_ns: int) -> None:
    """Move the touches inside on: with the patch, and not out of it."""
    _advance(host.inside, (patch.x, patch.y), sample_ns)
    for t in host.inside:
        away = math.hypot(t.x - patch.x, t.y - patch.y)
        if away > patch.reach:
            t.x = patch.x + (t.x - patch.x) * patch.reach / away
            t.y = patch.y + (t.y - patch.y) * patch.reach / away


def is_part(host: Track, seen: Patch, sample_ns: int) -> bool:
    """Whether this can be a part of the host's patch, as it was."""
    x, y = host.ahead(sample_ns)
    return math.hypot(seen.x - x, seen.y - y) < host.reach + MARGIN_M


def part(host: Track, parts: Sequence[Patch], sample_ns: int) -> list[Track | None]:
    """The touch that each of at least two parts is, or None for more parts than there are touches.

    Where there are more touches than parts, some parts have several inside.
    """
    from scipy.optimize import linear_sum_assignment  # here: slow to import, see services/publisher.py

    total = sum(p.size for p in parts)
    weights = [p.size / total if total > 0 else 1 / len(parts) for p in parts]
    centre = (
        sum(w * p.x for w, p in zip(weights, parts, strict=True)),
        sum(w * p.y for w, p in zip(weights, parts, strict=True)),
    )
    _advance(host.inside, centre, sample_ns)
    sigma = math.hypot(INSIDE_SIGMA_M, INSIDE_SIGMA_M_S * (sample_ns - host.since_ns) * 1e-9)
    costs = [[_cost(t, p, sigma) for p in parts] for t in host.inside]
    rows, columns = linear_sum_assignment(costs)
    found: list[Track | None] = [None] * len(parts)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        found[column] = host.inside[row]
    left = [k for k in range(len(host.inside)) if k not in rows]
    for k in left:
        owner = found[min(range(len(parts)), key=lambda c: costs[k][c])]
        assert owner is not None  # more touches than parts: every part has one
        absorb(owner, [host.inside[k]], host.since_ns, MERGED_S)
    return found


def _advance(inside: Sequence[Track], centre: tuple[float, float], sample_ns: int) -> None:
    """Move each with its velocity, then all of them so that their common centre is the patch's."""
    for t in inside:
        (t.x, t.y), t.seen_ns = t.ahead(sample_ns), sample_ns
    total = sum(t.size for t in inside)
    weights = [t.size / total if total > 0 else 1 / len(inside) for t in inside]
    dx = centre[0] - sum(w * t.x for w, t in zip(weights, inside, strict=True))
    dy = centre[1] - sum(w * t.y for w, t in zip(weights, inside, strict=True))
    for t in inside:
        t.x, t.y = t.x + dx, t.y + dy


def _cost(track: Track, seen: Patch, sigma: float) -> float:
    return (math.hypot(track.x - seen.x, track.y - seen.y) / sigma) ** 2 + size_cost(track, seen)
