"""What the programs of models/ share: numbers and bundles from a command line, and how an error ends them."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

import numpy as np

from models import geometry
from models.bundle import Bundle
from protocol.errors import EitskinError


class ArgumentError(EitskinError):
    """Arguments that cannot be meant, alone or together. No ValueError: argparse would put its own words instead."""


class OtherSkin(EitskinError, ValueError):
    """A bundle of another skin than the one that is trained."""


def run(name: str, main: Callable[[], None]) -> None:
    """A program's `main`; an error of ours ends it with one line on stderr and exit status 1. Its text is for the
    person who started the program.
    """
    try:
        main()
    except EitskinError as why:
        sys.exit(f"{name}: {' '.join(str(why).split())}")


def whole(least: int = 1) -> Callable[[str], int]:
    """A type of argparse: a whole number of at least this."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number of at least {least}")
        return value

    return read


def real(above: float = 0.0, *, itself: bool = False, infinite: bool = False) -> Callable[[str], float]:
    """A type of argparse: a number above this one; `itself`: or equal to it; `infinite`: or inf."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (value > above or (itself and value == above)) or (math.isinf(value) and not infinite):
            which = f"of at least {above:g}" if itself else f"above {above:g}"
            tail = ", or inf" if infinite else ""
            raise argparse.ArgumentTypeError(f"found {text!r}, expected a finite number {which}{tail}")
        return value

    return read


def minutes(text: str) -> float:
    """An argument of argparse. Raises ArgumentError where a training cannot take so long."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of minutes") from None
    if not 0 < value < math.inf:
        raise ArgumentError(f"--minutes: found {text}, expected a number above 0: say how long training may take")
    return value


def bundle_of(skin: geometry.SkinGeometry, name: str) -> Bundle:
    """The bundle of this name or path. Raises BundleError, GeometryError, and OtherSkin where the bundle is not of this
    skin: its matrices, or its network, would be for other measurements.
    """
    found = Bundle.load(name)
    theirs = geometry.from_dict(found.skin)
    points, others = (s.point(s.electrodes) for s in (skin, theirs))
    if np.array_equal(found.pattern, skin.pattern) and np.allclose(points, others, rtol=0, atol=1e-6):
        return found
    raise OtherSkin(
        f"found the bundle {name}, of a skin '{theirs.name}' with {len(others)} electrodes and {len(found.pattern)} "
        f"measurements, expected a bundle of the skin '{skin.name}' as it is, with {len(points)} and "
        f"{len(skin.pattern)}: name a bundle of that skin, or build one with `make train SKIN={skin.name}`"
    )
