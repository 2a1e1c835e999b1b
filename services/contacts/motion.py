"""The motion of one touch: a Kalman filter of place and velocity, the same for x and y (constant velocity, random
acceleration). Between images the touch is where its velocity takes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

ACCELERATION = 0.3  # m/s^2, standard deviation of a finger's acceleration
PLACE_SIGMA_M = 0.0012  # of a centroid from one image
FIRST_SPEED = 0.1  # m/s, standard deviation of an unknown velocity
LONGEST_PREDICTION_S = 0.2  # a velocity says nothing about longer gaps
SIZE_SIGMA = 0.4  # of the logarithm of an integrated drop, from frame to frame
SIZE_SHARE = 0.3  # of what is seen, in the running mean of the size
LEFT_OVER, LEFT_OVER_M = 0.3, 0.008  # share of its size, and distance, that no touch changes by at once as it goes on
SAME_M, SAME_SIZE = 0.0015, 0.15  # a steady touch from image to image: place, logarithm of an integrated drop
REMEMBERED = 3  # images
BACK, BACK_M = 4.0, 0.004  # a touch is where it was before doubtful images led it away: chi-squared that it costs, m
AWAY_M = 0.025  # by which they may have led it
MOST_FOR_SIZE = 9.0  # a touch may grow quickly: its size alone makes it no other touch


class Patch(NamedTuple):
    """One patch in one image."""

    x: float  # m, area centroid
    y: float
    size: float = 0.0  # integrated drop, any unit; 0: unknown
    reach: float = 0.0  # m from the centroid to the patch's farthest point
    confidence: float = 1.0  # probability that its peak is no noise


class Motion(NamedTuple):
    """Where a touch is on the sheet [m], and its velocity [m/s]."""

    x: float
    y: float
    vx: float
    vy: float


@dataclass
class Track:
    """One touch that lasts. `inside`: the touches that have grown into its patch, itself included; else empty."""

    id: int  # 0: not yet confirmed
    x: float  # m, filtered
    y: float
    seen_ns: int  # sample time of the frame in which it was last seen
    size: float
    reach: float
    vx: float = 0.0  # m/s
    vy: float = 0.0
    pp: float = PLACE_SIGMA_M**2  # variances of place and velocity, and their covariance
    pv: float = 0.0
    vv: float = FIRST_SPEED**2
    missing: int = 0  # frames since it was seen
    age: int = 1  # frames in which it was seen
    sure_frames: int = 0  # of those, with an image that explained its frame, or that was like the one before
    confidences: list[float] = field(default_factory=list)  # of its patches in the last images, newest last
    last: list[float] = field(default_factory=list)  # place [m] and size in the last image
    begins: bool = True  # whether it was looked for, and not there, just before
    sure: list[float] = field(default_factory=list)  # m, where the last image that explained its frame showed it
    doubted: bool = False  # whether the image after that one did not
    since_ns: int = 0  # when the last one of `inside` came
    until_ns: int = 0  # how long it is waited for while it is inside another one's patch
    inside: list[Track] = field(default_factory=list)

    def seconds_to(self, sample_ns: int) -> float:
        return min(max(0.0, (sample_ns - self.seen_ns) * 1e-9), LONGEST_PREDICTION_S)

    def ahead(self, sample_ns: int) -> tuple[float, float]:
        """Where it should be then [m]."""
        seconds = self.seconds_to(sample_ns)
        return self.x + self.vx * seconds, self.y + self.vy * seconds

    def move(self, seen: Patch, sample_ns: int, sure: bool = True) -> None:
        """Update with where an image shows it. sure: the image explains its frame; else it shows roughly where."""
        if sure:
            self.sure, self.sure_frames = [seen.x, seen.y], self.sure_frames + 1
        self.doubted = not sure
        self.last = [seen.x, seen.y, seen.size]
        self.confidences = [*self.confidences, seen.confidence][-REMEMBERED:]
        real = max(0.0, (sample_ns - self.seen_ns) * 1e-9)
        if real > 1e-6:
            self._filter(seen, real)
            self.seen_ns = sample_ns
        else:  # the same sample again, or a clock that went back
            self.x, self.y = seen.x, seen.y
        if seen.size > 0:
            self.size = self.size ** (1 - SIZE_SHARE) * seen.size**SIZE_SHARE if self.size > 0 else seen.size
        self.reach, self.missing = seen.reach, 0
        self.age += 1

    def carry(self, now: Motion, sample_ns: int) -> None:
        """It is followed, and has come there: what images told of its velocity is over."""
        self.x, self.y, self.vx, self.vy = now
        self.pp, self.pv, self.vv, self.seen_ns = PLACE_SIGMA_M**2, 0.0, FIRST_SPEED**2, sample_ns
        self.doubted = False

    def _filter(self, seen: Patch, seconds: float) -> None:
        noise = ACCELERATION**2 * seconds**2
        pp = self.pp + 2 * seconds * self.pv + seconds**2 * self.vv + noise * seconds**2 / 4
        pv = self.pv + seconds * self.vv + noise * seconds / 2
        vv = self.vv + noise
        place, speed = pp / (pp + PLACE_SIGMA_M**2), pv / (pp + PLACE_SIGMA_M**2)
        x, y = self.x + self.vx * seconds, self.y + self.vy * seconds
        dx, dy = seen.x - x, seen.y - y
        self.x, self.y = x + place * dx, y + place * dy
        self.vx, self.vy = self.vx + speed * dx, self.vy + speed * dy
        self.pp, self.pv, self.vv = (1 - place) * pp, (1 - place) * pv, vv - speed * pv

    def ghost(self) -> Track:
        """A copy of it as one of its own `inside`: what it was before others came."""
        return replace(self, inside=[])


def is_same(track: Track, seen: Patch) -> bool:
    """Whether a patch is where the image before showed the track, and as large."""
    if not track.last or track.missing:
        return False
    x, y, size = track.last
    grown = abs(math.log(seen.size / size)) if size > 0 and seen.size > 0 else 0.0
    return math.hypot(seen.x - x, seen.y - y) <= SAME_M and grown <= SAME_SIZE


def is_left_over(track: Track, seen: Patch) -> bool:
    """Whether a patch is what a touch that just ended leaves of itself in the image: far from where the touch was last
    seen for sure, and much smaller.
    """
    if not track.sure or not 0 < seen.size < LEFT_OVER * track.size:
        return False
    return math.hypot(seen.x - track.sure[0], seen.y - track.sure[1]) > LEFT_OVER_M


def cost(track: Track, seen: Patch, sample_ns: int) -> tuple[float, float]:
    """(distance [m] from where the track should be, how unlikely it is that this is the track: chi-squared)."""
    distance, chi2 = _apart(track, seen, sample_ns)
    back = _apart_from_sure(track, seen, sample_ns)
    if back is not None and back[1] < chi2:
        distance, chi2 = back
    return distance, chi2 + size_cost(track, seen)


def comes_back(track: Track, seen: Patch, sample_ns: int) -> bool:
    """Whether a patch is rather where the last image that explained its frame showed the track than where the images
    after that led to: while another touch begins, images show touches where none is.
    """
    back = _apart_from_sure(track, seen, sample_ns)
    return back is not None and back[1] < _apart(track, seen, sample_ns)[1]


def _apart(track: Track, seen: Patch, sample_ns: int) -> tuple[float, float]:
    """The same as `cost`, of places alone."""
    x, y = track.ahead(sample_ns)
    distance = math.hypot(seen.x - x, seen.y - y)
    s = track.seconds_to(sample_ns)
    variance = track.pp + 2 * s * track.pv + s * s * track.vv + (ACCELERATION * s * s) ** 2 / 4 + PLACE_SIGMA_M**2
    return distance, distance**2 / variance


def _apart_from_sure(track: Track, seen: Patch, sample_ns: int) -> tuple[float, float] | None:
    """The same from where the track was sure to be; None where its last image was sure, or it went far since."""
    if not (track.sure and track.doubted):
        return None
    x, y = track.ahead(sample_ns)
    if math.hypot(x - track.sure[0], y - track.sure[1]) > AWAY_M:
        return None
    distance = math.hypot(seen.x - track.sure[0], seen.y - track.sure[1])
    return distance, BACK + (distance / BACK_M) ** 2


def size_cost(track: Track, seen: Patch) -> float:
    if track.size <= 0 or seen.size <= 0:
        return 0.0
    return min((math.log(seen.size / track.size) / SIZE_SIGMA) ** 2, MOST_FOR_SIZE)
