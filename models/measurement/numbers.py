"""Every number of models/measurement that decides something, and what a number is. Lengths in model units unless a unit
is said.
"""

from __future__ import annotations

from typing import Self


class Number(float):
    """A float that says what it is. origin: "derived: ...", "measured: ...", "data sheet: ..." or "chosen: ..."."""

    unit: str
    meaning: str
    origin: str

    def __new__(cls, value: float, unit: str, meaning: str, origin: str) -> Self:
        made = super().__new__(cls, value)
        made.unit, made.meaning, made.origin = unit, meaning, origin
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[float, str, str, str]]:
        """What a copy is made of."""
        return type(self), (float(self), self.unit, self.meaning, self.origin)


SIGMAS = Number(3.0, "-", "standard deviations within which chance stays", "derived: one in 370")
TINY = Number(1e-12, "-", "in place of nothing, where it divides", "derived: no noise makes as little")
FALSE_ALARM_Z2 = Number(44.0, "-", "z^2 of the best disc that is a touch", "derived: 2 (ln 650 discs + ln 1e6) + 3")
FIELD_START = Number(1e-5, "-", "the field at the tare", "derived: 64 frames at 80 dB")
CONTACT_START = Number(1e-3, "-", "a contact impedance in a frame of the tare", "derived: 64 frames at 80 dB")
"""What is a touch, on a skin that was just tared."""

MISFIT = Number(0.004, "-", "what the linear disc leaves of a touch's change", "measured: 0.05 to 0.6 % on both meshes")
MISFIT_WIDE = Number(0.03, "-", "the same near electrodes and at deep touches", "measured: 3.4 % at most")
MISFIT_FAR = Number(0.015, "-", "MISFIT of coarse tables, or sensed elsewhere than driven", "measured: 0.2 to 1.5 %")
MISFIT_POWER = Number(0.3, "-", "of the Gram matrix: colour of that misfit", "measured: as the bundles' own misfit")
"""How wrong a response is."""

TYPICAL_RADIUS = Number(0.18, "unit", "of a touch of unknown size", "derived: 9 mm, geometric mean of 4 and 20 mm")
TYPICAL_DROP = Number(0.5, "-", "of touches of which nothing is known", "derived: half of what foam can")
AREA_LOG_SD = Number(0.55, "-", "of its radius's logarithm", "derived: 4 and 20 mm are 1.5 of it away")
LEAST_RADIUS = Number(0.05, "unit", "of a touch", "derived: a pixel of the tables is 0.042")
MOST_RADIUS = Number(0.6, "unit", "of a touch", "chosen: 30 mm, beyond the 25 mm that skins are made for")
HALF_PIXEL = Number(0.02, "unit", "way that a response does not tell", "derived: half a pixel of the tables")
SHEET = 1 - HALF_PIXEL  # unit: places lie within, along each axis
LEAST_ACTION = Number(1e-4, "unit^2", "of a touch: a search begins there", "derived: a tenth of a sigma")
MOST_ACTION = Number(1.0, "unit^2", "standard deviation of a touch's action", "derived: 20 mm radius, drop 0.6")
BEGINS_WITHIN = Number(2.0, "-", "of a touch's action: its change within a scan", "derived: begins at its middle")
MOST_STRENGTH = Number(2.0, "-", "action over area, where nothing conducts", "derived: drop 1 over 1 - 1 / 2")
NEW_WAY = Number(0.04, "unit", "way of a touch within the scan in which it begins", "derived: 2 mm, 50 mm/s")
MOST_WAY = Number(0.16, "unit", "way of a touch within any scan", "derived: 0.3 m/s is 0.26")
HARMONIC_SDS = (
    Number(0.1, "-", "second harmonic of an outline, of the radius", "measured: ellipse of aspect 2.2 to square"),
    Number(0.05, "-", "third harmonic", "measured: triangles"),
    Number(0.03, "-", "fourth harmonic", "measured: squares"),
)
EDGE_WIDTH = Number(0.03, "unit", "width of an edge, one sigma of its square", "chosen: 1.5 mm")
TENSOR_SD = Number(0.15, "-", "drop along a touch less that across", "measured: rectangles leave 5 to 7 % without")
AT_ONCE_S = Number(4e-4, "s", "in which any touch begins", "derived: one measurement, SCAN_S / 120")
"""What a touch looks like."""

DAMPING = Number(1e-3, "-", "of the first step, Levenberg's", "chosen: any small one")
DONE = Number(0.5, "nat", "a step that gains less ends the search", "derived: a tenth of what decides between two")
DONE_SHARE = Number(3e-3, "-", "the same of what is left", "derived: of 120, as DONE")
LINEAR = Number(0.05, "-", "of radius and action: a step within which slopes hold", "derived: squared, below MISFIT")
HOPELESS = Number(10.0, "-", "chi^2 of its linear optimum, beyond which a fit ends", "measured: true ones leave 8")
TELLS_AFTER = Number(4.0, "-", "steps of touches of unknown place, after which that tells", "measured: as HOPELESS")
LEAST_STEP = Number(0.06, "unit", "that a touch moves in one step at least", "derived: 1.5 pixels")
STEP_SHARE = Number(0.6, "-", "of a radius that one step moves a touch at most", "chosen: the disc still overlaps")
STEP_LOG = Number(0.5, "-", "of log radius in one step at most", "chosen: the disc still overlaps")
TURNS_LOG = Number(0.1, "-", "of log radius: a touch's own directions are taken anew", "derived: a tenth of them")
SUDDEN_S = Number(0.002, "s", "steps of the course of a touch that begins or ends at once", "derived: half a part")
SUDDEN_SD = Number(0.5, "-", "of its action, by which each step may differ", "derived: from none to all")
SUDDEN_JITTER = Number(0.1, "-", "of its action, within such a step", "derived: a kink in the middle of one")
STEADY = Number(0.05, "-", "of its action, by which one that ended at once changed before", "derived: foam creeps so")
SCAN_S = Number(0.0437, "s", "a whole scan of 120 measurements", "measured: by the board's clock")
COURSE_S = Number(0.0044, "s", "steps of the course of a touch that changes", "derived: a part, SCAN_S / 10")
COURSE_SD = Number(0.3, "-", "of its change, by which each may differ", "derived: a ramp that ends half way: 0.25 off")
CHANGES = Number(0.1, "-", "change of its action in a scan that may bend", "derived: COURSE_JITTER / COURSE_SD")
COURSE_JITTER = Number(0.03, "-", "of its action, within such a step", "derived: ramps of 20 ms and more")
BENDS_BY = Number(0.15, "-", "and of its radius", "derived: its square over 8 is 0.3 %, below MISFIT")
LEAST_TOLD = Number(0.02, "-", "least of a disc's information beside others", "chosen: seven times as unsure as alone")
KINK = Number(0.8, "-", "of a change within a scan: what of it may be no straight line", "derived: a ramp's half")
"""How a touch is fitted."""

WHITE = Number(1e-4, "-", "noise of log |Z| before anything is known", "data sheet: AD5940, 80 dB")
RESPONSE_FLOOR = Number(2e-6, "-", "rounding of the tables", "derived: of float32")
FLICKER_FLOOR = Number(3e-4, "-", "noise of a good contact impedance", "measured: at 80 dB none is seen below")
JITTER_FLOOR = Number(5e-4, "-", "noise of a contact anew each time that counts as none", "measured: at 80 dB")
LEARNING = Number(0.05, "-", "share of a variance that one scan replaces", "derived: 20 scans, a second")
LEARNING_WHITE = Number(0.03, "-", "the same of the white noise", "derived: as LEARNING, of all rows at once")
WHITE_FALLS = Number(0.8, "-", "times, of white noise in one scan at most; it rises as fast", "chosen: a fifth")
LEARNING_LINES = Number(0.005, "-", "the same of what they have in common", "derived: 200 scans, more than it has rows")
LINE = Number(1.3, "-", "times what chance makes of white noise, from which on it is a line", "derived: Tracy-Widom")
LINES = Number(6.0, "-", "eigenvectors of lines at most", "chosen: three frequencies")
ALTERNATES = Number(4.0, "-", "times what alternates from scan to scan, of a line at most", "derived: beats of 9")
LEFT_OUT = Number(1e4, "-", "variance of a measurement that does not count", "derived: nothing is as large")
OUTLIER = SIGMAS**2  # squared sigmas beyond which a residual counts no further
LINE_SCANS = 0.5 / LEARNING_LINES  # untouched scans after which lines are made anew
ELSEWHERE = Number(300.0, "-", "scans that end with other parts, until those are learnt from", "chosen: 13 s")
BURST_BLOCK = Number(12.0, "-", "measurements in which what comes and goes is as strong", "derived: a part of a scan")
LEAST_NOISE = Number(2e-6, "-", "noise of |Z| at least", "derived: half of a step of the board's 18 bits")
MEDIAN_OF_SQUARES = Number(0.455, "-", "of a standard normal variable", "derived: chi^2 of one degree of freedom")
MEDIAN_DEVIATION = Number(0.6745, "-", "of a standard normal variable", "derived: root of MEDIAN_OF_SQUARES")
"""What noise is."""
