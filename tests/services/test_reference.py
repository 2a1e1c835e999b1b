"""What a reference says of a press: its zero, delay and dropouts; what is doubtful is no force."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

from models.bundle import Bundle
from protocol.frames import ImageFrame, ReferenceFrame, pack
from protocol.runtime import host_id
from services.calibration.force_fit import CalibrationError
from services.calibration.live import LivePresses
from services.calibration.reference import MOST_GAP_S, Doubtful, PressCourse, ReferenceForce
from services.calibration.seen import TouchReader
from services.runtime.config import Skin

pytestmark = pytest.mark.live

BEGAN, ENDED, STEADY = 2.0, 6.0, (3.5, 5.0)
RAMP_S, NEWTON, RATE_HZ = 0.2, 3.0, 100
START_S = time.monotonic() - 60.0


def pressed(t: np.ndarray) -> np.ndarray:
    """Share of a press's force over time."""
    return np.clip(np.minimum(t - BEGAN, ENDED - t) / RAMP_S, 0.0, 1.0)


def course() -> PressCourse:
    t = np.arange(0.0, 8.0, 0.045)
    steady = (START_S + STEADY[0], START_S + STEADY[1])
    return PressCourse(START_S + t, 2e-5 * pressed(t), START_S + BEGAN, steady, START_S + ENDED)


def frames(
    force: Callable[[np.ndarray], np.ndarray], delay_s: float = 0.0, lost: Callable[[float], bool] = lambda t: False
) -> Iterator[tuple[ReferenceFrame, float]]:
    noise = np.random.default_rng(2)
    for k, t in enumerate(np.arange(0.0, 8.0, 1 / RATE_HZ)):
        said = float(force(np.array(t - delay_s))) + 0.02 * noise.standard_normal()
        at = START_S + t
        stamps = {"sample": int(at * 1e9)}
        if not lost(t):
            yield ReferenceFrame(skin="palm", host=host_id(), seq=k, stamps=stamps, valid=True, force_n=said), at + 0.01


@pytest.fixture
def reference() -> Iterator[ReferenceForce]:
    made = ReferenceForce("palm")
    yield made
    made.close()


def listen(reference: ReferenceForce, *args: object, **more: object) -> ReferenceForce:
    for frame, arrived in frames(*args, **more):  # type: ignore[arg-type]
        reference.take(frame, arrived)
    return reference


def scale(t: np.ndarray) -> np.ndarray:
    return NEWTON * pressed(t) - 7.0


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.25, 0.45])
def test_its_rise_is_the_force_whatever_its_zero_and_delay(reference: ReferenceForce, delay_s: float) -> None:
    listen(reference, scale, delay_s, lambda t: t * RATE_HZ % 10 > 7)  # three in ten are lost
    assert reference.force(course()) == pytest.approx(NEWTON, rel=0.01)
    assert reference.delay_s == pytest.approx(delay_s, abs=0.0101)


def test_a_force_that_creeps_is_that_of_its_own_time(reference: ReferenceForce) -> None:
    """Half a second later it is another: with the delay left out the mean would be off by 4 %."""
    creeping = lambda t: NEWTON * pressed(t) * (1 + 0.04 * np.clip(t - BEGAN, 0, 4))  # noqa: E731
    listen(reference, creeping, 0.45)
    middle = NEWTON * (1 + 0.04 * (np.mean(STEADY) - BEGAN))
    assert reference.force(course()) == pytest.approx(middle, rel=0.01)


@pytest.mark.parametrize(
    ("force", "more", "why"),
    [
        (lambda t: -scale(t), {}, "fell while the skin was pressed.*change its sign"),
        (scale, {"delay_s": 0.8}, "0.8 s late, expected 0.5 s at most"),
        (lambda t: 0 * t, {}, "does not follow the press"),
        (lambda t: np.sin(3 * t), {}, "does not follow the press"),
        (scale, {"lost": lambda t: 4.0 < t < 4.4}, f"dropped out for 0.4. s of it, expected {MOST_GAP_S:g} s"),
        (scale, {"lost": lambda t: 4.6 < t < 5.2}, "dropped out for"),
        (scale, {"lost": lambda t: t < 1.9}, "found 0 readings of the reference in the 0.5 s before the touch"),
        (scale, {"lost": lambda t: t > 1.0}, "found 0 readings of the reference during it"),
        (lambda t: (1 + 0.3 * np.sin(9 * t)) * NEWTON * pressed(t), {}, "changed by .* %.*hold still"),
    ],
)
def test_what_is_doubtful_is_no_force(reference: ReferenceForce, force, more, why) -> None:  # type: ignore[no-untyped-def]
    listen(reference, force, **more)
    with pytest.raises(Doubtful, match=why):
        reference.force(course())


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"force_n": float("nan")}, "found a force of nan N.*expected a number"),
        ({"force_n": float("inf")}, "found a force of inf N"),
        ({"valid": False, "reasons": ["clock"]}, r"not valid \(clock\)"),
        ({"stamps": {"sample": int((START_S - 3) * 1e9)}}, "3.0 s after its stamp `sample`"),
    ],
)
def test_what_cannot_be_used_is_said_and_is_no_reading(reference: ReferenceForce, change, why) -> None:  # type: ignore[no-untyped-def]
    now = START_S
    good = {"skin": "palm", "host": host_id(), "stamps": {"sample": int(now * 1e9)}, "valid": True, "force_n": 1.0}
    assert "no message of reference/palm has come" in reference.trouble(now)
    reference.take(ReferenceFrame(**good), now)
    assert reference.trouble(now) == ""
    reference.take(ReferenceFrame(**{**good, **change}), now)
    assert re.search(why, reference.trouble(now))
    assert "silent for more than" in reference.trouble(now + 5)
    reference.take(ReferenceFrame(**good), now + 6)
    other = ReferenceFrame(**{**good, "session": "f" * 16, "stamps": {"sample": int((now + 6) * 1e9)}})
    reference.take(other, now + 6)
    assert "two programs publish reference/palm" in reference.trouble(now + 6)


def test_messages_that_cannot_be_read_are_told_once_and_not_for_ever(runtime: Path, skin: Skin, bundle: Bundle) -> None:
    """Unreadable ones for a second and a half, then none: each trouble is a line, and the newest is the one told."""
    context, told = zmq.Context(), []
    images, scale = context.socket(zmq.PUB), context.socket(zmq.PUB)
    images.bind(f"ipc://{runtime}/inference.ipc")
    scale.bind(f"ipc://{runtime}/reference.ipc")
    done = threading.Event()

    def publish() -> None:
        began, seq = time.monotonic(), 0
        while not done.wait(0.02):
            seq += 1
            images.send(pack(ImageFrame(skin="palm", host=host_id(), seq=seq, valid=True)))
            if time.monotonic() - began < 1.5:
                scale.send(b"reference/palm\0\xff\xff")

    presses = LivePresses("palm", TouchReader(skin, bundle), told.append, patience_s=4.0)
    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        with pytest.raises(CalibrationError, match="no message of reference/palm has come"):
            next(iter(presses))
    finally:
        done.set()
        publisher.join()
        presses.close()
        context.destroy(linger=0)
    unread = [line for line in told if "cannot be read" in line or "could not be read" in line]
    assert len(unread) == 1 and "expected a msgpack map" in unread[0], told
    assert "no message of reference/palm has come" in told[-1]
