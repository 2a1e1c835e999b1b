"""The stages that are to take over: what whoever drives a service relies on beside places and forces."""

from __future__ import annotations

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame
from services.pipeline import Pipeline
from services.preprocessing import Preprocessing
from services.runtime.config import Skin
from services.runtime.stage import Refused
from tests.services.test_estimator import FREE_S, PARTS, SCAN_S, Board, press, pressed

SKIN = Skin.model_validate({"port": "stub", "bundle": "square16", "frame_id": "palm"})
TOUCH = pressed("circle", 0.02, 0.015, 0.01, 2.0)
BOTH = pytest.mark.parametrize("parts", [1, PARTS], ids=["whole", "parts"])


def pipeline() -> Pipeline:
    return Pipeline(SKIN, "palm", Bundle.load("square16"))


def raws(seconds: float, parts: int = 1, **pressed_so: float) -> list[RawFrame]:
    return list(Board(press(TOUCH, **pressed_so), parts, 1).frames(seconds))


def said(stages: Pipeline, frames: list[RawFrame]) -> list[ContactFrame]:
    made = [stages.step(raw) for raw in frames]
    return [frame for frame in made if frame is not None]


def shown(frame: ContactFrame) -> list[int]:
    return [contact.id for contact in frame.contacts if contact.state != "end"]


def states(frames: list[ContactFrame]) -> list[str]:
    """Of the only contact, each once."""
    found = [contact.state for frame in frames for contact in frame.contacts]
    return [state for k, state in enumerate(found) if not k or found[k - 1] != state]


@BOTH
def test_a_touch_begins_is_held_and_ends_with_one_id_and_an_image(parts: int) -> None:
    frames = said(pipeline(), raws(FREE_S + 1.0, parts, until_s=FREE_S + 0.6))
    assert states(frames) == ["begin", "hold", "end"]
    (number,) = {contact.id for frame in frames for contact in frame.contacts}
    assert number == 1
    held = next(f for f in frames if f.quality is not None and f.stamps["sample"] > (FREE_S + 0.4) * 1e9)
    assert held.quality is not None and held.quality > 0.8
    assert held.contacts[0].shape != "unknown" and held.contacts[0].force_sigma_n is not None


@BOTH
def test_a_state_goes_on_as_its_own_stages_do(parts: int) -> None:
    frames = raws(FREE_S + 0.7, parts)
    cut = round((FREE_S + 0.3) / SCAN_S * parts)
    ours, theirs = pipeline(), pipeline()
    said(ours, frames[:cut])
    pairs = ((ours.pre, theirs.pre), (ours.inference, theirs.inference), (ours.publishing, theirs.publishing))
    for one, other in pairs:
        other.load(one.state())
    mine, others = said(ours, frames[cut:]), said(theirs, frames[cut:])
    assert [shown(frame) for frame in mine] == [shown(frame) for frame in others] and any(map(shown, mine))
    forces = [[[c.force_n for c in frame.contacts] for frame in made] for made in (mine, others)]
    assert forces[0] == forces[1]


def test_a_restart_under_a_touch_shows_it_at_once_under_another_id_and_does_not_say_that_it_began() -> None:
    frames, stages = raws(FREE_S + 1.2), pipeline()
    cut = round((FREE_S + 0.6) / SCAN_S)
    before = said(stages, frames[:cut])
    stages.pre._keep = True
    kept = stages.pre.saved()
    assert kept is not None and before[-1].contacts
    stages.pre = Preprocessing("palm", SKIN, Bundle.load("square16"))
    stages.pre.restore(kept, 0.1)
    after = said(stages, frames[cut:])
    assert all(frame.valid and len(shown(frame)) == 1 for frame in after)
    assert shown(after[0]) != shown(before[-1])
    assert "begin" not in states(after)


def test_a_baseline_of_another_bundle_or_too_old_is_refused() -> None:
    stages = pipeline()
    said(stages, raws(FREE_S))
    stages.pre._keep = True
    kept = stages.pre.saved()
    assert kept is not None
    fresh = pipeline().pre
    with pytest.raises(Refused, match="another bundle"):
        fresh.restore({**kept, "bundle": "0" * 64}, 1.0)
    with pytest.raises(Refused, match="h old"):
        fresh.restore(kept, 1e6)


def test_a_tare_is_refused_while_something_touches() -> None:
    stages = pipeline()
    said(stages, raws(FREE_S + 0.6))
    with pytest.raises(Refused, match="touched"):
        stages.pre.command("tare", {})


def test_another_board_and_another_skins_frames_are_said() -> None:
    stages, frames = pipeline(), raws(FREE_S + 0.5)
    said(stages, frames[:-2])
    short = frames[-2]
    short.z, short.status = short.z[:20], short.status[:20]
    foreign = stages.step(short)
    assert foreign is not None and not foreign.valid and "out_of_distribution" in foreign.reasons
    assert "20 measurements" in stages.pre.health().messages[0]
    frames[-1].board = "another"
    other = stages.step(frames[-1])
    assert other is not None and not other.valid and "stale_baseline" in other.reasons
    assert "another" in stages.pre.health().messages[0]


def test_two_touches_have_outlines_in_the_order_of_their_contacts() -> None:
    two = press(TOUCH, pressed("circle", -0.025, -0.02, 8e-3, 1.5))
    stages = pipeline()
    frames = list(Board(two, 1, 1).frames(FREE_S + 0.6))
    said(stages, frames[:-1])
    image = stages.inference.process(stages.pre.process(frames[-1], frozenset({"delta"}))[0], frozenset({"image"}))[0]
    contact, shape = stages.publishing.everything(image, frozenset({"contact", "shape"}))
    assert isinstance(contact, ContactFrame)
    assert shape.ids == shown(contact) and len(shape.ids) == 2  # type: ignore[attr-defined]
    for each, line in zip(contact.contacts, shape.outlines, strict=True):  # type: ignore[attr-defined]
        assert np.hypot(*(np.mean(line, axis=0) - each.position[:2])) < 0.005
