"""The stages' state: kept at any moment it is gone on from as its own stages do, and what is none is refused."""

from collections.abc import Iterable
from dataclasses import asdict
from functools import reduce
from typing import Any

import msgpack
import numpy as np
import pytest

from firmware_stub.timeline import Cue
from firmware_stub.world import pressed
from models.bundle import Bundle
from protocol.frames import ContactFrame, pack
from services.pipeline import Pipeline
from services.preprocessing import Preprocessing
from services.runtime.config import ScanMode, Skin
from services.runtime.persistence import arrays, plain
from services.runtime.stage import Refused
from simulation.host import SimulatedHost, tared
from simulation.scenes import DiscPress, script, step
from tests.services.conftest import Fed
from tests.services.curves import FREE_S, SKIN, between_s, bundle, impedance, press, said, stages_of
from tests.services.curves import Board as CurveBoard

GOES_ON_S = 0.12
WANTED = frozenset({"delta"})


def kept(states: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """As a message or a file has them."""
    return [arrays(msgpack.unpackb(msgpack.packb(plain(state)), strict_map_key=False)) for state in states]


def loaded(states: list[dict[str, Any]], skin: Skin, of: Bundle | None = None) -> Pipeline:
    pipeline = Pipeline(skin, "palm", of)
    for stage, state in zip(stages_of(pipeline), states, strict=True):
        stage.load(state)
    return pipeline


def told(frames: Iterable[ContactFrame]) -> list[Any]:
    """All that a frame says, but when it was made."""
    return [
        (f.scan, f.part, f.valid, f.reasons, f.quality, [asdict(contact) for contact in f.contacts]) for f in frames
    ]


# untouched, begins, held, sliding, just released; an open electrode, a contact that rose, a touch beside it; gain, lost
MOMENTS = 6.1, 6.23, 6.3, 6.5, 6.72, 7.0, 7.4, 7.7, 7.92, 8.14


@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_who_loads_a_state_goes_on_as_its_own_stages_do(scan: ScanMode) -> None:
    """Whoever was asked for it goes on as who loads it."""
    host = tared(scan, keep=True)
    presses = DiscPress(-0.02, 0.01, 6.2, 6.7, to=(0.02, 0.01), ramp=0.02), DiscPress(0.01, 0.01, 7.6, 10.0, ramp=0.05)
    faults = (Cue(6.9, "electrode_open", {"electrode": 5}, 0.2), Cue(7.9, "gain", {"factor": 1.02}, 5.0))
    played = script(*presses, cues=(*faults, Cue(8.1, "hang", {}, 0.1)), contact=[step(9, 1.5, 7.2)])
    host.rig.field.play(host.rig.timeline(played, 0.0), host.now)
    for at_s in MOMENTS:
        host.until(at_s)
        twin = loaded(kept(stage.state() for stage in stages_of(host.pipeline)), host.skin)
        raw, first = len(host.raws), len(host.contacts)
        host.until(at_s + GOES_ON_S)
        made = [frame for raw in host.raws[raw:] if (frame := twin.step(raw)) is not None]
        assert told(made) == told(frame for _, frame in host.contacts[first:]), at_s
    host.close()
    frames = [frame for _, frame in host.contacts]
    assert {"electrode_open", "electrode_drift", "gain"} <= {reason for frame in frames for reason in frame.reasons}
    assert sum(bool(frame.contacts) for frame in frames) > 20


@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_a_state_of_before_the_baseline_is_gone_on_from(scan: ScanMode) -> None:
    host = SimulatedHost(scan, 80.0, 5, keep=True)
    host.until(1.5)
    twin = loaded(kept(stage.state() for stage in stages_of(host.pipeline)), host.skin)
    raw, first = len(host.raws), len(host.contacts)
    host.until(5.0)
    host.close()
    made = [frame for each in host.raws[raw:] if (frame := twin.step(each)) is not None]
    assert told(made) == told(frame for _, frame in host.contacts[first:]) and made[-1].valid


def test_what_foam_remembers_is_gone_on_with() -> None:
    touch = pressed("circle", 0.01, -0.01, 8e-3, 3.0)
    frames = list(CurveBoard(press(touch, until_s=FREE_S + 0.5, left=0.03)).frames(6))
    first = Pipeline(SKIN, "palm", bundle())
    cut = [raw.stamps["sample"] > (FREE_S + 0.7) * 1e9 for raw in frames].index(True)
    said(first, frames[:cut])
    twin = loaded(kept(stage.state() for stage in stages_of(first)), SKIN, bundle())
    ours, theirs = said(first, frames[cut:]), said(twin, frames[cut:])
    assert told(ours) == told(theirs)
    assert between_s(ours, FREE_S + 1) and all(f.valid and not f.contacts for f in between_s(ours, FREE_S + 1))


def test_work_ahead_changes_no_result_and_learning_waits_until_the_frame_has_left() -> None:
    """Prepared or not, left the time to learn or not: the same bytes."""
    touch, free = impedance(pressed("circle", 0.02, 0.015, 0.01, 3.0)), impedance()
    frames = list(CurveBoard(lambda t: touch if 4 < t.max() < 4.5 or t.max() > 5 else free).frames(5.5))
    lazy, eager = (Preprocessing("palm", SKIN, bundle()) for _ in range(2))
    made = learnt = 0
    for raw in frames:
        one, other = (list(stage.process(raw, WANTED)) for stage in (lazy, eager))
        assert [pack(each) for each in one] == [pack(each) for each in other]
        was = eager.estimator.skin and eager.estimator.skin.drift.now.at_s
        eager.beside(WANTED)
        learnt += was is not None and eager.estimator.skin.drift.now.at_s > was  # type: ignore[union-attr]
        made += eager.prepare()
    assert made > 0 and learnt > 10


# what is no state


def test_a_state_of_an_earlier_layout_gives_its_baseline(tared: Fed) -> None:
    state = tared.stage.state()
    state["estimator"]["layout"] -= 1
    later = tared.again()
    later.stage.load(state)
    assert later.feel()[0].valid and later.stage.baseline is not None
    assert later.stage.baseline.z0.tobytes() == state["baseline"]["z0"].tobytes()


@pytest.mark.parametrize(("key", "value"), [("z0", np.nan), ("z0", -1.0), ("sigma", 0.0), ("sigma", np.nan)])
def test_an_impossible_baseline_is_refused(tared: Fed, key: str, value: float) -> None:
    state = tared.stage.state()
    state["baseline"][key] = np.where(np.arange(120) == 7, value, state["baseline"][key])
    with pytest.raises(Refused, match="not possible"):
        tared.again().stage.load(state)
    with pytest.raises(Refused, match="not possible"):
        tared.again().stage.restore({"bundle": tared.bundle.hash, "baseline": state["baseline"]}, 1.0)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        ("estimator tared log_z0", np.ones(7)),
        ("estimator tared log_z0", lambda z: z * np.nan),
        ("estimator tared scatter", np.ones((3, 7))),
        ("estimator tared drift x", lambda x: np.nan * x),
        ("estimator tared drift p", lambda p: -p),
        ("estimator tared touches next_id", "7"),
        ("estimator scans said", [1]),
        ("parts", [1, 2, 3]),
        ("references", {"row": []}),
        ("hold", dict(reference=np.ones(7), recent=np.ones((0, 120)), averaged=1, count=1, scan=1)),
    ],
)
def test_a_state_of_another_shape_is_refused_and_changes_nothing(tared, board, keys, value) -> None:
    twin = tared.again()
    twin.stage.load(*kept([tared.stage.state()]))
    tared.stage.load(tared.stage.state())
    (state,) = kept([tared.stage.state()])
    *way, last = keys.split()
    inner = reduce(lambda found, key: found[key], way, state)
    inner[last] = value(inner[last]) if callable(value) else value
    with pytest.raises(Refused, match="saved"):
        twin.stage.load(state)
    touch = board.disc(0.0, 0.0, 0.2, 0.3)
    for frame in (board.frame(), board.frame(touch), board.frame(touch)):
        assert pack(tared.run(frame)) == pack(twin.run(frame))
