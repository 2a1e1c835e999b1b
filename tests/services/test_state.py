"""The stages together: another solver's frames, every setting of a scan; their state is gone on from, or refused."""

from dataclasses import asdict
from functools import reduce

import msgpack
import numpy as np
import pytest

from firmware_stub.timeline import Cue
from firmware_stub.world import pressed
from protocol.frames import RawFrame, pack
from protocol.scan_setting import NAMED, ScanSetting
from services.board.rolling_order import rolling_order
from services.board.scanning import Scanning
from services.board.source import in_parts
from services.describe import BaselineNews, FrameRate
from services.pipeline import Pipeline
from services.preprocessing import Preprocessing
from services.runtime.config import parse
from services.runtime.persistence import arrays, plain
from services.runtime.stage import Refused
from services.runtime.supervision import stub_arguments
from simulation.host import LATE_S, SimulatedHost, tared
from simulation.scenes import DiscPress, script, step
from tests.services.curves import FREE_S, SKIN, between_s, bundle, impedance, press, said, stages_of
from tests.services.curves import Board as CurveBoard

GOES_ON_S = 0.12
WANTED = frozenset({"delta"})


def kept(states):
    """As a message or a file has them."""
    return [arrays(msgpack.unpackb(msgpack.packb(plain(state)), strict_map_key=False)) for state in states]


def loaded(states, skin, of=None):
    pipeline = Pipeline(skin, "palm", of)
    for stage, state in zip(stages_of(pipeline), states, strict=True):
        stage.load(state)
    return pipeline


def told(frames):
    """All that a frame says, but when it was made."""
    return [
        (f.scan, f.part, f.valid, f.reasons, f.quality, [asdict(contact) for contact in f.contacts]) for f in frames
    ]


# untouched, begins, held, sliding, just released; an open electrode, a contact that rose, a touch beside it; gain, lost
MOMENTS = 6.1, 6.23, 6.3, 6.5, 6.72, 7.0, 7.4, 7.7, 7.92, 8.14


@pytest.mark.many
@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_who_loads_a_state_goes_on_as_its_own_stages_do(scan):
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
def test_a_state_of_before_the_baseline_is_gone_on_from(scan):
    host = SimulatedHost(scan, 80.0, 5, keep=True)
    host.until(1.5)
    twin = loaded(kept(stage.state() for stage in stages_of(host.pipeline)), host.skin)
    raw, first = len(host.raws), len(host.contacts)
    host.until(5.0)
    host.close()
    made = [frame for each in host.raws[raw:] if (frame := twin.step(each)) is not None]
    assert told(made) == told(frame for _, frame in host.contacts[first:]) and made[-1].valid


def test_what_foam_remembers_is_gone_on_with():
    touch = pressed("circle", 0.01, -0.01, 8e-3, 3.0)
    frames = list(CurveBoard(press(touch, until_s=FREE_S + 0.5, left=0.03)).frames(6))
    first = Pipeline(SKIN, "palm", bundle())
    cut = [raw.stamps["sample"] > (FREE_S + 0.7) * 1e9 for raw in frames].index(True)
    said(first, frames[:cut])
    twin = loaded(kept(stage.state() for stage in stages_of(first)), SKIN, bundle())
    ours, theirs = said(first, frames[cut:]), said(twin, frames[cut:])
    assert told(ours) == told(theirs)
    assert between_s(ours, FREE_S + 1) and all(f.valid and not f.contacts for f in between_s(ours, FREE_S + 1))


def test_work_ahead_changes_no_result_and_learning_waits_until_the_frame_has_left():
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


def test_a_state_of_an_earlier_layout_gives_its_baseline(tared):
    state = tared.stage.state()
    state["estimator"]["layout"] -= 1
    later = tared.again()
    later.stage.load(state)
    assert later.feel()[0].valid and later.stage.baseline is not None
    assert later.stage.baseline.z0.tobytes() == state["baseline"]["z0"].tobytes()


@pytest.mark.parametrize(("key", "value"), [("z0", np.nan), ("z0", -1.0), ("sigma", 0.0), ("sigma", np.nan)])
def test_an_impossible_baseline_is_refused(tared, key, value):
    state = tared.stage.state()
    state["baseline"][key] = np.where(np.arange(120) == 7, value, state["baseline"][key])
    with pytest.raises(Refused, match="not possible"):
        tared.again().stage.load(state)
    with pytest.raises(Refused, match="not possible"):
        tared.again().stage.restore({"bundle": tared.bundle.hash, "baseline": state["baseline"]}, 1.0)


@pytest.mark.parametrize(("keys", "value"), [
    ("estimator tared drift remainder", np.ones(7)),
    ("estimator tared drift remainder", lambda z: z * np.nan),
    ("estimator tared drift remainder_variance", np.ones((3, 7))),
    ("estimator tared drift x", lambda x: np.nan * x),
    ("estimator tared drift p", lambda p: -p),
    ("estimator tared touches next_id", "7"),
    ("estimator scans said", [1]),
    ("parts", [1, 2, 3]),
    ("references", {"row": []}),
    ("hold", dict(reference=np.ones(7), recent=np.ones((0, 120)), averaged=1, count=1, scan=1)),
])  # fmt: skip
def test_a_state_of_another_shape_is_refused_and_changes_nothing(tared, board, keys, value):
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


SIDE_M = 0.1
STUB = {"port": "stub", "bundle": "square16"}
STEP_NS = 4_500_000


def skin_of(**said):
    return parse({"skins": {"palm": STUB | said}}).skin("palm")


def raw(scan, z=(1.0,), step_ns=45_000_000, **fields):
    stamps = {"sample": 10**9 + scan * step_ns, "read": 10**9 + scan * step_ns + 1}
    z, more = np.asarray(z, np.complex64), {"source": "board", "valid": True} | fields
    return RawFrame(skin="palm", scan=scan, stamps=stamps, z=z, status=np.zeros(len(z), np.uint8), **more)


@pytest.mark.parametrize("snr_db", [120.0, 70.0])
def test_touches_of_another_solver_are_found_where_they_are(reference, snr_db):
    data = np.load(reference / "eidors_reference.npz")
    rng, sigma = np.random.default_rng(0), 10 ** (-snr_db / 20)
    untouched, pipeline, errors, scan = data["impedance_pairs"][0], Pipeline("square16"), [], 0

    def run(z, noisy=True):
        nonlocal scan
        scan += 1
        return pipeline.run(raw(scan, z * (1 + sigma * noisy * rng.standard_normal(120))))

    result = [run(untouched) for _ in range(72)][-1]
    assert result.contact.valid and not result.contact.contacts
    for z, name, shapes, drop in zip(*(data[k] for k in ("impedance_pairs", "scene", "shapes", "drop")), strict=True):
        result, touches = run(z), int(np.isfinite(shapes[:, 0]).sum())
        assert str(name).startswith("J") or result.delta.touched == bool(touches), name  # J: drift
        if touches == 1:
            iy, ix = np.nonzero(drop)
            centroid = SIDE_M / 2 * (-1 + 2 * (np.array([ix.mean(), iy.mean()]) + 0.5) / 96)
            seen = [c for c in result.contact.contacts if c.state != "end"]
            errors.append(np.hypot(*(np.array(seen[0].position[:2]) - centroid)))
        for _ in range(3):  # let touches end
            run(untouched, noisy=False)
    assert len(errors) >= 8 and np.median(errors) < 0.02 * SIDE_M and max(errors) < 0.06 * SIDE_M


def test_every_raw_frame_gives_one_frame_of_each_kind_and_the_same_frames_the_same_contacts(skin, board):
    frames, runs = [board.frame(board.disc(0.1, 0.1, 0.2, 0.3) if n > 75 else 0.0) for n in range(90)], []
    for always in (False, True):
        pipeline = Pipeline(skin, name="palm", always_reconstruct=always)
        results = [pipeline.run(frame) for frame in frames]
        assert all([f.scan for f in result[:3]] == [raw.scan] * 3 for result, raw in zip(results, frames, strict=True))
        assert list(results[-1].contact.stamps) == ["sample", "read", "preprocess", "infer", "publish"]
        assert results[71].image.image.size == always * 96 * 96 and not results[71].contact.contacts
        runs.append([[(c.position, c.force_n, c.id) for c in result.contact.contacts] for result in results])
    assert runs[0] == runs[1] and runs[0][-1][0][0][:2] == pytest.approx([0.005, 0.005], abs=0.002)


@pytest.mark.parametrize("name", [name for name in NAMED if name != "coherent"])  # the default, as everywhere
def test_a_press_is_found_with_every_setting(name):
    skin = skin_of(scan_setting=name)
    host, scan_s = SimulatedHost(snr_db=80.0, seed=5, skin=skin, late_s=LATE_S, keep=True), skin.setting.scan_s(120)
    host.until(76 * scan_s)
    host.press(x=0.02, y=-0.01, force=2.0)
    host.until(81 * scan_s)
    host.close()
    assert host.problem == "" and len(host.raws) > 0.8 * 810
    (found,) = host.contacts[-1][1].contacts
    assert host.contacts[-1][1].valid and np.hypot(found.position[0] - 0.02, found.position[1] + 0.01) < 1e-3
    assert found.force_n == pytest.approx(2.0, rel=0.25)


def test_a_slow_line_joins_parts_and_the_stub_is_told_its_rate(tmp_path, bundle):
    scanning = Scanning(bundle.pattern, ScanSetting(50_000, 32), 40_000.0, order=rolling_order(bundle))
    joined = in_parts(scanning, bundle, 921_600)
    assert 1 < joined.parts < 10 and 10 % joined.parts == 0
    assert in_parts(scanning, bundle, 2_000_000).parts == 10 and in_parts(scanning, bundle, 115_200).parts == 1
    told = stub_arguments(parse({"skins": {"left": STUB | {"baud": 2_000_000}, "right": STUB}}, tmp_path / "skin.toml"))
    assert told[-2:] == ("--baud", "left=2000000") and told.count("--baud") == 1


def test_the_rate_is_that_of_whole_scans_and_of_parts_whatever_was_lost():
    rate, news = FrameRate(), BaselineNews()
    for scan in range(40):  # these do not follow each other
        rate(raw(scan, step_ns=STEP_NS, reasons=["separate"]))
        rate(raw(scan, step_ns=STEP_NS, kind="sentinel"))
    assert rate.found is None and news(None, 0) and not news(None, 1)
    rate = FrameRate()
    for scan in [*range(8), *range(8, 60, 3)]:  # two of three were overtaken
        assert scan > 8 or rate.found is None
        rate(raw(scan, parts=10, step_ns=STEP_NS))
    assert rate.found == {"least": pytest.approx(22.22, abs=0.01), "touched": pytest.approx(222.2, abs=0.1)}
    assert news(None, 2, rate.found) and not news(None, 3, dict(rate.found)), "info is sent again with another rate"
    for scan in range(20):  # the board began anew, and scans whole
        rate(raw(scan, step_ns=10 * STEP_NS))
    assert rate.found == dict.fromkeys(("least", "touched"), pytest.approx(22.22, abs=0.01))
