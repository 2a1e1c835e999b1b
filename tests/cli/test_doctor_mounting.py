"""What `skin doctor` says of a calibrated skin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models import geometry
from models.calibration import CalibrationFit
from models.fit_calibration import describe
from models.mounted import FieldModes, Mounting
from services.cli.doctor_mounting import mounting_found


def said(**changes: Any) -> dict[str, Any]:
    """Of a square skin that a fit found so."""
    skin = geometry.load("square16")
    nominal = Mounting.nominal(skin, FieldModes(skin).count)
    values = {name: np.array(getattr(nominal, name)) for name in ("contact", "shift", "field", "anisotropy")}
    for name, (place, value) in changes.items():
        if name in values:
            values[name][place] = value
    sd = nominal.with_vector(np.full(len(nominal.vector), 1e-3))
    found = CalibrationFit(Mounting(0.0, **values), sd, 0.03, changes.get("after", (0, 1e-4))[1], (0.001,))
    return describe(skin, found)


def info() -> dict[str, Any]:
    skin = geometry.load("square16")
    metres = skin.metres_per_unit
    return {"geometry": {"outline": skin.polygon() * metres, "electrodes": skin.point(skin.electrodes) * metres}}


def test_a_well_mounted_skin_is_ok_and_drawn_with_its_electrodes() -> None:
    found = mounting_found("palm", said(), info())
    assert found.level == "OK" and "looks wrong" not in found.text
    lines = found.text.splitlines()
    assert any(
        line.count("8") and line.count("9") and "A" in line and "B" in line for line in lines[6:]
    )  # the top side
    assert "calibrated by `skin tare`" in lines[0]


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"contact": (5, np.log(4.0))}, "electrode 5: contact impedance 4 times the file's"),
        ({"shift": (7, 0.05)}, "electrode 7: 2.5 mm further along the outline"),
        ({"anisotropy": (1, 0.16)}, "17 % better along 45 degrees"),
        ({"field": (1, 6.0)}, "conducts unevenly"),
        ({"after": (0, 0.01)}, "1.0 % of the untouched impedances stay unexplained"),
    ],
)
def test_what_looks_wrong_with_the_mounting_is_named(changes: dict[str, Any], names: str) -> None:
    found = mounting_found("palm", said(**changes), info())
    assert found.level == "WARN" and names in found.text


def test_a_service_that_says_it_oddly_does_not_end_doctor() -> None:
    assert mounting_found("palm", {"misfit": "x"}, {}).level == "WARN"
