"""The latest whole scans, and when they make a baseline: they agree, their noise is one that touches are told from, and
nothing touches. The first is taken as soon as that holds, others by the command `tare`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from models.measurement.arrays import Array, Indices, Mask
from models.measurement.numbers import LEAST_NOISE
from models.measurement.tables import FIELD_DEGREES, SkinTables
from models.prereconstruction import shrunk
from services.estimation.faults.wires import WireFault, WireKind
from services.estimation.initialisation.baseline import NoBaseline, agreement, identical, measured, untrained
from services.estimation.initialisation.start import EarlierBaseline, JudgedStart, StartSays, WiringTest, judge_start
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Judgement, judge
from services.estimation.values.scan import Scan

WIRED_AFTER = 2  # scans, after which wires are asked first; then every TARE_RETRIES

UNSURE = (
    "this skin differs from its bundle by as much as a touch may make: see that nothing touches it and run `skin tare` "
    "once"
)
PRESSED = "something touches the skin, and has since the start: free it; if nothing touches it, run `skin tare{}`"


class AgreedScans(NamedTuple):
    """Scans of an untouched skin."""

    log_z0: Array  # (K,) mean; where a measurement failed, what the bundle predicts
    live: Mask  # (K,) measurements that none of the scans lacks: the others count not before the next tare
    residuals: Array  # (n, K) less that and an even trend
    at_s: float  # of the mean
    parts: tuple[int, ...]  # with which each ended
    least_white: float  # variance of the noise that is assumed at least
    judgements: tuple[Judgement, ...]

    @property
    def scatter(self) -> Array:
        """(K,) standard deviation from scan to scan: each measurement's own and that of all, as few scans tell it."""
        own = self.residuals.var(axis=0, ddof=1)
        variance = shrunk(own, float(np.median(own[self.live])), len(self.residuals))
        return np.asarray(np.sqrt(np.maximum(variance, max(self.least_white, LEAST_NOISE**2))))


@dataclass
class LatestScansState:
    """All that changes."""

    log_z: list[Annotated[Array, "K", "gaps"]] = field(default_factory=list)  # NaN where a measurement failed
    at_s: list[float] = field(default_factory=list)
    parts: list[int] = field(default_factory=list)  # with which each ended
    seen: int = 0  # scans that came
    tried: int = 0  # `seen` when a first baseline was tried
    wired: int = 0  # `seen` when the wires were asked


class LatestScans:
    """Scans that follow each other."""

    def __init__(self, needed: int) -> None:
        """needed: scans of a baseline."""
        self.now, self.needed = LatestScansState(), needed

    def __len__(self) -> int:
        return len(self.now.log_z)

    def add(self, log_z: Array, at_s: float, part: int) -> None:
        now = self.now
        now.log_z.append(log_z)
        now.at_s.append(at_s)
        now.parts.append(part)
        now.seen += 1
        for each in (now.log_z, now.at_s, now.parts):
            del each[: -self.needed]

    def clear(self) -> None:
        """What comes does not follow on what came."""
        self.now.log_z, self.now.at_s, self.now.parts = [], [], []

    @property
    def due(self) -> bool:
        """Whether a first baseline is to be tried with this scan."""
        now = self.now
        return len(self) == self.needed and now.seen % n.TARE_RETRIES == 0 and now.seen != now.tried

    @property
    def wires_due(self) -> bool:
        """Whether the wires are to be asked with this scan."""
        now = self.now
        return len(self) >= WIRED_AFTER and now.seen % n.TARE_RETRIES == WIRED_AFTER and now.seen != now.wired

    def mean(self) -> tuple[Array, Array, Mask]:
        """(K,) log |Z|, 0 where none of the scans has it; (K,) variance of that; (K,) what counts."""
        scans = np.stack(self.now.log_z)
        live: Mask = np.asarray(np.isfinite(scans).all(axis=0))
        scans = np.where(live, scans, 0.0)
        together = float(np.median(scans[:, live].var(axis=0, ddof=1))) if live.any() else 0.0
        variance = np.full(len(live), max(together, LEAST_NOISE**2) / len(scans))
        return scans.mean(axis=0), variance, live

    def agreed(self, tables: SkinTables, order: Indices | None = None) -> AgreedScans:
        """Raises NoBaseline where there are too few, or they do not agree. order (K,): the value that each measurement
        would show if no wires were exchanged; None: its own.
        """
        if len(self) < self.needed:
            raise NoBaseline(f"only {len(self)} of {self.needed} frames came so far: wait, or look at `skin top`")
        scans = np.stack(self.now.log_z)
        scans = scans if order is None else scans[:, order]
        live, noise = measured(scans)
        slopes = np.array(FIELD_DEGREES) <= 1
        field = tables.field[np.ix_(live, slopes)]
        found = agreement(without_drift(scans[:, live], field))
        if not found.holds and tables.predicted:
            steady = scans.copy()
            steady[:, live] = without_jumps(scans[:, live], tables.contact[live])
            again = agreement(without_drift(steady[:, live], field))
            scans, found = (steady, again) if again.holds else (scans, found)
        if not found.holds:
            raise NoBaseline(str(found))
        judgements = [judge("agrees", *found), judge("identical", n.TARE_IDENTICAL, max(noise, 1e-300))]
        if tables.predicted:  # a measured bundle knows its own noise
            judgements.append(judge("noise_trained", noise, n.TARE_UNTRAINED))
        white = float(n.TARE_ASSUMED**2) if noise < n.TARE_IDENTICAL else 0.0
        mean = np.where(live, scans, 0.0).mean(axis=0)
        predicted = np.log(tables.z0)
        log_z0 = np.where(live, mean, predicted + float(np.median((mean - predicted)[live])))
        slope = np.linspace(-1, 1, len(scans))
        off = np.where(live, scans - log_z0, 0.0)
        residuals = off - slope[:, None] * (slope @ off / (slope @ slope))
        at_s, parts = float(np.mean(self.now.at_s)), tuple(self.now.parts)
        return AgreedScans(log_z0, live, residuals, at_s, parts, white, tuple(judgements))


def without_drift(scans: Array, field: Array) -> Array:
    """(n, K) scans less what the sheet drifts evenly over their time, up to TARE_DRIFTS; field (K, n): its columns."""
    slope = np.linspace(-1, 1, len(scans))
    each = slope @ (scans - scans.mean(axis=0)) / (slope @ slope)
    drift = np.linalg.lstsq(field, each, rcond=None)[0]
    drift *= n.TARE_DRIFTS / max(float(np.linalg.norm(drift)), n.TARE_DRIFTS)
    return np.asarray(scans - slope[:, None] * (field @ drift))


def without_jumps(scans: Array, contact: Array) -> Array:
    """(n, K) scans less what contact impedances change by from one to the next, up to TARE_JUMPS each; contact (K, E):
    their columns. Else the baseline of a skin whose contacts jump would never be taken.
    """
    off = scans - scans.mean(axis=0)
    jumps = np.linalg.lstsq(contact, off.T, rcond=None)[0]
    return np.asarray(scans - (contact @ np.clip(jumps, -n.TARE_JUMPS, n.TARE_JUMPS)).T)


@dataclass
class TaringState:
    """All that changes beside the scans."""

    untouched: int = 0  # whole scans since the last touch
    touched: bool = False  # by the latest one
    judgements: tuple[Judgement, ...] = ()  # of the baseline, or of why there is none
    doubted: bool = False  # the baseline's word against a touch counts for nothing
    surely: bool = False  # a touch explains the first scans
    pressed: Annotated[Array | None, "K"] = None  # log |Z| of the first scans, as they were judged touched
    problem: str = ""  # what stands in the way of valid frames, for a person
    wire: WireFault | None = None  # before the first baseline


class Taring:
    """Of one skin; tables: of its bundle."""

    def __init__(self, tables: SkinTables, needed: int) -> None:
        """needed: scans of a baseline."""
        self.latest, self.now = LatestScans(needed), TaringState()
        self.use(tables)

    def use(self, tables: SkinTables) -> None:
        """Of the same skin, known better: what its scans were judged by is another one."""
        self.now.pressed = None
        self._tables, self._wires = tables, WiringTest(tables)

    def offer(self, scan: Scan, live: Mask, middle_s: float) -> None:
        """A whole scan; live (K,): what of it was measured; middle_s: when. One that is not believed interrupts."""
        if not scan.believed:
            self.latest.clear()
            return
        self.latest.add(np.log(np.where(live, scan.values, np.nan)), middle_s, scan.part)

    def adopted(self, doubt: str = "") -> None:
        """A baseline of before is used."""
        self.now, self.latest = TaringState(doubted=bool(doubt), problem=doubt), LatestScans(self.latest.needed)
        if doubt:
            self.now.judgements = (judge("baseline", 1.0, 1.0),)

    def observe(self, touched: bool) -> None:
        """Whether something touched in the latest whole scan."""
        self.now.touched = touched
        self.now.untouched = 0 if touched else self.now.untouched + 1

    def first(self, earlier: EarlierBaseline | None = None) -> AgreedScans | None:
        """The scans of a first baseline as soon as there is one. earlier: a baseline without doubt, if one is known.
        Where wires are exchanged each measurement is there, in another's place: such scans do as well.
        """
        if self.latest.wires_due:
            self.latest.now.wired = self.latest.now.seen
            self.now.wire = self._wires(*self.latest.mean())
        if not self.latest.due:
            return None
        self.latest.now.tried = self.latest.now.seen
        wire = self.now.wire
        if wire is not None and wire.kind is not WireKind.EXCHANGED:
            self.now.problem = "no baseline yet: wires of the board are wrong"
            return None
        try:
            scans = self.latest.agreed(self._tables, None if wire is None else self._wires.maps.order(wire))
        except NoBaseline as why:
            self.now.problem = f"no baseline yet: {why}"
            return None
        if not self._still_pressed(scans):
            start = self._judged(scans, earlier)
            self.now.judgements, self.now.surely = (*scans.judgements, *start.judgements), start.sure
            if start.says is not StartSays.TOUCHED:
                self._taken(scans, start)
                return scans
            self.now.pressed = scans.log_z0
        self.now.problem = PRESSED.format(" --force" * self.now.surely)
        return None

    def _still_pressed(self, scans: AgreedScans) -> bool:
        """Whether they are those that were judged touched, within one scan's noise: the same would be said again."""
        if self.now.pressed is None:
            return False
        return bool(np.abs((scans.log_z0 - self.now.pressed) / scans.scatter)[scans.live].max(initial=0.0) < 1)

    def _judged(self, scans: AgreedScans, earlier: EarlierBaseline | None) -> JudgedStart:
        variance = (scans.residuals**2).mean(axis=0) / len(scans.residuals)
        return judge_start(self._tables, scans.log_z0, variance, scans.live, earlier)

    def by_command(self, force: bool, unexplained_s: float | None) -> AgreedScans:
        """The latest scans, whatever the baseline was. Raises NoBaseline, while something touches unless forced.
        unexplained_s: for which the baseline has not explained the skin; None: there is none.
        """
        now, needed = self.now, self.latest.needed
        if now.surely and not force:
            raise NoBaseline(PRESSED.format(" --force"))
        lost = unexplained_s is not None and unexplained_s > n.LOST_S
        believed = unexplained_s is not None and not lost and not now.doubted
        if believed and not force and len(self.latest) == needed:
            if now.touched:
                raise NoBaseline("the skin is touched: free it and try again (or --force, if nothing touches it)")
            if now.untouched < needed:
                few = f"only {now.untouched} of {needed} untouched frames since the last touch"
                raise NoBaseline(f"{few}: wait and try again")
        scans = self.latest.agreed(self._tables)
        if lost and not force and self._judged(scans, None).sure:
            raise NoBaseline(PRESSED.format(" --force"))
        # Whoever gives the command has looked: no doubt, but that of noise, which looking does not mend.
        now.judgements = tuple(each for each in scans.judgements if each.name != "identical")
        self._taken(scans, None)
        return scans

    def judgements(self, tared: bool) -> list[Judgement]:
        """Rows of every scan; tared: whether there is a baseline."""
        rows = list(self.now.judgements)
        if not tared and not any(each.name == "start" and each.ratio >= 1 for each in rows):
            rows.insert(0, judge("baseline", self.latest.needed, max(len(self.latest), 1)))
        return rows

    def _taken(self, scans: AgreedScans, start: JudgedStart | None) -> None:
        now = self.now
        now.surely, now.untouched, now.touched, now.problem, now.pressed = False, 0, False, "", None
        turned = {each.name: each.statistic for each in now.judgements if each.ratio >= 1}
        now.doubted = bool(turned)
        if "noise_trained" in turned:
            now.problem = untrained(turned["noise_trained"])
        elif "identical" in turned:
            now.problem = identical(len(scans.residuals))
        elif start is not None and start.says is StartSays.UNKNOWN:
            now.problem = UNSURE
