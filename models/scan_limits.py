"""How well a touch can be known soon after it began, by the setting of the scan: what `skin limits --scan` prints.

A touch of 2 N begins at any moment of a scan. By a time after that some measurements were made, each once or more. The
floor is Bayesian, as in models/fisher.py, of the bundle's linear response: place, radius and drop are unknown. An error
of a measurement has two parts. One is drawn anew each time: the converter's noise, what a changed |Z| leaves on the
capacitors, interference. The other stays as long as the touch does, so that no mean takes it away: what the electrodes'
offsets, which have wandered since the tare, leave of their transient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.force_limits import places
from models.measurement.response import TouchModel
from models.measurement.tables import tables_of
from models.measurement.touch import area_of
from models.pressure import FOAM, disc
from models.rolling import most_parts, order
from models.scan_response import CAPACITOR_F, LINE_HZ, MOTOR_HZ, noise, sine_left, transient_left
from protocol.scan_setting import PAPER, ScanSetting

Array = NDArray[np.float64]

FORCE_N, RADIUS_M = 2.0, 0.010
SIZES = (0.5, 1.0)
"""Standard deviations of a touch's log radius and log drop before anything is measured. Our choice: a fingertip or a
tool, of which neither is known.
"""
CURRENT_A = 1e-5
SIGNAL_V = 0.1
"""Amplitude of the least voltage that is measured: 0.01 mA through 10 kohm (docs/hardware.md, "Range")."""
WANDER_V = 1e-3
"""By how much the offset between two electrodes has changed since the tare. An assumption: gold in tap water differs by
some 10 mV, of which a tenth moves within minutes, and when it is pressed. The table says what each setting bears."""
INTERFERENCE = 2e-4
"""What the paper's setting leaves of a mains cable, and as much of a motor, over the signal's amplitude: the worlds
"line" and "sweep" of firmware_stub/worlds/table.py."""
PHASES = 4  # moments within a measurement at which a touch begins


@dataclass(frozen=True)
class SettingErrors:
    """Standard deviations of one value, over |Z|."""

    white: float
    fresh: float
    """Of all that each value draws anew."""
    lasting: float
    """Of what stays while a touch does."""
    interference: float
    bears_v: float
    """The wander of offsets whose transient is as large as the white noise."""

    @property
    def settles(self) -> bool:
        """Whether what lasts is no more than the white noise."""
        return self.lasting <= self.white

    @property
    def together(self) -> float:
        """Of a value, with interference."""
        return float(np.sqrt(self.fresh**2 + self.lasting**2 + self.interference**2))


def errors(
    setting: ScanSetting, snr_db: float, change: float, wander_v: float = WANDER_V, capacitor_f: float = CAPACITOR_F
) -> SettingErrors:
    """snr_db: of the paper's setting, for white noise. change: mean step of |Z| from measurement to measurement,
    relative (models/scan_orders.py). The current's phase at a switch is any.
    """
    white = 10 ** (-snr_db / 20) * noise(setting)
    left = transient_left(setting, capacitor_f)
    held = CURRENT_A / (2 * np.pi * setting.frequency_hz * capacitor_f) / SIGNAL_V
    mains, motor = (sine_left(setting, f) / sine_left(PAPER, f) for f in (LINE_HZ, MOTOR_HZ))
    return SettingErrors(
        white=white,
        fresh=float(np.hypot(white, change * held * left / np.sqrt(2))),
        lasting=left * wander_v / SIGNAL_V,
        interference=INTERFERENCE * float(np.hypot(mains, motor)),
        bears_v=white / left * SIGNAL_V,
    )


@dataclass(frozen=True)
class EarlyFloor:
    """Root mean square over places and moments: place [m], x and y together; force, relative."""

    place_m: float
    force: float


class EarlyTouch:
    """Touches of 2 N on one skin, and what each of its measurements, in the order of a scan in parts, tells of them."""

    def __init__(self, skin: str, per_side: int = 4) -> None:
        bundle = Bundle.load(skin)
        self.unit_m = float(bundle.skin["metres_per_unit"])
        self.parts = most_parts(len(bundle.pattern), int(bundle.pattern.max()) + 1)
        self.order = order(bundle.matrices, bundle.pattern, self.parts, bundle.half_width)
        self.pattern = bundle.pattern
        self.z0 = np.abs(tables_of(bundle).z0)
        radius, drop = RADIUS_M / self.unit_m, FOAM.flat_drop(FORCE_N, disc(RADIUS_M))
        at = places(skin, radius, per_side)
        if not len(at):
            raise ValueError(f"no touch of radius {RADIUS_M * 1e3:g} mm fits on skin '{skin}'")
        response = tables_of(bundle).response
        self.slopes = np.array([touch_slopes(response, x, y, float(np.log(radius)), drop) for x, y in at])
        self._squares = np.einsum("pki,pkj->pkij", self.slopes, self.slopes)

    def floor(self, setting: ScanSetting, of: SettingErrors, after_s: float, interference: bool = False) -> EarlyFloor:
        """after_s: from the touch's beginning, of which every whole measurement since then is known."""
        fresh = np.hypot(of.fresh, of.interference if interference else 0.0)
        counts = self._counts(int(after_s / setting.pair_s * PHASES))
        with np.errstate(divide="ignore"):
            weight = np.where(counts > 0, 1 / (fresh**2 / np.maximum(counts, 1) + of.lasting**2), 0.0)
        across = 2.0  # model units: a place anywhere on the skin is as likely
        prior = np.diag([12 / across**2, 12 / across**2, *np.array(SIZES) ** -2.0])
        covariance = np.linalg.inv(np.einsum("sk,pkij->spij", weight, self._squares) + prior)
        force = np.array([0.0, 0.0, 2.0, 1.0])  # a force is a drop times an area
        place = covariance[..., 0, 0] + covariance[..., 1, 1]
        return EarlyFloor(
            float(np.sqrt(place.mean())) * self.unit_m,
            float(np.sqrt(np.einsum("i,spij,j->sp", force, covariance, force).mean())),
        )

    def _counts(self, quarters: int) -> Array:
        """(S, K) how often each measurement was made in so many quarters of measurements, by the touch's beginning."""
        found = []
        for first in range(0, len(self.order), len(self.order) // self.parts // 2):
            for phase in range(PHASES):
                whole = max(0, (quarters - phase) // PHASES)
                rows = self.order[(first + np.arange(whole)) % len(self.order)]
                found.append(np.bincount(rows, minlength=len(self.order)))
        return np.array(found, float)


def touch_slopes(response: TouchModel, x: float, y: float, log_radius: float, drop: float) -> Array:
    """(K, 4) of log |Z| to x, y, log radius and log drop, of a disc; lengths in model units, drop in S/m."""
    action = drop * float(area_of(log_radius))
    felt, to_x, to_y, grown = action * response.with_slopes(x, y, log_radius)
    return np.column_stack([to_x, to_y, grown + 2 * felt, felt])  # a larger disc of the same drop acts more
