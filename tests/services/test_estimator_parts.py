"""Scans in parts before the new estimator: what a part costs, and what windows of old and new values must not do."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from bench.trust.candidate import Today
from firmware_stub.world import Touch, World, pressed
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import FoundTouches, TouchFitter
from services.estimation.values import numbers as n
from services.runtime.config import Skin
from tests.services.test_estimator import (
    FREE_S,
    PARTS,
    Board,
    Curve,
    at_s,
    between,
    between_s,
    bundle,
    impedance,
    lasting,
    press,
    run,
    sheet,
)

TOUCH, STRONG = (pressed("circle", 0.012, -0.018, 9e-3, force_n) for force_n in (3.0, 5.0))


@contextmanager
def counted(patch: pytest.MonkeyPatch) -> Iterator[dict[str, int]]:
    """What is computed meanwhile: steps times touches of fits, and factors of covariances."""
    found = {"steps": 0, "factors": 0}
    fit, factor = TouchFitter.fit, Whitening.of.__func__  # type: ignore[attr-defined]

    def fitted(self: TouchFitter, most_steps: int) -> FoundTouches:
        made = fit(self, most_steps)
        found["steps"] += made.steps * len(made)
        return made

    def whitened(cls: type[Whitening], covariance: np.ndarray) -> Whitening:
        found["factors"] += 1
        return factor(cls, covariance)  # type: ignore[no-any-return]

    with patch.context() as patched:
        patched.setattr(TouchFitter, "fit", fitted)
        patched.setattr(Whitening, "of", classmethod(whitened))
        yield found


def costs(
    curve: Curve, seconds: float, patch: pytest.MonkeyPatch, dead: tuple[int, ...] = (), parts: int = PARTS
) -> list[tuple[float, int, int]]:
    """When, steps and factors of each part, or of each whole scan."""
    candidate, made = Today(Skin.model_validate({"port": "stub", "bundle": "square16"}), bundle()), []
    for raw in Board(curve, parts, 1).frames(seconds):
        raw.status[list(dead)] = 1
        with counted(patch) as found:
            candidate.step(raw)
        made.append((at_s(raw), found["steps"], found["factors"]))
    return made


def test_a_part_costs_one_budget_whatever_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three presses at once, on an electrode too: touches, their end, others, drift, contacts and gain are asked. A
    part that ends a whole scan may be recounted, for a larger budget, and asked about the board, for one more.
    """
    near = pressed("circle", 0.0425, 0.018, 6e-3, 2.0), pressed("circle", -0.02, 0.01, 6e-3, 1.0)
    made = costs(press(TOUCH, *near, ramp_s=0.07, until_s=FREE_S + 0.4), FREE_S + 0.7, monkeypatch)
    assert max(steps for _, steps, _ in made) <= 3.5 / 3 * (2 * n.LEAST_BUDGET + n.RECOUNTS) * n.MOST_STEPS


def test_a_part_under_a_touch_that_stays_costs_one_warm_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    held = [each for each in costs(press(TOUCH), FREE_S + 1.5, monkeypatch) if each[0] > FREE_S + 0.6]
    assert np.mean([steps for _, steps, _ in held]) < 1
    assert np.mean([factors == 0 for _, _, factors in held]) > 0.8


def test_measurements_that_the_baseline_lacks_make_no_part_dear(monkeypatch: pytest.MonkeyPatch) -> None:
    free = [each for each in costs(press(), FREE_S + 1.0, monkeypatch, dead=(3, 40)) if each[0] > FREE_S]
    assert np.mean([factors == 0 for _, _, factors in free]) > 0.8


def test_a_contact_that_changed_under_a_touch_hides_nothing_when_that_goes() -> None:
    """The touch lies on the electrode, whose contact impedance becomes five times as large while it is held."""
    touch = pressed("circle", 0.038, -0.044, 6e-3, 3.0)
    places = np.asarray(bundle().skin["electrodes"]["centre"], float) * bundle().metres_per_unit
    electrode = int(np.hypot(*(places - (0.038, -0.044)).T).argmin())
    worse = [1.0] * 16
    worse[electrode] = 5.0

    def of(*touches: Touch, changed: bool = False) -> np.ndarray:
        world = World(touches, contact=tuple(worse) if changed else ())
        return np.abs(sheet().model.read(sheet().transfer(world)))

    ends = FREE_S + 2.0
    curve = between(
        (0, of()),
        (FREE_S, of()),
        (FREE_S + 0.03, of(touch)),
        (FREE_S + 0.7, of(touch)),
        (ends - 0.1, of(touch, changed=True)),
        (ends, of(touch, changed=True)),
        (ends + 0.005, of(changed=True)),
        (99, of(changed=True)),
    )
    gone = between_s(run(curve, ends + 0.8, PARTS), ends + 0.3, 99)
    assert gone and all(frame.valid and not lasting(frame) for frame in gone)


@pytest.mark.parametrize("parts", [1, PARTS])
def test_measurements_that_the_baseline_lacks_are_no_fault_of_the_wires(parts: int) -> None:
    candidate = Today(Skin.model_validate({"port": "stub", "bundle": "square16"}), bundle())
    made = []
    for raw in Board(press(TOUCH), parts, 1).frames(FREE_S + 0.6):
        raw.status[[3, 40]] = 1
        if (frame := candidate.step(raw)) is not None:  # a part in which nothing touches makes none
            made.append(frame)
    assert all(frame.valid and lasting(frame) == 1 for frame in between_s(made, FREE_S + 0.3, 99))
    assert all(frame.valid and not frame.contacts for frame in between_s(made, FREE_S - 0.3, FREE_S))


@pytest.mark.parametrize("parts", [1, PARTS])
@pytest.mark.parametrize("ramp_s", [5e-4, 2e-3, 5e-3, 0.01, 0.02])
def test_a_strong_touch_that_is_let_go_at_once_costs_no_search(
    ramp_s: float, parts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever within a scan: what else it may be is not asked, which costs a scan's whole budget."""
    for later_s in (0.0, 0.021):
        until_s = FREE_S + 0.7 + later_s
        made = costs(press(STRONG, ramp_s=ramp_s, until_s=until_s), until_s + 0.12, monkeypatch, parts=parts)
        assert max(steps for at, steps, _ in made if at > until_s - 0.05) <= 3 * n.STEPS_COLD


@pytest.mark.parametrize("parts", [1, PARTS])
@pytest.mark.parametrize("ramp_s", [1e-3, 5e-3, 0.02])
@pytest.mark.parametrize(("first_n", "then_n"), [(5.0, 2.5), (2.5, 5.0)])
def test_a_touch_whose_force_changes_at_once_goes_on(ramp_s: float, parts: int, first_n: float, then_n: float) -> None:
    """Whenever within a scan: it is there in every frame, with its id. What is half gone is no release, and what comes
    to it is no other touch.
    """
    free = impedance()
    first, then = (impedance(pressed("circle", 0.012, -0.018, 9e-3, force_n)) for force_n in (first_n, then_n))
    for later_s in (0.0, 0.0067, 0.0134, 0.034):
        at = FREE_S + 0.7 + later_s
        curve = between((0, free), (FREE_S, free), (FREE_S + 0.1, first), (at, first), (at + ramp_s, then), (99, then))
        shown = between_s(run(curve, at + 0.3, parts), at - 0.1, 99)
        assert all(frame.valid and lasting(frame) == 1 for frame in shown)
        assert len({contact.id for frame in shown for contact in frame.contacts}) == 1
