"""The table of topics; only this module names them.

Sockets, `skin top`, the recorder, WIRE.md's table and tests derive from it. A message's topic on the wire is
`name/skin`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from . import frame_types as f

BRIDGES = ("page", "foxglove")
"""Processes that show contacts, or hand them on to other worlds. On our side they publish their status alone."""
RECORDER = "recorder"
"""The process that records; it publishes its status alone, too."""
REFERENCE = "reference"
"""What reads a force-torque sensor or a scale, a program of the user's or a ROS node; it publishes that topic alone."""
OUR_PROCESSES = ("acquisition", "preprocessing", "inference", "publisher", "stub", *BRIDGES, RECORDER)
"""Our processes: each publishes its status."""
PRODUCERS = (*OUR_PROCESSES, REFERENCE)
"""Who owns a data socket `<producer>.ipc`. A replay stands in for acquisition and binds its socket."""


@dataclass(frozen=True)
class Topic:
    """One topic's properties.

    `rate_hz`: nominal, of the demo; 0: on change only. `lazy`: its extra work is done only while somebody subscribes.
    `latched`: a late joiner is given the last value. `behind`: what a reader does that cannot keep up, skip to the
    newest or read all.
    """

    name: str
    frame: type[f.Frame]
    producer: str | tuple[str, ...]
    rate_hz: float
    lazy: bool
    latched: bool
    behind: Literal["newest", "all"]
    carries: str

    @property
    def producers(self) -> tuple[str, ...]:
        """The processes that publish it."""
        return (self.producer,) if isinstance(self.producer, str) else self.producer


TOPICS: dict[str, Topic] = {
    t.name: t
    for t in (
        Topic(
            "raw", f.RawFrame, "acquisition", 22, False, False, "newest", "complex impedance and status per measurement"
        ),
        Topic(
            "delta",
            f.DeltaFrame,
            "preprocessing",
            22,
            False,
            False,
            "newest",
            "difference, touches, what to reconstruct",
        ),
        Topic(
            "part",
            f.PartFrame,
            "preprocessing",
            220,
            False,
            False,
            "newest",
            "the touches by now, between two delta frames of scans in parts",
        ),
        Topic("image", f.ImageFrame, "inference", 22, False, False, "newest", "conductivity-drop image"),
        Topic("stack", f.StackFrame, "inference", 22, True, False, "newest", "pre-reconstructions: a network's input"),
        Topic("contact", f.ContactFrame, "publisher", 22, False, False, "newest", "list of contacts, also when empty"),
        Topic("force", f.ForceFrame, "publisher", 22, True, False, "newest", "total wrench only"),
        Topic(
            "shape", f.ShapeFrame, "publisher", 22, True, False, "newest", "outline, orientation, class probabilities"
        ),
        Topic("status", f.StatusFrame, OUR_PROCESSES, 1, False, True, "all", "diagnostics, also on change"),
        Topic("info", f.InfoFrame, "preprocessing", 0, False, True, "all", "geometry, units, baseline, hashes"),
        Topic("truth", f.TruthFrame, "stub", 22, False, False, "newest", "what really touches (stub only)"),
        Topic(
            "reference",
            f.ReferenceFrame,
            REFERENCE,
            100,
            False,
            False,
            "all",
            "the force on the skin by another sensor, for `skin calibrate --live`",
        ),
        Topic(
            "judgements",
            f.JudgementsFrame,
            "preprocessing",
            22,
            True,
            False,
            "newest",
            "why a scan's frames are valid or not: every check, with statistic and limit; also of each part",
        ),
    )
}

TOPIC_OF: dict[type[f.Frame], Topic] = {t.frame: t for t in TOPICS.values()}


def wire_topic(name: str, skin: str) -> bytes:
    """A message's topic as its first bytes, without the 0 that ends it: b"contact/palm". Raises KeyError for an
    unknown topic.
    """
    return f"{TOPICS[name].name}/{skin}".encode()
