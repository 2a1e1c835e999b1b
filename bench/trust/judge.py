"""Contact frames held against what really touched at their `sample`."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.trust.scene import RECOVERS_S, Trouble, TrustScene
from bench.trust.score import TrustScore
from firmware_stub.sheet import Sheet
from protocol.frames import Contact, ContactFrame
from simulation.truth import FAR_M, SCAN_S, Pressed, TruePath, TruePaths, lasting, nearest, unshown

SAME_M = 0.010  # a contact so near a touch is its
WRONG_S = 0.1  # a count that is wrong for so long is one incident
HIDDEN_S = 0.3
LONG_S = 0.5  # a touch of this length must be shown
PAUSE_S = 0.15  # between two valid frames: what lies between is not judged
WELL_FRAMES = 5  # valid ones in a row: all is well again
PLACE_SIGMAS = {3: 3.44, 6: 6.33}  # radius, in sigma, beyond which as few of a plane's places lie as of a line's
FORCE_SIGMAS = {3: 3.0, 6: 6.0}
CLIPPED = 10.0  # sigma: an error beyond counts so much in the log score
CHAIN_S = 0.003  # from a raw frame read to its contact frame published
FAULT_NAMES = frozenset(
    ("electrode_drift", "electrode_open", "electrode_short", "electrode_swapped", "multiplexer", "gain", "saturated")
)


class Judge:
    """Judges the frames of one session in their order; `finish` gives the score."""

    def __init__(self, scene: TrustScene, sheet: Sheet | None = None, name: str = "") -> None:
        self.scene, self.truth, self.name = scene, TruePaths(scene.script.tracks, sheet), name
        self.score = TrustScore(sessions=1, seconds=scene.seconds)
        self._then = -np.inf  # sample of the last valid frame
        self._wrong_s = self._phantom_then = 0.0
        self._hidden_s: dict[int, float] = {}
        self._ids: dict[int, int] = {}
        self._shown: set[int] = set()
        self._named: dict[int, float] = {}
        self._well: dict[int, tuple[float, int]] = {}  # trouble -> valid again since when, for how many frames
        self._back: dict[int, float] = {}

    def look(self, read_s: float, frame: ContactFrame, refused: bool) -> None:
        """One frame, read at read_s; refused: the image that it stands on is not valid."""
        sample_s = frame.stamps["sample"] * 1e-9
        if sample_s < self.scene.begin:
            return
        shown = lasting(frame)
        true = self.truth.at(sample_s)
        self.score.counts["frames"] += 1
        self._shares(sample_s, frame, true)
        self._names(sample_s, frame)
        self._recovers(read_s, frame.valid)
        if not frame.valid:
            return
        self._count(refused and bool(shown), "refused", read_s, "a contact stands on a refused image")
        aged = read_s + CHAIN_S - sample_s > frame.valid_for_s
        self._count(aged, "aged", read_s, f"{read_s - sample_s:.3f} s old, valid for {frame.valid_for_s:.3f} s")
        passed = sample_s - self._then if sample_s - self._then < PAUSE_S else 0.0
        self._then = max(self._then, sample_s)
        self._phantoms(sample_s, shown, self.truth.way(sample_s - SCAN_S, sample_s + SCAN_S / 2))
        self._number(sample_s, passed, shown)
        self._briefly(sample_s, shown)
        self._missing(sample_s, passed, shown)
        for contact, there in _pairs(shown, true):
            self._errors(sample_s, contact, there)

    def heard(self, at_s: float, problem: str) -> None:
        """What acquisition said of the board from then on; "": that all is well."""
        for n, trouble in enumerate(self.scene.troubles):
            if problem and trouble.board and _lasts(trouble, at_s):
                self._named[n] = min(at_s, self._named.get(n, at_s))

    def finish(self) -> TrustScore:
        counts = self.score.counts
        long = [path for path in self.truth.paths if path.end - path.begin >= LONG_S]
        counts["touches"] += len(self.truth.paths)
        counts["never shown"] += sum(path.number not in self._shown for path in long)
        for n, trouble in enumerate(self.scene.troubles):
            if trouble.end < self.scene.seconds:
                self._ended(n, trouble)
        return self.score

    def _ended(self, n: int, trouble: Trouble) -> None:
        """Was it named, and in time; were frames valid again in time?"""
        counts = self.score.counts
        if trouble.nameable:
            counts["faults"] += 1
            counts["named"] += n in self._named
            counts["named late"] += self._named.get(n, trouble.begin) > trouble.begin + trouble.within_s
            if n not in self._named:
                self._note(trouble.begin, f"{trouble.what}, {trouble.situation}: not named")
        if trouble.recovers_s is None:
            return
        back_s = self._back.get(n, np.inf)
        counts["ended"] += 1
        counts["back late"] += back_s > trouble.recovers_s
        self.score.sums["back s"] += np.minimum(back_s, 2 * trouble.recovers_s)
        if back_s > trouble.recovers_s:
            self._note(trouble.end, f"{trouble.what}, {trouble.situation}: valid again after {back_s:.1f} s")

    # --- what hiding would show ---

    def _shares(self, t: float, frame: ContactFrame, true: list[Pressed]) -> None:
        counts, kind = self.score.counts, "touched" if true else "untouched"
        if self.scene.nothing_wrong(t):
            counts[kind] += 1
            counts[f"{kind} valid"] += frame.valid
            if true and frame.valid:
                counts["changing"] += "changing" in frame.reasons
                counts["coarse"] += "coarse" in frame.reasons
        for trouble in self.scene.troubles:
            if trouble.begin <= t <= trouble.end:
                for name in ("", f"/{trouble.what}"):
                    counts[f"in fault{name}"] += 1
                    counts[f"in fault valid{name}"] += frame.valid

    def _names(self, t: float, frame: ContactFrame) -> None:
        said = set(frame.reasons)
        troubles = [(n, each) for n, each in enumerate(self.scene.troubles) if _lasts(each, t)]
        for n, trouble in troubles:
            if said & set(trouble.names):
                self._named.setdefault(n, t)
        if not troubles and said & FAULT_NAMES:
            self.score.counts["named falsely"] += 1
            for name in said & FAULT_NAMES:
                self.score.counts[f"named falsely/{name}"] += 1

    def _recovers(self, read_s: float, valid: bool) -> None:
        for n, trouble in enumerate(self.scene.troubles):
            if trouble.recovers_s is None or n in self._back or read_s < trouble.end:
                continue
            since, frames = self._well.get(n, (read_s, 0))
            self._well[n] = since, frames + 1
            if not valid:
                self._well.pop(n)
            elif frames + 1 == WELL_FRAMES:
                self._back[n] = since - trouble.end

    # --- what must not be ---

    def _phantoms(self, t: float, shown: list[Contact], way: list[Pressed]) -> None:
        wrong = [contact for contact in shown if nearest(contact, way) > FAR_M]
        if not wrong:
            return
        self.score.counts["phantom"] += 1
        if t - self._phantom_then > PAUSE_S:
            self.score.counts["phantom incidents"] += 1
            place = ", ".join(f"{1e3 * v:+.0f}" for v in wrong[0].on_sheet)
            self._note(t, f"phantom at ({place}) mm, {wrong[0].force_n or 0:.1f} N")
        self._phantom_then = t

    def _number(self, t: float, passed: float, shown: list[Contact]) -> None:
        """The touches that press fully must be counted, those that begin or end may be."""
        lately = self.truth.around(t - WRONG_S, t + SCAN_S / 2)
        least = sum(self._fully(path, t) for path in lately)
        before, self._wrong_s = self._wrong_s, self._wrong_s + passed
        if least <= len(shown) <= len(lately):
            self._wrong_s = 0.0
        elif before < WRONG_S <= self._wrong_s:
            self.score.counts["wrong count"] += 1
            self._note(t, f"{len(shown)} contacts of {least} to {len(lately)} touches for {WRONG_S} s")

    def _briefly(self, t: float, shown: list[Contact]) -> None:
        """Does this frame hide a touch that pressed during all of the scan on which it stands, and not for so long that
        `_missing` counts it?
        """
        for path in self.truth.around(t, t):
            there = path.at(t)
            if there is None or not self._fully(path, t, SCAN_S) or self._hidden_s.get(path.number, 0.0) >= HIDDEN_S:
                continue
            if unshown(there, shown):
                self.score.counts["hidden briefly"] += 1
                self.score.counts["hidden briefly, none shown"] += not shown
                return

    def _missing(self, t: float, passed: float, shown: list[Contact]) -> None:
        for path in self.truth.around(t, t):
            there = path.at(t)
            if there is None or path.end - path.begin < LONG_S or not self._fully(path, t):
                self._hidden_s.pop(path.number, None)
                continue
            if not unshown(there, shown):
                self._hidden_s[path.number] = 0.0
                self._shown.add(path.number)
                continue
            before = self._hidden_s.get(path.number, 0.0)
            self._hidden_s[path.number] = before + passed
            if before < HIDDEN_S <= before + passed:
                self.score.counts["hidden"] += 1
                self._note(t, f"{there.force_n:.1f} N at ({1e3 * there.x:+.0f}, {1e3 * there.y:+.0f}) mm hidden")

    def _fully(self, path: TruePath, t: float, since_s: float = WRONG_S) -> bool:
        return path.fully(t - since_s, t, t + SCAN_S / 2)

    def _errors(self, t: float, contact: Contact, there: Pressed) -> None:
        """Of a contact and the touch that it shows."""
        self._shown.add(there.number)
        if self._ids.setdefault(there.number, contact.id) != contact.id:
            self.score.counts["id changed"] += 1
            self._ids[there.number] = contact.id
        phase = self.truth.paths[there.number].phase(t)
        if contact.force_n is not None and contact.force_sigma_n:
            error = abs(contact.force_n - there.force_n) / contact.force_sigma_n
            self._error("force", phase, error, contact.force_sigma_n, FORCE_SIGMAS, 1)
            if error > 6:
                said = f"{contact.force_n:.2f} +- {contact.force_sigma_n:.2f} N"
                self._note(t, f"{phase}: {said} of {there.force_n:.2f} N")
        if contact.position_sigma is not None:
            long, short = (max(sigma, 1e-6) for sigma in contact.position_sigma[:2])
            c, s = np.cos(contact.position_sigma[2]), np.sin(contact.position_sigma[2])
            x, y = contact.on_sheet[0] - there.x, contact.on_sheet[1] - there.y
            error = float(np.hypot((c * x + s * y) / long, (c * y - s * x) / short))
            self._error("place", phase, error, float(np.sqrt(long * short)), PLACE_SIGMAS, 2)

    def _error(self, of: str, phase: str, error: float, sigma: float, limits: dict[int, float], axes: int) -> None:
        counts = self.score.counts
        counts[f"{of} n/{phase}"] += 1
        for name, limit in limits.items():
            counts[f"{of} {name}/{phase}"] += error > limit
        self.score.sigma(of, phase, sigma)
        self.score.sums[f"{of} log"] -= axes * np.log(sigma) + min(error, CLIPPED) ** 2 / 2

    # --- notes ---

    def _count(self, wrong: bool, what: str, t: float, text: str) -> None:
        if wrong:
            self.score.counts[what] += 1
            self._note(t, f"{what}: {text}")

    def _note(self, t: float, text: str) -> None:
        lately = (each for each in self.scene.troubles if each.begin <= t <= each.end + RECOVERS_S)
        last = max(lately, key=_begin, default=None)
        after = f", {last.what} ({last.situation or 'link'}) since {last.begin:.2f} s" if last is not None else ""
        if len(self.score.notes) < 20:
            self.score.notes.append(f"{self.name} {t:.2f} s: {text}{after}")


def _begin(trouble: Trouble) -> float:
    return trouble.begin


def _lasts(trouble: Trouble, t: float) -> bool:
    """While it may be named without being false."""
    return trouble.what != "none" and trouble.begin - SCAN_S <= t <= trouble.end + RECOVERS_S


def _pairs(shown: list[Contact], true: list[Pressed]) -> list[tuple[Contact, Pressed]]:
    """Each contact and the touch that is its, by the least sum of distances."""
    if not shown or not true:
        return []
    far = np.array([[there.far(contact) for there in true] for contact in shown])
    rows, columns = linear_sum_assignment(far)
    return [(shown[i], true[j]) for i, j in zip(rows, columns, strict=True) if far[i, j] <= SAME_M]
