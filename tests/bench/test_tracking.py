"""The tracking benchmark: its scores notice what is wrong, and a few simulated seconds of the real thing are right."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench.tracking import __main__ as tracking
from bench.tracking import faults, report
from bench.tracking.scene import TOUCHES, Recorded, _drifting, simulate
from bench.tracking.scores import GRACE, LIGHT_N, Scorer, StageOutput, all_of
from firmware_stub.timeline import PiecewiseLinear, Script
from protocol.frames import ELECTRODE_STATES
from services.runtime.config import Skin

N = 60
ROW = ("index", *TOUCHES)


def recorded_of(rows, n=N, faults=None):
    """Frames without physics: (frame, track, x, y, force) of each true touch."""
    touches = np.array([[k, track, x, y, force, 0.008, 2e-4] for k, track, x, y, force in rows]).reshape(-1, len(ROW))
    none = np.zeros((n, 0))
    return Recorded(
        z=none.astype(np.complex64),
        status=none.astype(np.uint8),
        scan=np.arange(n),
        seconds=np.arange(n) / 22,
        sample_ns=np.round(np.arange(n) / 22 * 1e9).astype(int),
        sigma_ns=np.zeros(n, int),
        read_ns=np.zeros(n, int),
        device_us=np.zeros(n, int),
        gap=np.zeros(n, bool),
        part=np.zeros(n, int),
        parts=np.ones(n, int),
        age_us=none.astype(np.float32),
        new=none.astype(np.uint8),
        touches=touches,
        faults=np.array([json.dumps(f) for f in faults or [{}] * n]),
        sections=np.array(["one"] * n),
    )


def crossing():
    """Two touches that pass each other 12 mm apart."""
    x = np.linspace(-0.02, 0.02, N)
    rows = [row for k in range(10, N - 10) for row in ((k, 0, x[k], 0.006, 3.0), (k, 1, -x[k], -0.006, 2.0))]
    return recorded_of(rows)


def perfect(recorded):
    """Contacts as they truly are; ids are 100 + track."""
    return [
        StageOutput(True, (), (0,) * 16, tuple((100 + int(t["track"]), t["x"], t["y"], t["force"], 0.1) for t in truth))
        for truth in (recorded.truth(k) for k in range(len(recorded)))
    ]


def scored(recorded, seen):
    scorer = Scorer(recorded)
    for k, said in enumerate(seen):
        scorer.add(k, said)
    scorer.finish()
    return all_of(scorer.tallies).row()


def changed(seen, first, last, contacts):
    """`contacts` applied to those of the frames first to last - 1."""
    return [replace(s, contacts=tuple(contacts(s.contacts))) if first <= k < last else s for k, s in enumerate(seen)]


def test_perfect_contacts_have_no_errors():
    row = scored(crossing(), perfect(crossing()))
    assert row["touches"] == 2 and row["seen_%"] == 100 and row["mota"] == 1
    assert row["position_p95_%"] == row["force_p95_%"] == 0
    assert row["switches"] == row["false_touches"] == row["unseen"] == row["wrong_%"] == 0


def test_ids_that_swap_in_a_crossing_are_two_switches():
    swap = {100: 101, 101: 100}
    seen = changed(perfect(crossing()), 30, N, lambda cs: [(swap[c[0]], *c[1:]) for c in cs])
    row = scored(crossing(), seen)
    assert row["switches"] == 2 and row["false_touches"] == 0 and row["position_%"] == 0


def test_a_touch_that_is_lost_and_found_under_another_id_is_a_switch():
    seen = changed(perfect(crossing()), 30, 32, lambda cs: [c for c in cs if c[0] != 100])
    seen = changed(seen, 32, N, lambda cs: [(7 if c[0] == 100 else c[0], *c[1:]) for c in cs])
    row = scored(crossing(), seen)
    assert row["switches"] == 1 and row["false_touches"] == 0
    assert row["seen_%"] == pytest.approx(100 * 78 / 80)


def test_errors_of_position_and_force_are_found():
    seen = changed(perfect(crossing()), 0, N, lambda cs: [(c[0], c[1] + 0.003, c[2], 1.1 * c[3], 0.05) for c in cs])
    row = scored(crossing(), seen)
    assert row["position_%"] == pytest.approx(3.0)  # of a side of 0.1 m
    assert row["force_%"] == row["force_bias_%"] == pytest.approx(10.0)
    assert row["within_1_sigma_%"] == 0


@pytest.mark.parametrize("frames", [1, 20])
def test_a_contact_where_nothing_touches_counts_once_however_long_it_lasts(frames):
    seen = changed(perfect(crossing()), 20, 20 + frames, lambda cs: [*cs, (999, 0.04, 0.04, 0.5, 0.1)])
    row = scored(crossing(), seen)
    assert row["false_touches"] == 1 and row["extra_contacts"] == frames and row["wrong_%"] > 0


def test_a_contact_may_outlast_its_touch_a_little_and_no_longer():
    seen = perfect(crossing())
    end = N - 10
    last = seen[end - 1].contacts
    for outlasts, false in ((GRACE, 0), (GRACE + 1, 2)):
        row = scored(crossing(), changed(seen, end, end + outlasts, lambda _: last))
        assert row["false_touches"] == false and row["end_most"] == outlasts


def test_an_invalid_frame_is_not_scored_but_not_available_either():
    seen = [replace(s, valid=False, contacts=((5, 0.04, 0.04, 9.0, 1.0),)) for s in perfect(crossing())]
    row = scored(crossing(), seen)
    assert row["false_touches"] == 0 and row["valid_%"] == 0
    assert row["available_%"] == 0 and row["unseen"] == 0 and row["position_%"] is None


def test_touches_that_valid_frames_never_show_are_unseen():
    row = scored(crossing(), changed(perfect(crossing()), 0, N, lambda cs: []))
    assert row["unseen"] == 2 and row["seen_%"] == 0 and row["wrong_%"] > 50


def test_ramps_are_no_steady_forces_and_a_light_touch_need_not_be_seen():
    force = np.minimum(np.arange(40) * LIGHT_N / 4, 3.0)
    recorded = recorded_of([(10 + k, 0, 0.0, 0.0, max(f, 0.01)) for k, f in enumerate(force)])
    seen = changed(perfect(recorded), 0, 14, lambda cs: [])
    seen = changed(seen, 14, 35, lambda cs: [(*c[:3], 0.5 * c[3], 0.1) for c in cs])
    row = scored(recorded, seen)
    assert row["seen_%"] == 100 and row["begin_most"] == 0
    assert row["force_%"] == 0 and row["force_all_%"] > 0


def states(**electrodes):
    said = [0] * 16
    for name, numbers in electrodes.items():
        for e in numbers:
            said[e] = ELECTRODE_STATES.index(name)
    return tuple(said)


def test_faults_are_named_when_state_and_electrodes_are_right():
    on = {"electrodes_swapped": {"electrodes": [2, 13]}}
    recorded = recorded_of([], faults=[on if 20 <= k < 40 else {} for k in range(N)])
    well = StageOutput(True, (), states())
    wrong = replace(well, electrodes=states(open=[2]), valid=False)
    right = replace(well, electrodes=states(swapped=[2, 13]))
    seen = [well] * 20 + [well] + [wrong] + [right] * 18 + [right] * 3 + [well] * 17
    (row,) = faults.rows(recorded, seen)
    assert (row["named"], row["marked"], row["well_again"]) == (3, 2, 4)
    assert row["named_%"] == 90 and row["others_named_frames"] == 0
    assert faults.false_alarms(recorded, seen) == 0
    assert faults.false_alarms(recorded, [*seen[:-5], *[right] * 5]) == 0  # it may still be recovering
    assert faults.false_alarms(recorded, [right] * 10 + seen[10:]) == 10
    assert faults.false_alarms(recorded_of([]), [well] * 30 + [right] * 30) == 30


def test_a_fault_that_nobody_names_misses_the_target():
    on = {"electrode_open": {"electrode": 5, "second": -1}}
    recorded = recorded_of([], faults=[on if 20 <= k < 40 else {} for k in range(N)])
    for named, met in ((23, False), (22, True)):
        seen = [StageOutput(True, (), states(open=[5]) if named <= k < 40 else states()) for k in range(N)]
        found = tracking.score(recorded, seen)
        assert report.goals(found)[4].met == met


SCENE = """
duration = 13.0
section = [{ t = 0.0, name = "start" }, { t = 5.0, name = "press" }, { t = 9.0, name = "open" }]
press = [
  { t = 5.5, seconds = 3.0, x = -0.02, y = 0.01, radius = 0.012, force = 3.0, to_x = 0.01 },
  { t = 9.2, seconds = 3.0, x = 0.015, y = -0.01, radius = 0.012, force = 3.0 },
]
fault = [
  { t = 6.0, name = "sequence_gaps", args = { fraction = 0.2 }, seconds = 2.0 },
  { t = 10.0, name = "electrode_open", args = { electrode = 7 }, seconds = 1.5 },
]
"""


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "short.toml"
    path.write_text(SCENE)
    return simulate(str(path), 80.0, seed=1)


def test_the_simulated_truth_is_the_scenes(short):
    assert 250 < len(short) < 290  # 13 s at 22.9 scans a second, a fifth of two seconds lost
    assert short.gap.sum() > 3 and (np.diff(short.scan) > 1).sum() == short.gap.sum()
    k = int(np.abs(short.seconds - 7.0).argmin())
    (touch,) = short.truth(k)
    along = (short.seconds[k] - 5.65) / 2.7
    assert (touch["x"], touch["y"]) == pytest.approx((-0.02 + 0.03 * along, 0.01), abs=1e-4)
    assert touch["force"] == pytest.approx(3.0) and not short.truth(int(np.abs(short.seconds - 4.0).argmin()))
    (event,) = faults.events(short)
    assert event.section == "open" and short.seconds[event.first] == pytest.approx(10.0, abs=0.06)


def test_a_few_seconds_of_the_real_thing(short):
    found = tracking.score(*tracking.follow(short, Skin(port="stub", bundle="square16")))
    row, press = found["all"], found["sections"]["press"]
    assert row["touches"] == 2 and row["unseen"] == 0 and row["false_touches"] == 0
    assert press["seen_%"] > 95 and press["position_%"] <= 1.5 and press["switches"] == 0
    assert row["position_%"] <= 1.5 and row["force_%"] < 20
    assert found["faults"][0]["named"] <= report.NAMED_WITHIN
    assert press["valid_%"] > 90  # frames in which it begins or ends may be refused


@pytest.mark.release
def test_scans_in_parts_are_scored_by_scans(tmp_path):
    path = tmp_path / "short.toml"
    path.write_text(SCENE.partition("fault =")[0])
    recorded = simulate(str(path), 80.0, seed=1, seconds=8.8, scan="rolling")
    assert set(recorded.parts) == {10} and len(recorded) == pytest.approx(8.7 * 229, rel=0.03)
    followed, seen = tracking.follow(recorded, Skin(port="stub", bundle="square16", scan="rolling"))
    assert min(s.scans for s in seen) == pytest.approx(0.1) and max(s.scans for s in seen) == 1.0
    touched = np.array([bool(s.contacts) for s in seen])
    assert np.diff(followed.seconds[touched]).min() < 0.006 < np.diff(followed.seconds[~touched][:20]).min()
    found = tracking.score(followed, seen)
    row, press = found["all"], found["sections"]["press"]
    assert row["touches"] == 1 and row["unseen"] == row["switches"] == row["false_touches"] == 0
    assert press["seen_%"] > 95 and press["position_%"] <= 1.5 and press["begin_most"] <= 1


def test_the_command_prints_tables_and_writes_strict_json(short, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tracking, "record", lambda *_: (short, 1.0))
    assert tracking.main(["--seconds", "3", "--notes", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "position error, median" in printed and "electrode_open" in printed
    content = json.loads((tmp_path / "tracking.json").read_text())
    assert content["sections"]["press"]["touches"] == 1 and len(content["targets"]) == 5  # no hold here


def test_a_contact_drifts_from_its_fast_change_until_it_is_what_it_was():
    ageing, loose = (
        PiecewiseLinear((0.0, 60.0), (1.0, 1.2)),
        PiecewiseLinear((10.0, 12.0, 20.0, 21.0), (1.0, 1.5, 1.5, 1.0)),
    )
    script = Script("drift", contact=((3, ageing), (9, loose)))
    times = [k / 20 for k in range(20 * 30)]
    on = [t for t, fault in zip(times, _drifting(script, times), strict=True) if fault]
    assert on[0] == pytest.approx(10.25, abs=0.1) and on[-1] == pytest.approx(20.9, abs=0.1)
    assert len(on) == round((on[-1] - on[0]) * 20) + 1
