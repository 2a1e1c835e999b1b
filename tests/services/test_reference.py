"""What a reference says of a press: its zero, delay and dropouts; what is doubtful is no force."""

import re
import time

import numpy as np
import pytest

from protocol.frames import ReferenceFrame
from protocol.runtime import host_id
from services.calibration.reference import MOST_GAP_S, Doubtful, PressCourse, ReferenceForce

BEGAN, ENDED, STEADY, NEWTON, RATE_HZ, START_S = 2.0, 6.0, (3.5, 5.0), 3.0, 100, time.monotonic() - 60.0


def pressed(t):
    """Share of a press's force over time."""
    return np.clip(np.minimum(t - BEGAN, ENDED - t) / 0.2, 0.0, 1.0)


def course():
    t = np.arange(0.0, 8.0, 0.045)
    steady = (START_S + STEADY[0], START_S + STEADY[1])
    return PressCourse(START_S + t, 2e-5 * pressed(t), START_S + BEGAN, steady, START_S + ENDED)


def reading(at, force_n=1.0, **more):
    said = {"valid": True, "force_n": force_n, "stamps": {"sample": int(at * 1e9)}} | more
    return ReferenceFrame(skin="palm", host=host_id(), **said)


@pytest.fixture
def reference():
    yield (made := ReferenceForce("palm"))
    made.close()


def listen(reference, force, delay_s=0.0, lost=lambda t: False):
    noise = np.random.default_rng(2)
    for k, t in enumerate(np.arange(0.0, 8.0, 1 / RATE_HZ)):
        said, at = float(force(np.array(t - delay_s))) + 0.02 * noise.standard_normal(), START_S + t
        if not lost(t):
            reference.take(reading(at, said, seq=k), at + 0.01)


def scale(t):
    return NEWTON * pressed(t) - 7.0


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.45])
def test_its_rise_is_the_force_whatever_its_zero_and_delay(reference, delay_s):
    """A force that creeps is that of its own time: with the delay left out the mean would be off by 4 %."""
    middle, lost = NEWTON * (1 + 0.04 * (np.mean(STEADY) - BEGAN)), lambda t: t * RATE_HZ % 10 > 7  # three in ten
    crept = lambda t: NEWTON * pressed(t) * (1 + 0.04 * np.clip(t - BEGAN, 0, 4)) - 7.0 + 1.0 * (t < 1.2)  # noqa: E731
    listen(reference, crept, delay_s, lost)
    assert reference.force(course()) == pytest.approx(middle, rel=0.01)
    assert reference.delay_s == pytest.approx(delay_s, abs=0.0101)


@pytest.mark.parametrize(
    ("force", "more", "why"),
    [
        (lambda t: -scale(t), {}, "fell while the skin was pressed.*change its sign"),
        (scale, {"delay_s": 0.8}, "0.8 s late, expected 0.5 s at most"),
        (lambda t: np.sin(3 * t), {}, "does not follow the press"),
        (scale, {"lost": lambda t: 4.0 < t < 4.4}, f"dropped out for 0.4. s of it, expected {MOST_GAP_S:g} s"),
        (scale, {"lost": lambda t: t < 1.9}, "found 0 readings of the reference in the 0.5 s before the touch"),
        (lambda t: (1 + 0.3 * np.sin(9 * t)) * NEWTON * pressed(t), {}, "changed by .* %.*hold still"),
    ],
)
def test_what_is_doubtful_is_no_force(reference, force, more, why):
    listen(reference, force, **more)
    with pytest.raises(Doubtful, match=why):
        reference.force(course())


UNUSABLE = [
    ({"force_n": float("nan")}, "found a force of nan N.*expected a number"),
    ({"valid": False, "reasons": ["clock"]}, r"not valid \(clock\)"),
    ({"stamps": {"sample": int((START_S - 3) * 1e9)}}, "3.0 s after its stamp `sample`"),
]


@pytest.mark.parametrize(("change", "why"), UNUSABLE)
def test_what_cannot_be_used_is_said_and_is_no_reading(reference, change, why):
    now = START_S
    assert "no message of reference/palm has come" in reference.trouble(now)
    reference.take(reading(now), now)
    assert reference.trouble(now) == ""
    reference.take(reading(now, **change), now)
    assert re.search(why, reference.trouble(now)) and "silent for more than" in reference.trouble(now + 5)
    reference.take(reading(now), now + 6)
    reference.take(reading(now + 6, session="f" * 16), now + 6)
    assert "two programs publish reference/palm" in reference.trouble(now + 6)
