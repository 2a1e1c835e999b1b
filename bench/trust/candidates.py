"""Candidates by name.

bench.trust.candidate:Today  MODULE:CLASS, the service's own stages
FIELD_RATE*2                 those with one of the estimator's numbers at twice its value; several with commas
without-memory               those without a part of their model: see PARTS
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType

from bench.trust.candidate import Candidate, Today
from models.bundle import Bundle
from models.measurement import numbers as of_measurements
from models.measurement import touch
from models.measurement.number import Number, numbers_of
from protocol.errors import EitskinError
from protocol.frames import ContactFrame, RawFrame
from services.estimation.values import numbers as of_estimation
from services.runtime.config import Skin

TODAY = "bench.trust.candidate:Today"
NONE = 1e-9  # times a number that is to do nothing: 0 would divide by it
PARTS: Mapping[str, Mapping[str, float]] = {
    "rates": {"FIELD_RATE": NONE, "FIELD_RATE_WALK": NONE, "SLOPE_RATE": NONE, "SLOPE_RATE_WALK": NONE},
    "slope": {"SLOPE_WALK": NONE, "SLOPE_RATE": NONE, "SLOPE_RATE_WALK": NONE, "SLOPE_FASTER": NONE},
    "contacts": {"CONTACT_WALK": NONE, "CONTACT_FOLLOWS": NONE, "CONTACT_FASTER": NONE, "CONTACT_START": NONE},
    "memory": {"MEMORIES": 0.0},
    "lines": {"LINE": 1e6},
    "shapes": {"SHAPE_SDS": 1e-3},
    "course": {"COURSE_SD": NONE, "SUDDEN_SD": NONE, "KINK": NONE},
    "wide": {"MISFIT_WIDE": 0.2},
}
"""What is taken from the model: names and by how much each is multiplied.

rates: drift has no speed; slope: the sheet drifts evenly; contacts: contact impedances stay; memory: foam remembers
nothing; lines: no disturbance is learnt; shapes: touches are discs; course: they change and slide along straight lines;
wide: no response is wrong by more than it should be.
"""
WITHOUT = "without-"


class UnknownCandidate(EitskinError, ValueError):
    """No such class, number or part of the model; the message says how one is written."""


def kind_of(name: str) -> Callable[[Skin, Bundle], Candidate]:
    """What makes this candidate. Raises UnknownCandidate."""
    module, colon, kind = name.partition(":")
    if not colon:
        return partial(OtherNumbers, factors(name))
    try:
        found: type[Candidate] = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError, ValueError) as why:
        raise UnknownCandidate(f"no candidate {name!r} ({why}): expected MODULE:CLASS, as {TODAY}") from None
    return found


@dataclass(frozen=True)
class ChangedValue:
    """One value where a module has it."""

    module: ModuleType
    name: str
    before: object
    value: object


class OtherNumbers(Today):
    """The stages that the services run, but for these changes."""

    def __init__(self, factors: Mapping[str, float], skin: Skin, bundle: Bundle) -> None:
        self._changes = [change for name, factor in factors.items() for change in _changes(name, factor)]
        super().__init__(skin, bundle)

    def reset(self) -> None:
        with changed(self._changes):
            super().reset()

    def step(self, raw: RawFrame) -> ContactFrame | None:
        with changed(self._changes):
            return super().step(raw)

    def tare(self) -> None:
        with changed(self._changes):
            super().tare()


def factors(changes: str) -> dict[str, float]:
    """Name -> times its value. Raises UnknownCandidate."""
    if changes.startswith(WITHOUT):
        part = changes.removeprefix(WITHOUT)
        if part not in PARTS:
            raise UnknownCandidate(f"no part {part!r} of the model: expected one of {', '.join(PARTS)}")
        return dict(PARTS[part])
    found = {}
    for each in changes.split(","):
        name, _, times = each.partition("*")
        if name not in _known():
            raise UnknownCandidate(f"no number {name!r}: `python -m services.estimation.values.numbers` prints them")
        try:
            found[name] = float(times)
        except ValueError:
            raise UnknownCandidate(f"{each!r}: expected NAME*FACTOR, as {name}*2") from None
    return found


@contextmanager
def changed(changes: Sequence[ChangedValue]) -> Iterator[None]:
    """While this lasts, whoever asks for these values gets the changed ones."""
    try:
        for change in changes:
            setattr(change.module, change.name, change.value)
        yield
    finally:
        for change in changes:
            setattr(change.module, change.name, change.before)


def _known() -> dict[str, Number]:
    return {name: each for module in (of_measurements, of_estimation) for name, each in numbers_of(module)}


def _changes(name: str, factor: float) -> list[ChangedValue]:
    """A number multiplied, wherever a module of the estimator has it."""
    before = touch.SHAPE_SDS if name == "SHAPE_SDS" else _known()[name]
    return [
        ChangedValue(module, name, before, before * factor)
        for of, module in list(sys.modules.items())
        if of.startswith(("models.measurement", "services.estimation")) and vars(module).get(name) is before
    ]
