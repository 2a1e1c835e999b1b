"""Checks that a bundle's numbers are in range, finite, and of shapes that fit each other (numpy only).

A bundle that was made wrongly still has right hashes. Without these checks it would give contacts at wrong places, or
end a process in the middle of a scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from models import geometry
from models.patterns import PatternError
from models.prereconstruction import Matrices
from models.skin_limits import MOST_ELECTRODES, MOST_MEASUREMENTS, MOST_PIXELS
from protocol.errors import EitskinError

MAX_LADDER = 64
MAX_DEPTH = 32
NORMALISATIONS = ("model", "measured")


class Wrong(EitskinError):
    """What is wrong with a bundle: `place`, what was found there, what is allowed."""

    def __init__(self, place: str, found: object, allowed: str) -> None:
        super().__init__(place, found, allowed)
        self.place, self.found, self.allowed = place, found, allowed

    def __str__(self) -> str:
        return f"{self.place}: found {str(self.found)[:80]}, expected {self.allowed}"


def check(manifest: Mapping[str, Any], m: Matrices) -> None:
    """Raises Wrong."""
    all_finite(manifest)
    check_matrices(m)
    check_image(manifest, m)
    said = manifest.get("normalisation", m.normalisation)
    if said != m.normalisation:
        raise Wrong("normalisation", said, f"{m.normalisation}, as matrices.npz says")
    prior, one_step = _map(manifest, "prior"), _map(manifest, "one_step")
    if "ladder" in prior and not _equal(prior["ladder"], m.ladder):
        raise Wrong("prior.ladder", prior["ladder"], "that of matrices.npz")
    for place, value, low, high in (
        ("prior.noser_power", prior.get("noser_power", 0.5), 0.0, 4.0),
        ("one_step.lambda", one_step.get("lambda", 0.15), 1e-9, 1e9),
        ("one_step.t", one_step.get("t", 0.5), 0.0, 1.0),
    ):
        number(place, value, low, high)
    check_skin(_map(manifest, "skin"), m)


def all_finite(value: Any, place: str = "", depth: int = 0) -> None:
    """Every number of a manifest, wherever it stands."""
    if depth > MAX_DEPTH:
        raise Wrong(place[:60] + "...", "deeper nesting", f"at most {MAX_DEPTH} levels")
    if isinstance(value, float) and not math.isfinite(value):
        raise Wrong(place, value, "a finite number")
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        all_finite(inner, f"{place}.{key}" if place else str(key), depth + 1)


def check_matrices(m: Matrices) -> None:
    """Shapes against each other, and numbers that the arithmetic of a scan can bear."""
    k, c = (len(each) if each.ndim else 0 for each in (m.pattern, m.ladder))
    e = m.contact.shape[-1] if m.contact.ndim else 0
    if not (1 <= k <= MOST_MEASUREMENTS and 2 <= e <= MOST_ELECTRODES and m.inside.ndim == 2):
        raise Wrong(
            "matrices.npz",
            f"{k} measurements, {e} electrodes, pixels {m.inside.shape}",
            f"1 to {MOST_MEASUREMENTS}, 2 to {MOST_ELECTRODES}, (h, w)",
        )
    if max(m.inside.shape) > MOST_PIXELS or not m.inside.size:
        raise Wrong("matrices.npz: inside", f"{m.inside.shape}", f"1 to {MOST_PIXELS} pixels along a side")
    shapes = {
        "pattern": (k, 4),
        "z0": (k,),
        "gram": (k, k),
        "back": (m.inside.size, k),
        "jacobian": (k, m.inside.size),
        "contact": (k, e),
        "ladder": (c,),
        "level": (c,),
    }
    for name, shape in shapes.items():
        _check_array(f"matrices.npz: {name}", getattr(m, name), shape, whole=name == "pattern")
    _check_values(m, e, c)


def _check_array(place: str, array: np.ndarray, shape: tuple[int, ...], whole: bool) -> None:
    if array.shape != shape:
        raise Wrong(place, f"shape {array.shape}", f"{shape}")
    if array.dtype.kind not in ("iu" if whole else "iuf"):
        raise Wrong(place, array.dtype, "integers" if whole else "numbers")
    if not np.isfinite(array).all():
        raise Wrong(place, "NaN or infinity", "finite numbers")


def _check_values(m: Matrices, e: int, c: int) -> None:
    """Of matrices whose shapes are right: e electrodes, c values of lambda."""
    if m.inside.dtype.kind != "b" or not m.inside.any():
        raise Wrong("matrices.npz: inside", m.inside.dtype, "booleans, some of them true")
    if m.pattern.min() < 0 or m.pattern.max() >= e:
        raise Wrong("matrices.npz: pattern", f"electrodes {m.pattern.min()}..{m.pattern.max()}", f"0..{e - 1}")
    if not (m.z0 > 0).all():
        raise Wrong("matrices.npz: z0", m.z0.min(), "impedances above 0 ohm")
    if not 1 <= c <= MAX_LADDER or not (m.ladder > 0).all() or not (np.diff(m.ladder) < 0).all():
        raise Wrong("matrices.npz: ladder", m.ladder, f"1 to {MAX_LADDER} decreasing numbers above 0")
    if not (m.level > 0).all():
        raise Wrong("matrices.npz: level", m.level.min(), "numbers above 0")
    number("matrices.npz: scale_index", m.scale_index, 0, c - 1)
    number("matrices.npz: model_error", m.model_error, 0.0, 1.0)
    if m.normalisation not in NORMALISATIONS:
        raise Wrong("matrices.npz: normalisation", m.normalisation, " or ".join(NORMALISATIONS))


def check_image(manifest: Mapping[str, Any], m: Matrices) -> None:
    """The grid on which contacts are found, and what a pixel is in metres."""
    image = _map(manifest, "image")
    if type(image.get("n")) is not int or not 4 <= image["n"] <= 1024:
        raise Wrong("image.n", image.get("n"), "4 to 1024 pixels")
    number("image.half_width", image.get("half_width"), 1e-3, 1e3)
    number("image.metres_per_unit", image.get("metres_per_unit"), 1e-6, 1e3)
    stack = [len(m.ladder), *m.inside.shape]
    if "stack" in image and image["stack"] != stack:
        raise Wrong("image.stack", image["stack"], f"{stack}, as matrices.npz has")


def check_skin(skin: Mapping[str, Any], m: Matrices) -> None:
    """The geometry, where the manifest gives one: a skin that can be built, with the electrodes of the matrices."""
    if not skin:
        return
    try:
        known = geometry.from_dict(dict(skin))
    except (geometry.GeometryError, PatternError, TypeError, ValueError, AttributeError) as why:
        raise Wrong("skin", why, "a geometry as models/skins have it") from None
    number("skin.metres_per_unit", known.metres_per_unit, 1e-6, 1e3)
    if known.n_electrodes != m.contact.shape[1]:
        raise Wrong("skin.electrodes", known.n_electrodes, f"{m.contact.shape[1]}, as matrices.npz has")
    if not np.array_equal(known.pattern, m.pattern):
        raise Wrong("skin.pattern", known.pattern_name, "that of matrices.npz")


def number(place: str, value: Any, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise Wrong(place, value, f"a number in {low:g}..{high:g}")


def _map(manifest: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = manifest.get(name, {})
    if not isinstance(found, Mapping):
        raise Wrong(name, type(found).__name__, "a map")
    return found


def _equal(said: Any, known: Any) -> bool:
    try:
        return bool(np.allclose(np.asarray(said, dtype=float), known, rtol=1e-9, atol=0.0))
    except (TypeError, ValueError):
        return False
