"""What one scan costs the measurement model, by its number of measurements: 120, 208 and 496.

    skin bench measurement_cost [--times 40]

Of square16's pairs, of its adjacent drives, and of a round skin of 32 electrodes, whose bundles are made here without
response tables (a minute). Medians of the process's own time: S (covariance with a line, contacts and field), its
factor and inverse, the largest disc of the grid in a residual, a disc's slopes, one step of a fit of one touch. A
machine whose first levels of cache are shared with others' work is twice as slow.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from models import bundle, geometry, manifest
from models.command import whole
from models.forward import ForwardModel
from models.linearise import linearise
from models.measurement.course import TouchCourse
from models.measurement.covariance.noise import NoiseModel
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import FittedScan, TouchFitter
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.grid import DiscGrid
from models.measurement.responses.tables import SkinTables, tables_of
from models.measurement.touch import anywhere
from services.estimation.filter import SkinFilter

ROUND32 = {
    "name": "round32",
    "unit": "mm",
    "contact_impedance": 0.01,
    "radius": 30,
    "electrodes": {"width": 2.5, "count": 32},
}
SPAN_S = 0.0437
STEPS = 4  # of the fit that is timed
PRESS = (0.2, -0.1, 0.2)  # x, y, radius: model units
ACTION = 0.02  # unit^2


def skins() -> list[geometry.SkinGeometry]:
    square = geometry.load("square16")
    return [square, square.with_pattern("adjacent"), geometry.from_dict(ROUND32)]


def made(skin: geometry.SkinGeometry, folder: Path) -> SkinTables:
    matrices = linearise(ForwardModel(skin), "model")
    place = folder / f"{skin.name}-{len(skin.pattern)}"
    return tables_of(bundle.write(place, manifest.describe(place.name, skin, matrices), matrices))


def milliseconds(call: Callable[[], object], times: int) -> float:
    taken = []
    for _ in range(times):
        began = time.process_time()
        call()
        taken.append(time.process_time() - began)
    return 1e3 * float(np.median(taken))


def costs(tables: SkinTables, times: int) -> dict[str, float]:
    """Name -> ms."""
    k, rng = tables.measurements, np.random.default_rng(1)
    response, noise, drift = DiscResponse(tables), NoiseModel(tables), SkinFilter(tables)
    noise.begin(1e-4 * rng.standard_normal((64, k)), (0,) * 64)
    x, y, radius = PRESS
    values = np.log1p(ACTION * response(x, y, np.log(radius))) + 1e-4 * rng.standard_normal(k)
    grid, flicker = DiscGrid(response), noise.now.flicker

    def covariance() -> np.ndarray:
        return noise.covariance(0) + drift.ahead(0.05, flicker).covariance

    known = covariance()
    white = Whitening.of(known)
    information, pulled = grid.information(white), white.solve(values)
    course = TouchCourse(response, ((np.arange(k) + 0.5) / k - 0.5) * SPAN_S, SPAN_S)
    scan = FittedScan(values, known, course, tables.misfit, k)

    def fitted(steps: int) -> Callable[[], object]:
        return lambda: TouchFitter(scan, [anywhere(0.15, -0.05, ACTION, SPAN_S)], tables.wrong).fit(steps)

    none, some = milliseconds(fitted(0), times), milliseconds(fitted(STEPS), times)
    return {
        "S": milliseconds(covariance, times),
        "whiten": milliseconds(lambda: Whitening.of(known), times),
        "largest disc": milliseconds(lambda: grid.likeliest(pulled, information), times),
        "slopes": milliseconds(lambda: response.with_slopes(x, y, np.log(radius)), times),
        "fit, no step": none,
        f"fit, {STEPS} steps at most": some,
    }


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench measurement_cost", description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=whole(1), default=40, help="that each is measured")
    args = parser.parse_args(argv)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for skin in skins():
            tables = made(skin, Path(folder))
            rows[tables.measurements] = costs(tables, args.times)
    names = list(next(iter(rows.values())))
    print("ms, process's own time".ljust(26), *(f"K {k:>6}" for k in rows))
    for name in names:
        print(name.ljust(26), *(f"{row[name]:8.3f}" for row in rows.values()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
