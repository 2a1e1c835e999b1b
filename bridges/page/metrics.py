"""What /metrics says to Prometheus: an ordinary subscriber counts contacts and keeps what each process last said.

What is not known now is left out: a gauge of contacts, forces, electrodes or noise is there only while its frame may be
acted on, or may be shown. Times are in seconds, whatever unit a frame has them in.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
    UnknownMetricFamily,
)
from prometheus_client.registry import Collector

from protocol import views
from protocol.ages import Ages
from protocol.frame_types import ELECTRODE_STATES
from protocol.frames import ContactFrame, DeltaFrame, StatusFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader, NewestReader

LOOK_S = 0.2
"""How often `look` is to be called; between two, what comes waits in the socket."""
AT_ONCE = 1000
LEVELS = ("OK", "WARN", "ERROR", "STALE")
BUCKETS_S = (0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.5, 1.0)
QUANTILES = {"p50": 0.5, "p99": 0.99}
MOST_NAMES, MOST_PROCESSES = 64, 256
"""What one process may name, and processes in all: a label's values are bounded, whoever publishes."""


@dataclass
class SkinCounts:
    """Of one skin, since the page began."""

    frames: int = 0
    valid: int = 0
    begun: int = 0
    lost: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    latency: Counter[float] = field(default_factory=Counter)  # by upper bound; not yet cumulated
    latency_s: float = 0.0
    known: deque[tuple[str, int]] = field(default_factory=lambda: deque(maxlen=256))  # contacts counted already
    newest: ContactFrame | None = None
    measured_ns: int | None = None


class SkinMetrics(Collector):
    """`look` every LOOK_S; `text` when asked. Belongs to one thread."""

    def __init__(self, skins: Iterable[str]) -> None:
        self._of = {skin: SkinCounts() for skin in skins}
        self._statuses: dict[tuple[str, str], tuple[StatusFrame, float]] = {}
        self._reader = AllReader(["contact", "status"])
        self._deltas = {skin: NewestReader("delta", skin) for skin in self._of}
        self._delta: dict[str, DeltaFrame] = {}
        self._ages = Ages()
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def look(self) -> None:
        """Take in what has come."""
        for _ in range(AT_ONCE):
            frame = self._reader.recv(0.0)
            if frame is None:
                return
            if isinstance(frame, StatusFrame):
                key = frame.skin, frame.process
                if frame.skin in self._of and (key in self._statuses or len(self._statuses) < MOST_PROCESSES):
                    self._statuses[key] = frame, time.monotonic()
            elif isinstance(frame, ContactFrame) and frame.skin in self._of and frame.source != "replay":
                self._count(frame, self._of[frame.skin])

    def _count(self, frame: ContactFrame, of: SkinCounts) -> None:
        now = time.monotonic_ns()
        of.newest, of.measured_ns = frame, self._ages.measured_ns(frame, now)
        of.frames += 1
        of.valid += frame.valid
        of.reasons.update(reason for reason in frame.reasons if reason in of.reasons or len(of.reasons) < MOST_NAMES)
        of.lost = self._reader.lost[f"contact/{frame.skin}"]
        sample, publish = frame.stamps.get("sample"), frame.stamps.get("publish")
        if sample is not None and publish is not None and publish >= sample:
            seconds = (publish - sample) * 1e-9
            of.latency[next((bound for bound in BUCKETS_S if seconds <= bound), float("inf"))] += 1
            of.latency_s += seconds
        for contact in views.present(frame) if frame.valid else ():
            if (frame.session, contact.id) not in of.known:
                of.known.append((frame.session, contact.id))
                of.begun += 1

    def text(self) -> bytes:
        """As Prometheus reads it."""
        self.look()
        return generate_latest(self._registry)

    def describe(self) -> Iterator[Metric]:
        """Nothing is known of them before they are asked for."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """All there is to say now."""
        yield from self._counted()
        yield from self._present()
        yield from self._scanned()
        yield from self._processes()

    def _counted(self) -> Iterator[Metric]:
        skin = ["skin"]
        frames = CounterMetricFamily("eitskin_frames", "contact frames heard", labels=skin)
        valid = CounterMetricFamily("eitskin_frames_valid", "those that could be acted on", labels=skin)
        lost = CounterMetricFamily("eitskin_frames_lost", "contact frames that were sent and not heard", labels=skin)
        begun = CounterMetricFamily("eitskin_contacts_begun", "contacts that began", labels=skin)
        why = CounterMetricFamily("eitskin_frames_reason", "contact frames with this reason", labels=["skin", "reason"])
        latency = HistogramMetricFamily(
            "eitskin_latency_seconds", "from the middle of the scan to its contacts being published", labels=skin
        )
        for name, of in self._of.items():
            for family, value in ((frames, of.frames), (valid, of.valid), (lost, of.lost), (begun, of.begun)):
                family.add_metric([name], value)
            for reason, count in of.reasons.items():
                why.add_metric([name, reason], count)
            so_far, buckets = 0, []
            for bound in (*BUCKETS_S, float("inf")):
                so_far += of.latency[bound]
                buckets.append((f"{bound:g}" if np.isfinite(bound) else "+Inf", float(so_far)))
            latency.add_metric([name], buckets=buckets, sum_value=of.latency_s)
        yield from (frames, valid, lost, begun, why, latency)

    def _present(self) -> Iterator[Metric]:
        """Contacts and forces, of a frame that may be acted on; and whether there is one."""
        skin = ["skin"]
        fresh = GaugeMetricFamily("eitskin_contacts_usable", "1: the newest contacts may be acted on now", labels=skin)
        age = GaugeMetricFamily("eitskin_age_seconds", "since the newest contacts were measured", labels=skin)
        contacts = GaugeMetricFamily("eitskin_contacts", "contacts now", labels=skin)
        force = GaugeMetricFamily("eitskin_force_newtons", "sum of the contacts' forces", labels=skin)
        sure = GaugeMetricFamily("eitskin_force_sigma_newtons", "its standard uncertainty", labels=skin)
        for name, of in self._of.items():
            frame = of.newest
            seconds = None if of.measured_ns is None else self._ages.age_s(of.measured_ns)
            usable = frame is not None and frame.valid and seconds is not None and seconds <= frame.valid_for_s
            fresh.add_metric([name], float(usable))
            if seconds is not None:
                age.add_metric([name], seconds)
            if frame is None or not usable:
                continue
            touching = views.present(frame)
            contacts.add_metric([name], len(touching))
            if views.has_forces(frame):
                force.add_metric([name], sum(c.force_n or 0.0 for c in touching))
                sure.add_metric([name], sum((c.force_sigma_n or 0.0) ** 2 for c in touching) ** 0.5)
        yield from (fresh, age, contacts, force, sure)

    def _scanned(self) -> Iterator[Metric]:
        """Electrodes and noise, of a scan that is not older than its contacts may be."""
        ok = GaugeMetricFamily("eitskin_electrode_ok", "1: well, 0: not", labels=["skin", "electrode"])
        states = GaugeMetricFamily("eitskin_electrodes", "electrodes in this state", labels=["skin", "state"])
        noise = GaugeMetricFamily("eitskin_noise_ratio", "noise of a measurement, relative, median", labels=["skin"])
        for name, reader in self._deltas.items():
            frame = reader.recv(0.0)
            if isinstance(frame, DeltaFrame):
                self._delta[name] = frame
            found = self._delta.get(name)
            measured = None if found is None else self._ages.measured_ns(found, time.monotonic_ns())
            if found is None or measured is None or self._ages.age_s(measured) > found.valid_for_s:
                continue
            said = [ELECTRODE_STATES[s] if s < len(ELECTRODE_STATES) else "unknown" for s in found.electrodes.tolist()]
            for number, state in enumerate(said):
                ok.add_metric([name, str(number)], float(state == "ok"))
            for state in ELECTRODE_STATES:
                states.add_metric([name, state], said.count(state))
            used = found.sigma[np.isfinite(found.sigma)]
            if used.size and found.source != "replay":
                noise.add_metric([name], float(np.median(used)))
        yield from (ok, states, noise)

    def _processes(self) -> Iterator[Metric]:
        of = ["skin", "process"]
        level = GaugeMetricFamily("eitskin_process_level", "0 OK, 1 WARN, 2 ERROR, 3 STALE or silent", labels=of)
        cpu = GaugeMetricFamily("eitskin_process_cpu_cores", "share of a core used", labels=of)
        rate = GaugeMetricFamily("eitskin_process_rate_hertz", "frames a second", labels=[*of, "topic"])
        late = GaugeMetricFamily(
            "eitskin_process_latency_seconds", "from the middle of the scan", labels=[*of, "quantile"]
        )
        work = GaugeMetricFamily("eitskin_process_work_seconds", "of one frame", labels=[*of, "quantile"])
        drops = CounterMetricFamily("eitskin_process_dropped", "frames lost or skipped", labels=[*of, "cause"])
        other = UnknownMetricFamily("eitskin_process_count", "what else it counts", labels=[*of, "what"])
        for (skin, process), (frame, heard_s) in self._statuses.items():
            key = [skin, process]
            here = frame.host in ("", host_id()) and "publish" in frame.stamps
            quiet_s = time.monotonic() - (frame.stamps["publish"] * 1e-9 if here else heard_s)
            silent = quiet_s > frame.valid_for_s
            level.add_metric(key, LEVELS.index("STALE" if silent else frame.level))
            for cause, count in _some(frame.drops):
                drops.add_metric([*key, cause], count)
            for what, number in _some(frame.counters):
                other.add_metric([*key, what], number)
            if silent:
                continue
            cpu.add_metric(key, frame.cpu)
            for topic, hertz in _some(frame.rates):
                rate.add_metric([*key, topic], hertz)
            for name, q in QUANTILES.items():
                for family, value in ((late, frame.latency.get(name)), (work, frame.latency.get(f"work_{name}"))):
                    if value is not None:
                        family.add_metric([*key, f"{q:g}"], value * 1e-3)
        yield from (level, cpu, rate, late, work, drops, other)

    def close(self) -> None:
        self._reader.close()
        self._ages.close()
        for reader in self._deltas.values():
            reader.close()


def _some(said: dict[str, float] | dict[str, int]) -> list[tuple[str, float]]:
    """As much of a map as may become labels."""
    return list(said.items())[:MOST_NAMES]
