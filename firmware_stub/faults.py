"""What can go wrong with the board: the table of faults, and those in force.

A fault lasts for its seconds; one marked `sticky` lasts until the board is power-cycled (`power_cycle`, `unplug`). The
code that a fault disturbs asks `Faults.active(name)` at that point and nowhere else.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

MUXES = ("drive+", "drive-", "sense+", "sense-")


@dataclass(frozen=True)
class Fault:
    """One row: what the host gets to see, the arguments with their defaults, and what is said of it while it lasts."""

    what: str
    says: str
    args: Mapping[str, Any] = field(default_factory=dict)
    sticky: bool = False

    def said(self, args: Mapping[str, Any]) -> str:
        """What is the matter, for a person; args: all of them."""
        second = args.get("second", -1)
        return self.says.format(**args) + (f", and that of electrode {second}" if second >= 0 else "")


FAULTS: dict[str, Fault] = {
    # the chip
    "wrong_chip_id": Fault(
        "the converter answers with `id` (0x0000, 0xFFFF or 0xA0A0 on real boards): START and SELF_TEST are refused",
        "the converter answers with a wrong id, {id:#06x}",
        {"id": 0xFFFF},
        sticky=True,
    ),
    "brown_out": Fault(
        "the registers are lost: no excitation, all measurements noise, until CONFIG comes; with `silent` no EVENT",
        "the converter has lost its registers",
        {"silent": False},
        sticky=True,
    ),
    "stale_rtia": Fault(
        "RTIA is not what was calibrated: all impedances times `gain`, turned by `phase` rad",
        "RTIA is not what was calibrated: impedances times {gain:g}, turned by {phase:g} rad",
        {"gain": 1.05, "phase": 0.02},
    ),
    "gain": Fault(
        "an amplifier's gain jumps between two scans: all impedances times `factor`, nothing else, no status bits",
        "an amplifier's gain has jumped: impedances times {factor:g}",
        {"factor": 1.006},
    ),
    "clipped": Fault(
        "the voltage channel is `gain` times too sensitive and clips: plausible, low Z; with `silent` no status bits",
        "the voltage channel is {gain:g} times too sensitive, and clips",
        {"gain": 4.0, "silent": False},
    ),
    "rtia_overrange": Fault(
        "the current channel clips: Z too high; with `silent` no status bits",
        "the current channel is {gain:g} times too sensitive, and clips",
        {"gain": 1.6, "silent": False},
    ),
    "missed_interrupt": Fault(
        "a `fraction` of the results is read too early and is the one before; with `silent` no status bits",
        "a share of {fraction:g} of the results is read too early",
        {"fraction": 0.02, "silent": False},
    ),
    "fifo_overflow": Fault(
        "`words` are lost in the middle of a scan, the rest moves up",
        "{words} words are lost in the middle of each scan",
        {"words": 4, "silent": False},
    ),
    "fifo_underflow": Fault(
        "the last `words` of a scan never come: zeros",
        "the last {words} words of each scan never come",
        {"words": 8, "silent": False},
    ),
    "fifo_misaligned": Fault(
        "all words are one late: real and imaginary parts, V and I change places",
        "all words of a scan are one late",
        {"silent": False},
    ),
    # electrodes and multiplexers
    "electrode_open": Fault(
        "the wire of `electrode` (and of `second`) is broken: no current, a floating voltage",
        "the wire of electrode {electrode} is broken",
        {"electrode": 0, "second": -1},
    ),
    "electrodes_shorted": Fault(
        "the wires of two `electrodes` touch each other",
        "the wires of electrodes {electrodes[0]} and {electrodes[1]} touch each other",
        {"electrodes": [0, 1]},
    ),
    "electrodes_swapped": Fault(
        "the wires of two `electrodes` are exchanged",
        "the wires of electrodes {electrodes[0]} and {electrodes[1]} are exchanged",
        {"electrodes": [0, 1]},
    ),
    "mux_stuck": Fault(
        "an address `bit` of one multiplexer (drive+, drive-, sense+, sense-) stays at `value`: rows repeat",
        "address bit {bit} of the multiplexer {mux} stays at {value}",
        {"mux": "drive+", "bit": 2, "value": 0},
    ),
    "mux_disabled": Fault(
        "one multiplexer's enable stays low: nothing is connected, all open",
        "the multiplexer {mux} is off: nothing is connected",
        {"mux": "drive+"},
    ),
    # the link
    "partial_frames": Fault(
        "a `fraction` of the frames ends in the middle",
        "a share of {fraction:g} of the messages ends in the middle",
        {"fraction": 0.3},
    ),
    "sequence_gaps": Fault(
        "a `fraction` of the scans is never sent",
        "a share of {fraction:g} of the scans is never sent",
        {"fraction": 0.2},
    ),
    "late_frames": Fault(
        "a `fraction` of the messages arrives `by` s later, after others",
        "a share of {fraction:g} of the messages arrives {by:g} s late",
        {"fraction": 0.1, "by": 0.02},
    ),
    "repeated_frames": Fault(
        "a `fraction` of the messages arrives twice",
        "a share of {fraction:g} of the messages arrives twice",
        {"fraction": 0.1},
    ),
    "line_noise": Fault(
        "`garbage` random bytes for each byte sent, and a `flips` share of bits flipped",
        "bits flip on the line to the board, and random bytes come between",
        {"garbage": 0.0005, "flips": 2e-5},
    ),
    "wrong_schema": Fault(
        "the firmware is another version: another schema hash in IDENT and in every check",
        "the board says that its firmware is another version",
        {"schema": 0xBAD0F00D},
    ),
    "clock_jump": Fault(
        "the microcontroller's clock jumps `by` so many seconds, once",
        "the board's clock jumps by {by:g} s",
        {"by": -5.0},
    ),
    "frozen": Fault(
        "the same scan is sent again and again, with new numbers and times", "the same scan is sent again and again"
    ),
    "hang": Fault("the board neither answers nor sends", "the board neither answers nor sends"),
    "unplug": Fault(
        "the device vanishes and comes back, power-cycled, after the seconds; as <runtime>/`name` where one is given",
        "the cable is out",
        {"name": ""},
    ),
    "power_cycle": Fault("the board restarts, and forgets what it was told and what was sticky", "the board restarts"),
}

BOUNDS: dict[str, tuple[float, float]] = {
    "fraction": (0, 1),
    "garbage": (0, 1),
    "flips": (0, 1),
    "bit": (0, 3),
    "value": (0, 1),
    "words": (1, 65535),
    "id": (0, 0xFFFF),
    "schema": (0, 0xFFFFFFFF),
    "gain": (0, 1e6),
    "factor": (-1e6, 1e6),
    "phase": (-7, 7),
    "late_frames by": (0, 60),
    "clock_jump by": (-1e6, 1e6),
}
"""From and to which an argument makes sense, by its name, after the fault's where others call theirs so; electrodes are
bounded by the sheet. What lies beyond asks for more bytes or longer times than the stub has.
"""


class Faults:
    """The faults in force. Used by the board's thread and by the control socket's."""

    def __init__(self) -> None:
        self._until: dict[str, tuple[float, dict[str, Any]]] = {}
        self._lock = threading.Lock()

    def inject(self, name: str, args: Mapping[str, Any], now: float, seconds: float = 5.0) -> dict[str, Any]:
        """Start a fault at `now` (s); returns its arguments. Raises ValueError for what is not in the table."""
        row = _row(name)
        if unknown := set(args) - set(row.args):
            allowed = ", ".join(row.args) or "no arguments"
            raise ValueError(f"fault {name}: unknown argument {', '.join(sorted(unknown))}, expected {allowed}")
        if not 0 <= seconds < math.inf:
            raise ValueError(f"fault {name}: lasts {seconds} s, expected a number of seconds from 0 on")
        full = dict(row.args)
        for key, value in args.items():
            full[key] = _like(row.args[key], value, f"fault {name}: {key}")
            least, most = BOUNDS.get(f"{name} {key}") or BOUNDS.get(key, (-math.inf, math.inf))
            if isinstance(full[key], int | float) and not least <= full[key] <= most:
                raise ValueError(f"fault {name}: {key} = {value!r}: expected {least:.10g} to {most:.10g}")
        with self._lock:
            self._until[name] = (math.inf if row.sticky else now + seconds, full)
        return full

    def active(self, name: str, now: float) -> dict[str, Any] | None:
        """The arguments of a fault in force at `now`, else None."""
        with self._lock:
            until, args = self._until.get(name, (-math.inf, {}))
            return args if now < until else None

    def clear(self, *names: str) -> None:
        """End the named faults, or all. Raises ValueError for what is not in the table."""
        for name in names:
            _row(name)
        with self._lock:
            for name in names or list(self._until):
                self._until.pop(name, None)

    def power_cycled(self) -> None:
        self.clear(*(name for name, row in FAULTS.items() if row.sticky))

    def listing(self, now: float) -> dict[str, dict[str, Any]]:
        with self._lock:
            return {name: args for name, (until, args) in self._until.items() if now < until}


def _row(name: str) -> Fault:
    if name not in FAULTS:
        raise ValueError(f"no fault {name!r}: expected one of {', '.join(FAULTS)}")
    return FAULTS[name]


def messages_of(listing: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What is the matter, for a person. listing: the faults in force, each with its arguments."""
    return [f"on request, {FAULTS[name].said(args)}" for name, args in listing.items()]


def _like(default: Any, value: Any, what: str) -> Any:
    """The value in the type of the default. Raises ValueError."""
    if default in MUXES and value not in MUXES:
        raise ValueError(f"{what} = {value!r}: expected one of {', '.join(MUXES)}")
    if isinstance(default, list):
        if not isinstance(value, list) or len(value) != len(default):
            raise ValueError(f"{what} = {value!r}: expected a list like {default}")
        return [_like(d, v, what) for d, v in zip(default, value, strict=True)]
    if isinstance(default, str):
        if not re.fullmatch(r"[A-Za-z0-9_+.\-]{0,32}", str(value)):
            raise ValueError(f"{what} = {value!r}: expected a short name")
        return str(value)
    try:
        if isinstance(default, bool) != isinstance(value, bool):
            raise ValueError
        number = type(default)(int(value, 0) if isinstance(default, int) and isinstance(value, str) else value)
        if not math.isfinite(number):
            raise ValueError
        return number
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} = {value!r}: expected something like {default!r}") from None
