"""Runs of the reaction benchmark that are joined: what was seen of each touch, kept from one run to the next."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from bench import WORK
from bench.machine import machine
from bench.speed.reaction_events import KINDS, Reaction, StatedError, TouchEvent

FOLDER = WORK / "reaction"
Found = list[tuple[TouchEvent, Reaction]]


@dataclass
class Piece:
    """One run: the same touches in each of its modes, and what the machine did. load: its least and its most."""

    seed: int
    steps: int
    found: dict[str, Found] = field(default_factory=dict)
    late: dict[str, int] = field(default_factory=dict)
    load: list[float] = field(default_factory=list)
    commit: str = ""

    def row(self) -> dict[str, Any]:
        """What the report says of it."""
        said = {"commit": self.commit, "seed": self.seed, "modes": list(self.found), "steps": self.steps}
        return {**said, "late_poses": self.late} | {
            "load": [round(each, 2) for each in (min(self.load), max(self.load))]
        }


def joined(pieces: Sequence[Piece]) -> tuple[dict[str, Found], dict[str, int]]:
    """By mode: what was seen of every touch, and how often the stub had no pose ready."""
    found: dict[str, Found] = {}
    late: dict[str, int] = {}
    for piece in pieces:
        for mode, each in piece.found.items():
            found[mode] = found.get(mode, []) + each
            late[mode] = late.get(mode, 0) + piece.late[mode]
    return found, late


def piece_seed(seed: int, number: int) -> int:
    """Of the touches of a series' piece."""
    return seed if number == 0 else 1000 * seed + number


def keep(pieces: Sequence[Piece], name: str) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{name}.json"
    kept = {"machine": machine(), "pieces": [_written(piece) for piece in pieces]}
    path.with_suffix(".new").write_text(json.dumps(kept))
    path.with_suffix(".new").replace(path)


def kept(name: str, seed: int, modes: Sequence[str]) -> list[Piece]:
    """The pieces of the last run or series. Raises ValueError where no other can be added to them."""
    path = FOLDER / f"{name}.json"
    try:
        content = json.loads(path.read_text())
        pieces = [_read(piece) for piece in content["pieces"]]
    except (OSError, ValueError, KeyError, TypeError) as why:
        raise ValueError(f"{path} holds no earlier run ({why!r}): run without --more first") from None
    was = content["machine"], pieces[0].seed, list(pieces[0].found)
    if was[:2] != (machine(), seed) or not set(modes) <= set(was[2]):
        raise ValueError(f"{path} is of machine, seed and modes {was}, this run is of {(machine(), seed, list(modes))}")
    return pieces


def _written(piece: Piece) -> dict[str, Any]:
    found = {
        mode: [[{**asdict(event), "kind": event.kind.name}, asdict(reaction)] for event, reaction in each]
        for mode, each in piece.found.items()
    }
    return {**vars(piece), "found": found}


def _read(written: dict[str, Any]) -> Piece:
    kinds = {kind.name: kind for kind in KINDS}
    found = {}
    for mode, each in written["found"].items():
        found[mode] = [
            (
                TouchEvent(**{**event, "kind": kinds[event["kind"]], **_places(event)}),
                Reaction(**{**reaction, "stated": [StatedError(**error) for error in reaction["stated"]]}),
            )
            for event, reaction in each
        ]
    return Piece(**{**written, "found": found})


def _places(event: dict[str, Any]) -> dict[str, Any]:
    return {"velocity": tuple(event["velocity"]), "others": tuple(tuple(place) for place in event["others"])}
