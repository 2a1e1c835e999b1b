"""Tables: a row for each contact of each frame, and one without a contact for a frame in which nothing touched."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from protocol.frames import Contact, ContactFrame

from .entries import Entry

FRAME = ("time_s", "skin", "session", "scan", "valid", "reasons", "held", "quality")
CONTACT = (
    *("id", "state", "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s", "nx", "ny", "nz", "orientation_rad"),
    *("area_m2", "force_n", "force_sigma_n", "fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm"),
    *("shape", "shape_probability", "confidence"),
)
COLUMNS = (*FRAME, *CONTACT)
TEXT = ("skin", "session", "reasons", "state", "shape")


def rows(entries: Iterable[Entry]) -> Iterator[dict[str, Any]]:
    """The rows; None where there is no value. Frames that are not valid are there too, and say so."""
    for entry in entries:
        frame = entry.frame
        if isinstance(frame, ContactFrame):
            seconds = f"{entry.ns // 10**9}.{entry.ns % 10**9:09d}"
            head = (seconds, frame.skin, frame.session, frame.scan, frame.valid, " ".join(frame.reasons), frame.held)
            common = dict(zip(FRAME, (*head, frame.quality), strict=True))
            nothing: tuple[Any, ...] = (None,) * len(CONTACT)
            for values in [_contact(contact) for contact in frame.contacts] or [nothing]:
                yield common | dict(zip(CONTACT, values, strict=True))


def _contact(c: Contact) -> tuple[Any, ...]:
    place = (*c.position, *c.velocity, *c.normal, c.orientation)
    load = (c.area_m2, c.force_n, c.force_sigma_n, *c.wrench)
    return (c.id, c.state, *place, *load, c.shape, c.shape_probability, c.confidence)


def write_table(entries: Iterable[Entry], text: Path, arrays: Path) -> int:
    """Write FILE.csv and FILE.npz with the same rows; how many. In the npz what is missing is NaN, "" or -1."""
    found: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    with open(text, "x", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for row in rows(entries):
            writer.writerow(row)
            for name, value in row.items():
                found[name].append(value)
    with open(arrays, "xb") as binary:
        np.savez_compressed(binary, **{name: _array(name, values) for name, values in found.items()})
    return len(found["scan"])


def _array(name: str, values: list[Any]) -> Any:
    if name in TEXT:
        return np.array(["" if value is None else value for value in values], dtype=np.str_)
    if name in ("valid", "held"):
        return np.array(values, bool)
    if name in ("id", "scan"):
        return np.array([-1 if value is None else value for value in values], np.int64)
    return np.array([math.nan if value is None else float(value) for value in values], np.float64)
