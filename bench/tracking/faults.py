"""Electrode faults that the scene injected, and when each was named."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from bench.tracking.scene import Recorded
from bench.tracking.scores import StageOutput
from protocol.frames import ELECTRODE_STATES

OK = ELECTRODE_STATES.index("ok")
STATES = {
    "electrode_open": "open",
    "electrodes_shorted": "short",
    "electrodes_swapped": "swapped",
    "mux_stuck": "stuck",
    "mux_disabled": "open",
    "contact_drifts": "drifting",
}
RECOVERY = 22  # scans after a fault in which its electrodes may still be named


@dataclass(frozen=True)
class FaultEvent:
    """One fault, in the frames first to last (inclusive). electrodes: those concerned; empty: any that a stuck
    address bit reaches.
    """

    name: str
    args: dict[str, Any]
    first: int
    last: int
    section: str

    @property
    def electrodes(self) -> list[int]:
        if self.name == "electrodes_shorted" or self.name == "electrodes_swapped":
            return list(self.args["electrodes"])
        found = [self.args[key] for key in ("electrode", "second") if self.args.get(key, -1) >= 0]
        return found if self.name != "mux_disabled" else list(range(16))

    def named(self, seen: StageOutput) -> bool:
        """Each concerned electrode in its state; a multiplexer: some electrode, or the frame's reason."""
        state = ELECTRODE_STATES.index(STATES[self.name])
        if self.name.startswith("mux"):
            return "multiplexer" in seen.reasons or state in seen.electrodes
        return all(seen.electrodes[e] == state for e in self.electrodes)

    def marked(self, seen: StageOutput) -> bool:
        """Something is said to be wrong, if not what."""
        concerned = self.electrodes or range(len(seen.electrodes))
        return any(seen.electrodes[e] != OK for e in concerned) or not seen.valid


def events(recorded: Recorded) -> list[FaultEvent]:
    found: list[FaultEvent] = []
    open_: dict[str, tuple[int, str]] = {}  # first frame, arguments
    for k in range(len(recorded) + 1):
        now = json.loads(str(recorded.faults[k])) if k < len(recorded) else {}
        texts = {name: json.dumps(args, sort_keys=True) for name, args in now.items()}
        for name, (first, text) in list(open_.items()):
            if texts.get(name) != text:
                found.append(FaultEvent(name, json.loads(text), first, k - 1, str(recorded.sections[first])))
                del open_[name]
        for name, text in texts.items():
            open_.setdefault(name, (k, text))
    return sorted(found, key=lambda e: e.first)


def rows(recorded: Recorded, seen: Sequence[StageOutput]) -> list[dict[str, Any]]:
    """One row an event: scans until named and marked (1: the first one measured with it), and until all is well
    again.
    """
    found, all_events = [], events(recorded)
    for number, event in enumerate(all_events):
        during = seen[event.first : event.last + 1]
        until = all_events[number + 1].first if number + 1 < len(all_events) else len(seen)
        after = seen[event.last + 1 : until]
        others = [e for e in range(16) if event.electrodes and e not in event.electrodes]
        found.append(
            {
                "fault": event.name,
                "args": event.args,
                "at_s": float(recorded.seconds[event.first]),
                "frames": len(during),
                "named": _first(during, event.named),
                "named_%": 100 * sum(event.named(s) for s in during) / len(during),
                "marked": _first(during, event.marked),
                "well_again": _first(after, lambda s: s.valid and not any(s.electrodes)),
                "others_named_frames": sum(any(s.electrodes[e] != OK for e in others) for s in during),
                "valid_%": 100 * sum(s.valid for s in during) / len(during),
                "electrodes_said": _said(during),
            }
        )
    return found


def false_alarms(recorded: Recorded, seen: Sequence[StageOutput]) -> int:
    """Frames that name an electrode while no fault is in force, nor was lately."""
    quiet, count = RECOVERY + 1.0, 0
    for k, s in enumerate(seen):
        quiet = 0 if recorded.faults[k] != "{}" else quiet + s.scans
        count += quiet > RECOVERY and any(e != OK for e in s.electrodes)
    return count


def _first(seen: Sequence[StageOutput], says: Callable[[StageOutput], bool]) -> int | None:
    """Scans up to the first frame that says so."""
    passed = 0.0
    for s in seen:
        passed += s.scans
        if says(s):
            return math.ceil(round(passed, 3))
    return None


def _said(during: Sequence[StageOutput]) -> dict[str, int]:
    """What was said of which electrode, in how many frames."""
    said: dict[str, int] = {}
    for s in during:
        for e, state in enumerate(s.electrodes):
            if state != OK:
                key = f"{e} {ELECTRODE_STATES[state]}"
                said[key] = said.get(key, 0) + 1
    return dict(sorted(said.items(), key=lambda item: -item[1])[:8])
