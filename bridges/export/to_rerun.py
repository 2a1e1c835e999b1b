"""A .rrd file for the viewer rerun: contacts in space, the image, forces over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import rerun

from protocol import views
from protocol.frames import ContactFrame, ImageFrame, InfoFrame

from .entries import Entry

METRES_PER_NEWTON = 0.01


def write_rerun(entries: Iterable[Entry], path: Path) -> Counter[str]:
    """Write all entries; how many messages of each kind."""
    counts: Counter[str] = Counter()
    stream = rerun.RecordingStream("eitskin")
    stream.save(path)
    for entry in entries:
        frame, skin = entry.frame, entry.skin
        stream.set_time("measured", timestamp=np.datetime64(entry.ns, "ns"))
        if isinstance(frame, ContactFrame):
            stream.log(f"{skin}/valid", rerun.Scalars(float(frame.valid)))
            contacts = views.present(frame) if frame.valid else []
            tails = [views.tail(contact, METRES_PER_NEWTON) for contact in contacts]
            stream.log(
                f"{skin}/contacts",
                rerun.Arrows3D(
                    origins=tails,
                    vectors=[np.subtract(c.position, t) for c, t in zip(contacts, tails, strict=True)],
                    labels=[views.label(contact) for contact in contacts],
                ),
            )
            if frame.valid and views.has_forces(frame):
                stream.log(f"{skin}/force_n", rerun.Scalars(sum(c.force_n or 0.0 for c in contacts)))
            counts[f"{skin}/contacts"] += 1
        elif isinstance(frame, ImageFrame) and frame.valid and frame.image.size:
            stream.log(f"{skin}/image", rerun.DepthImage(np.ascontiguousarray(frame.image[::-1])))
            counts[f"{skin}/image"] += 1
        elif isinstance(frame, InfoFrame):
            geometry = frame.info.get("geometry")
            if isinstance(geometry, dict) and "outline" in geometry:
                outline = np.asarray(geometry["outline"], float)
                closed = np.column_stack([np.vstack([outline, outline[:1]]), np.zeros(len(outline) + 1)])
                stream.log(f"{skin}/outline", rerun.LineStrips3D([closed]), static=True)
                counts[f"{skin}/outline"] += 1
    stream.flush()
    return counts
