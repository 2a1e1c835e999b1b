"""Contacts over time: a touch keeps its id while it lasts; no id is used twice in a session.

Between images a touch moves with its velocity (motion.py). The patches of an image are assigned to the touches at least
total cost. merging.py handles touches that grow into one patch and come out of it.

A touch *begins* if the frame before was examined and did not show it. A touch in the first frame that is examined,
after a start or after a pause, may have been there for long.

The first touch begins at once, if its image is sure. A touch that appears beside others begins when a second sure image
shows it too: if a touch comes or goes during a scan, that scan's image may show touches that are not there, and so may
the next one. A faint one takes three, and none begins while an electrode is at fault. An image is sure if it explains
its measurements, or if it is like the image before and explains all but a little: a strong touch at the edge leaves a
twentieth for as long as it is held, a contact that rose with a touch a tenth and more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from services.contacts.merging import absorb, follow, give_up, host_of, is_part, others, part
from services.contacts.motion import Motion, Patch, Track, comes_back, cost, is_left_over, is_same

REACH_M = 0.015  # a touch that jumps further between two frames is another touch
STAYS_M = 0.006  # what begins is near where it was seen first; what an image of a changing touch shows is not
LOST_FRAMES = 2  # frames a touch may be missing in before it ends; bad images do not count
UNSEEN_S = 0.25  # it ends after so long at the latest, however bad the images
FORGOTTEN_S = 1.0  # after so long without a frame, nobody knows whether a touch is the same
NEVER = 1e6  # cost of what is out of reach
REST = 0.1  # of a touch's size, below which what an image shows may be left of one that went
UNCONFIRMED = 0  # id of what was seen once, beside others
BELIEVED = ((2, 0.92), (3, 0.85))  # images and confidence in each, of either, with which a touch begins beside others
# The same while an electrode is at fault: a strong touch leaves faint patches where the skin is then nearly blind.
BELIEVED_DOUBTED = ((2, 0.95),)


class Tracker:
    """`tracks`: one for each patch that is there, or was LOST_FRAMES ago."""

    def __init__(self) -> None:
        self._next_id = 1
        self._looked_ns: int | None = None  # sample time of the last frame that said anything
        self._untold: list[Track] = []  # ended by a reset
        self.steady = False  # whether the image last taken in was like the one before, touch by touch
        self.tracks: list[Track] = []

    def reset(self) -> None:
        """End all touches; the next frame reports it. Ids go on counting: none is used again in a session."""
        self._untold += [one for track in self.tracks for one in (track, *others(track)) if one.id != UNCONFIRMED]
        self.tracks = []

    def forget(self) -> None:
        """Drop all touches without ending them: nobody is left who was told of them."""
        self.tracks, self._untold, self._looked_ns = [], [], None

    def expected(self, sample_ns: int) -> list[tuple[float, float]]:
        """Where each touch should be then [m], those inside one patch one by one."""
        sure = [track for track in self.tracks if track.id != UNCONFIRMED]
        return [one.ahead(sample_ns) for track in sure for one in (track.inside or [track])]

    def alone(self, seen: Sequence[Patch], sample_ns: int) -> tuple[list[Track], list[Track]]:
        """The same as `update` for a frame that follows no other in time: what was there ended, each entry begins."""
        self.reset()
        ended = self._begin_frame(sample_ns)
        for entry in seen:
            self.tracks.append(_new(self._next_id, entry, sample_ns))
            self._next_id += 1
        return list(self.tracks), ended

    def update(
        self,
        seen: Sequence[Patch],
        sample_ns: int,
        sure: bool = True,
        well: bool = True,
        near: bool = True,
        watched: bool = True,
    ) -> tuple[list[Track | None], list[Track]]:
        """Take in the patches of one frame. Returns the track of each patch, in their order (None for one that is to be
        confirmed), and the tracks that ended. sure: whether new touches of this frame can be believed at once. well:
        no electrode is at fault. near: it leaves so little unexplained that it counts as sure if it is like the one
        before. watched: nothing is missing before it; else a touch that it does not show ended, and none is known to
        have begun.
        """
        begins = watched and not self.forgotten(sample_ns)
        ended = self._begin_frame(sample_ns)
        owners = self._assign(seen, sample_ns)
        if not watched:
            ended += self._find_again(owners, sample_ns)
        self._merge(owners, seen, sample_ns)
        self._part(owners, seen, sample_ns)
        steady = near and bool(seen) and all(t and is_same(t, entry) for t, entry in zip(owners, seen, strict=True))
        self.steady, sure = steady, sure or steady
        found: list[Track] = []
        for entry, track in zip(seen, owners, strict=True):
            if track is None:
                track = _new(UNCONFIRMED, entry, sample_ns, begins, sure)
            else:
                track.sure_frames += steady and track.sure_frames == 0  # the image before was sure too
                if comes_back(track, entry, sample_ns):
                    track.carry(Motion(track.sure[0], track.sure[1], 0.0, 0.0), sample_ns)
                track.move(entry, sample_ns, sure)
                if track.inside:
                    follow(track, entry, sample_ns)
            found.append(track)
        self._confirm(found, sure, well)
        coasting = [t for t in self.tracks if t.id != UNCONFIRMED and not any(t is f for f in found)]
        self.tracks = found + coasting
        if not sure:
            coasting = [t for t in coasting if sample_ns - t.seen_ns > UNSEEN_S * 1e9]
        return [t if t.id != UNCONFIRMED else None for t in found], ended + self._lose(coasting, sample_ns)

    def _confirm(self, found: list[Track], sure: bool, well: bool) -> None:
        """Give ids to touches that begin: those that earlier sure images showed too, or the largest one where no
        other touch is known; at once where the image is sure, else when a third image shows it.
        """
        new = [t for t in found if t.id == UNCONFIRMED]
        begin = [t for t in new if _believed(t, well)]
        # A touch that no sure image ever showed may be where nothing touches.
        known = sure and any(t.id != UNCONFIRMED and t.sure for t in self.tracks)
        first = [t for t in new if sure or t.age > 2]
        if first and not begin and not known and len(new) == len(found):
            begin = [max(first, key=lambda t: t.size)]
        for track in begin:
            track.id, track.age = self._next_id, 1
            self._next_id += 1

    def still(self, sample_ns: int, changing: bool = False) -> list[Track]:
        """Take in a frame that shows the same as the one before; no touch counts as missing for longer. Returns tracks
        that ended. changing: touches may have moved all the same.
        """
        ended = self._begin_frame(sample_ns)
        for track in self.tracks:
            if not (track.missing or changing):
                track.vx = track.vy = 0.0  # it did not go on
            for one in track.inside:
                one.seen_ns = sample_ns
        return ended + self._lose([], sample_ns)

    def carry(self, motion: Mapping[int, Motion], sample_ns: int) -> None:
        """Touches that are followed go on from where they are by now."""
        for track in self.tracks:
            if (now := motion.get(track.id)) is not None and (now.vx or now.vy):
                track.carry(now, sample_ns)

    @property
    def waits(self) -> bool:
        """Whether something waits to be confirmed."""
        return any(track.id == UNCONFIRMED for track in self.tracks)

    @property
    def replaces(self) -> bool:
        """Whether what waits may have taken the place of touches that were shown: it is no rest of one that goes."""
        shown = [track for track in self.tracks if track.id != UNCONFIRMED]
        waiting = [track for track in self.tracks if track.id == UNCONFIRMED]
        return any(all(_is_other(new, old) for old in shown) for new in waiting)

    @property
    def remembers(self) -> bool:
        """Whether a touch that was shown is there, or was a moment ago."""
        return any(track.id != UNCONFIRMED for track in self.tracks)

    def forgotten(self, sample_ns: int) -> bool:
        """Whether so much time passed without a frame that no touch can be known to be the same."""
        return self._looked_ns is None or sample_ns - self._looked_ns > FORGOTTEN_S * 1e9

    def _begin_frame(self, sample_ns: int) -> list[Track]:
        """Tracks that ended before this frame: by a reset, or since nobody looked."""
        if self.forgotten(sample_ns):
            self.reset()
        self._looked_ns = sample_ns
        ended, self._untold = self._untold, []
        return ended

    def _assign(self, seen: Sequence[Patch], sample_ns: int) -> list[Track | None]:
        """The track of each entry: least total cost, within reach; or None."""
        owners: list[Track | None] = [None] * len(seen)
        if not seen or not self.tracks:
            return owners
        from scipy.optimize import linear_sum_assignment  # here: slow to import, see services/publisher.py

        costs = []
        for entry in seen:
            row = []
            for track in self.tracks:
                distance, chi2 = cost(track, entry, sample_ns)
                near = distance < (REACH_M if track.id != UNCONFIRMED else STAYS_M)
                row.append(chi2 if near and not is_left_over(track, entry) else NEVER)
            costs.append(row)
        for k, column in zip(*(v.tolist() for v in linear_sum_assignment(costs)), strict=True):
            if costs[k][column] < NEVER:
                owners[k] = self.tracks[column]
        return owners

    def _find_again(self, owners: Sequence[Track | None], sample_ns: int) -> list[Track]:
        """Keep what an image after a gap shows again -> what it does not, or hides in another one's patch. After a gap
        that is no longer than a touch may be unseen, those keep their ids: no contact is shown of them.
        """
        found = [track for track in owners if track is not None]
        if all(sample_ns - track.seen_ns <= UNSEEN_S * 1e9 for track in self.tracks):
            for track in found:
                track.vx, track.vy = 0.0, 0.0
            return []
        lost = [t for t in self.tracks if not any(t is one for one in found)]
        gone = [one for t in lost for one in (t, *others(t))] + [one for t in found for one in others(t)]
        for track in found:
            track.inside, track.vx, track.vy = [], 0.0, 0.0
        self.tracks = found
        return [track for track in gone if track.id != UNCONFIRMED]

    def _merge(self, owners: list[Track | None], seen: Sequence[Patch], sample_ns: int) -> None:
        """Put lost touches into the patch of another touch that covers their place."""
        matched = [(track, entry) for track, entry in zip(owners, seen, strict=True) if track is not None]
        hosts = [(track, entry) for track, entry in matched if track.id != UNCONFIRMED]
        for track in [t for t in self.tracks if t.id != UNCONFIRMED and not any(t is one for one, _ in matched)]:
            found = host_of(track, hosts, sample_ns)
            if found is not None:
                host, wait_s = found
                absorb(host, track.inside or [track], sample_ns, wait_s)
                self.tracks = [t for t in self.tracks if t is not track]

    def _part(self, owners: list[Track | None], seen: Sequence[Patch], sample_ns: int) -> None:
        """Take touches out of a patch that has fallen apart, each where it should be."""
        for host in [t for t in self.tracks if t.inside]:
            parts = [
                k
                for k, owner in enumerate(owners)
                if owner is host or (owner is None and is_part(host, seen[k], sample_ns))
            ]
            if len(parts) < 2:
                continue
            touches = part(host, [seen[k] for k in parts], sample_ns)
            self.tracks = [t for t in self.tracks if t is not host] + [t for t in touches if t is not None]
            for k, touch in zip(parts, touches, strict=True):
                owners[k] = touch

    def _lose(self, unseen: list[Track], sample_ns: int) -> list[Track]:
        """Count one more frame in which these were not seen -> what ended: after too many, or inside for too long."""
        ended = []
        for track in unseen:
            track.missing += 1
            if track.missing > LOST_FRAMES or sample_ns - track.seen_ns > UNSEEN_S * 1e9:
                self.tracks = [t for t in self.tracks if t is not track]
                ended += [track, *others(track)]
        return ended + [one for track in self.tracks for one in give_up(track, sample_ns)]

    def state(self) -> dict[str, Any]:
        return {
            "next_id": self._next_id,
            "looked_ns": -1 if self._looked_ns is None else self._looked_ns,
            "untold": [asdict(t) for t in self._untold],
            "tracks": [asdict(t) for t in self.tracks],
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken. Touches whose ids ended here since then would have to begin anew."""
        self.reset()
        here = {track.id: track for track in self._untold}

        def usable(track: Track) -> bool:
            return track.id >= self._next_id or track.id in here or track.id == UNCONFIRMED

        self.tracks = [track for track in map(_track, state["tracks"]) if usable(track)]
        for track in self.tracks:
            track.inside = [one for one in track.inside if usable(one)]
        going_on = {one.id for track in self.tracks for one in (track, *track.inside)}
        told = [track for track in map(_track, state["untold"]) if track.id >= self._next_id]
        self._untold = [t for t in (here | {t.id: t for t in told}).values() if t.id not in going_on]
        self._next_id = max(self._next_id, int(state["next_id"]))
        looked_ns = int(state["looked_ns"])
        self._looked_ns = None if looked_ns < 0 else looked_ns


def _believed(track: Track, well: bool) -> bool:
    """Whether what appears beside others is a touch. well: no electrode is at fault."""
    enough = BELIEVED if well else BELIEVED_DOUBTED
    return any(track.sure_frames >= n and min(track.confidences[-n:], default=0.0) >= least for n, least in enough)


def _is_other(new: Track, old: Track) -> bool:
    """Whether a patch is not what is left of a touch that goes."""
    return math.hypot(new.x - old.x, new.y - old.y) > STAYS_M and new.size > REST * old.size


def _new(number: int, seen: Patch, sample_ns: int, begins: bool = True, sure: bool = True) -> Track:
    track = Track(number, seen.x, seen.y, sample_ns, seen.size, seen.reach, begins=begins)
    track.last, track.confidences = [seen.x, seen.y, seen.size], [seen.confidence]
    if sure:
        track.sure, track.sure_frames = [seen.x, seen.y], 1
    return track


def _track(values: dict[str, Any]) -> Track:
    if "confidence" in values:  # of an earlier version
        values = {name: value for name, value in values.items() if name != "confidence"}
    return Track(**{**values, "inside": [_track(one) for one in values["inside"]]})
