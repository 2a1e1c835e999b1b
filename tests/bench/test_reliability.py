"""`skin bench faults` and `skin bench drift`: what they count is counted, and a few real cases say what they must."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from bench.goals import Goal
from bench.reliability import (
    availability,
    drift,
    drift_report,
    drifted,
    faults,
    faults_report,
    gain_steps,
    matrix,
    report,
    scenes,
    soak,
    starts,
    workers,
)
from bench.reliability.drifted import CHANGES, TouchAnswer
from bench.reliability.matrix import CONTACT_RISES, ROWS, SITUATIONS, FaultScore
from bench.reliability.random_scene import RandomScene, TimedPress, random_scene
from bench.reliability.session import Moment, PointForce, Session
from firmware_stub.faults import FAULTS, Faults
from firmware_stub.timeline import Timeline
from firmware_stub.world import World
from models.bundle import Bundle

PLACE = scenes.circle(0.012, -0.02, 3.0, 0.2)
HERE, NEAR, AWAY = PointForce(0.0, 0.0, 3.0), PointForce(0.004, 0.0, 2.9), PointForce(0.0, 0.03, 1.0)
DT = 0.0436


def said(
    k: int, contacts: Sequence[PointForce] = (), truth: Sequence[PointForce] = (), valid: bool = True, *reasons: str
):
    return Moment(k * DT, k * DT - 0.03, valid, reasons, (0,) * 16, tuple(contacts), tuple(truth), tuple(truth))


def row_of(title: str) -> matrix.Row:
    return next(row for row in ROWS if row.title == title)


# what is counted


def test_a_contact_is_wrong_only_in_a_valid_frame_and_only_far_from_every_touch():
    assert said(0, [NEAR], [HERE]).phantoms() == ()
    assert said(0, [NEAR, AWAY], [HERE]).phantoms() == (AWAY,)
    assert said(0, [NEAR], []).phantoms() == (NEAR,)
    assert said(0, [AWAY], [HERE], False).phantoms() == ()
    assert said(0, [AWAY], [HERE]).unseen() == (HERE,)
    assert said(0, [NEAR], [HERE]).unseen() == ()


def test_every_fault_of_the_stub_has_a_row_with_arguments_that_it_takes():
    assert {row.fault for row in ROWS} == set(FAULTS) | {CONTACT_RISES}
    assert len({row.title for row in ROWS}) == len(ROWS)
    known = Faults()
    for row in ROWS:
        for seed in range(20):
            args = row.draw(np.random.default_rng(seed))
            if row.fault != CONTACT_RISES:
                known.inject(row.fault, args, 0.0, 1.0)


def during(valid: bool = True, *reasons: str) -> list[Moment]:
    """A held touch; frames are as given while the fault lasts."""
    found = []
    for k in range(round(matrix.END_S / DT)):
        there = matrix.FAULT_S <= k * DT < matrix.FAULT_END_S
        found.append(said(k, [NEAR], [HERE], valid, *reasons) if there else said(k, [NEAR], [HERE]))
    return found


def test_a_case_counts_what_is_wrong_unseen_named_and_how_soon_it_is_well():
    row = row_of("electrode_open")
    well = matrix.judged(row, during(), said=False)
    assert (well.wrong, well.unseen, well.named, well.nameable, well.late) == (0, 0, 0, 1, 0)
    named = [replace(m, electrodes=(0,) * 15 + (1,)) if 7.5 < m.read_s < 8 else m for m in during()]
    assert matrix.judged(row, named, said=False).named == 1
    afterwards = [replace(m, electrodes=(0,) * 15 + (1,)) if m.read_s > 9 else m for m in during()]
    assert matrix.judged(row, afterwards, said=False).named == 0  # too late
    phantom = [replace(m, contacts=(NEAR, AWAY)) if 100 <= k < 300 else m for k, m in enumerate(during())]
    phantom[200] = replace(phantom[200], reasons=("changing",))
    found = matrix.judged(row, phantom, said=False)
    first = math.ceil(matrix.FAULT_S / DT)  # what was wrong before is not the fault's
    assert (found.wrong, found.wrong_changing, found.unseen) == (300 - first, 1, 0)
    assert matrix.judged(row, [replace(m, contacts=()) for m in during()], said=False).unseen > 100
    late = [replace(m, valid=m.read_s < 8 or m.read_s > 9.6) for m in during()]
    assert matrix.judged(row, late, said=False).late == 1
    assert matrix.judged(row, late, said=False).again_s[0] == pytest.approx(1.1, abs=2 * DT)
    never = matrix.judged(row, [replace(m, valid=m.read_s < 8) for m in during()], said=False)
    assert never.late == 1 and math.isinf(never.again_s[0])
    board = row_of("hang")
    assert (
        matrix.judged(board, during(), said=True).named == 1 and matrix.judged(board, during(), said=False).named == 0
    )
    assert matrix.judged(row_of("clipped, silent"), during(), said=False).nameable == 0  # nobody can tell
    gain = [replace(m, reasons=("gain",)) if 7.5 < m.read_s < 8 else m for m in during()]
    assert matrix.judged(row_of("gain"), gain, said=False).named == 1
    assert matrix.judged(row_of("gain"), during(), said=False).named == 0


def scene_of(*presses: TimedPress) -> RandomScene:
    return RandomScene(scenes.script(), presses, ((5.2, "hang"),))


def test_random_frames_count_phantoms_places_and_touches_that_are_not_seen():
    begin = math.ceil(soak.TARE_S / DT) + 2
    frames = [said(begin + k, [NEAR], [HERE]) for k in range(100)]
    assert soak.tallied(frames, scene_of(), 1).row()["counted"] == 100
    wrong = list(frames)
    wrong[10] = said(begin + 10, [NEAR, AWAY], [HERE])  # a phantom beside the touch
    wrong[20] = said(begin + 20, [AWAY], [HERE])  # the touch somewhere else
    wrong[30] = said(begin + 30, [AWAY], [], True, "changing")  # not counted
    wrong[40] = said(begin + 40, [AWAY], [HERE], False)
    for k in (50, 51, 60, 61, 62, 63):
        wrong[k] = said(begin + k, [], [HERE])
    wrong[52] = said(begin + 52, [], [HERE], False)  # neither goes on nor ends it
    found = soak.tallied(wrong, scene_of(), 1)
    assert (found.phantoms, found.off, found.unseen) == (1, 1, 1)
    assert found.counted == 100 - 3 and found.invalid == 2
    assert found.blamed == {"hang": 3}


def test_availability_counts_valid_frames_touches_and_changing():
    press = TimedPress(10.0, 12.0, False)
    frames = []
    for k in range(150, 350):
        touched = press.begin <= k * DT - 0.03 < press.end
        frames.append(said(k, [NEAR] * touched, [HERE] * touched))
    found = availability.scored(frames, scene_of(press), None).row()
    assert found["valid_%"] == 100 and found["reported_%"] == 100 and found["changing_most"] == 0
    at = next(k for k, m in enumerate(frames) if m.truth)
    rough = [replace(m, reasons=("changing",)) if at <= k < at + 3 else m for k, m in enumerate(frames)]
    found = availability.scored(rough, scene_of(press), None)
    assert found.changing == [3, 0] and found.row()["changing_over_2"] == 1
    blind = [replace(m, valid=not m.truth) for m in frames]
    found = availability.scored(blind, scene_of(press), None).row()
    assert found["reported_%"] == 0 and 70 < found["valid_%"] < 90


def test_free_and_right_again():
    assert starts._free_after([False] * 3 + [True] * 10) == 4
    assert starts._free_after([True] * 9 + [False] + [True] * 12) == 11
    assert math.isinf(starts._free_after([True, False] * 40))
    frames = [said(k, [NEAR], [HERE]) for k in range(20)]
    assert gain_steps.right_again(frames, 0.0) == 0.0
    assert gain_steps.right_again([said(k, [], [HERE]) for k in range(20)], 0.0) == math.inf
    frames[3] = said(3, [NEAR, AWAY], [HERE])
    assert gain_steps.right_again(frames, 0.0) == pytest.approx(4 * DT)


def test_an_answer_counts_only_where_it_is_valid_and_near():
    touch = scenes.circle(0.0, 0.0, 2.0, 0.2)
    found = drifted.answer_of(touch, True, [(0.001, 0.0, 2.2), (0.03, 0.0, 1.0)])
    assert found.found and found.extra == 1 and found.error == pytest.approx(0.1)
    assert drifted.answer_of(touch, False, [(0.001, 0.0, 2.2)]) == TouchAnswer(
        2.0, pytest.approx(0.2), False, False, -1.0, 0
    )
    roughly = drifted.answer_of(touch, True, [(0.01, 0.0, 2.0)])
    assert not roughly.found and roughly.error == pytest.approx(0.0)
    row = drifted.row([found, drifted.answer_of(touch, False, [])], 3, floor_percent=5.0)
    assert row["found_%"] == 50 and row["alarms"] == 3 and row["invalid_%"] == 50
    assert row["force_%"] == pytest.approx(55) and row["of_floor"] == pytest.approx(2.0)


# reports


def test_gates_are_of_the_quick_form_and_break_it():
    rows = {
        "untouched": gain_steps.GainStepScore(steps=2, frames=10, valid=10, false=1, again_s=[0.1], ended_s=[0.1]).row()
    }
    full, quick = (drift_report.goals({"gains": rows}, quick=q) for q in (False, True))
    assert all(goal.gate is None for goal in full) and [g.met for g in full][:2] == [False, True]
    assert drift_report.GATES["gains untouched false"] == 0
    errors = io.StringIO()
    assert report.status(full, errors) == 0 and not errors.getvalue()
    assert report.status(quick, errors) == 1 and "false contact" in errors.getvalue()


def test_every_gate_is_a_goals():
    score = FaultScore(cases=1, frames=1, again_s=[0.1])
    cells = {(row.title, situation): score for row in ROWS for situation in SITUATIONS}
    found = {
        "matrix": faults_report.matrix_rows(cells),
        "availability": {
            state: availability.AvailabilityScore(frames=1, touches=1).row() for state in availability.STATES
        },
        "soak": soak.SoakTally(frames=1).row(),
    }
    keyed = [*faults_report._of_matrix(found), *faults_report._of_availability(found["availability"])]
    assert set(faults_report.GATES) <= {key for key, _ in [*keyed, *faults_report._of_soak(found["soak"])]}
    assert len(faults_report.goals(found, True)) == 4 + 3 + 3 * 3 + 4
    faults_report.show(found)
    answer = drifted.row([TouchAnswer(1.0, 0.2, True, True, 0.1, 0)], 0, 5.0) | {"known_force_%": 1.0}
    of_drift = {
        "starts": {state: starts.StartScore(starts=1).row() for state in starts.STATES},
        "gains": {situation: gain_steps.GainStepScore(steps=1).row() for situation in gain_steps.SITUATIONS},
        "rows": {change.name: answer for change in CHANGES},
        "history": {change.name: answer for change in CHANGES},
    }
    keyed = [*drift_report._starts(of_drift["starts"]), *drift_report._gains(of_drift["gains"])]
    keyed += [*drift_report._rows(of_drift["rows"]), *drift_report._history(of_drift["history"])]
    assert set(drift_report.GATES) <= {key for key, _ in keyed} and len(keyed) == 25
    drift_report.show(of_drift)


def test_what_was_not_found_at_all_misses_its_target():
    answers = [TouchAnswer(1.0, 0.2, False, False, -1.0, 0)]
    rows = {change.name: drifted.row(answers, 0, 5.0) | {"known_force_%": 100.0} for change in CHANGES}
    goals = {goal.figure: goal for goal in drift_report.goals({"rows": rows}, quick=False)}
    assert goals["force error, rms, all radii, times the floor"].met is False
    assert Goal("never", math.inf, at_most=2.0).met is False


# the real thing


def test_what_was_solved_is_kept_and_met_again(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes, "WORK", tmp_path)
    (tmp_path / "other-code.npz").write_bytes(b"")
    world = World((PLACE,))
    first = scenes.SolvedSheet()
    solved = first.transfer(world)
    assert first.transfer(World((PLACE, replace(PLACE, drop=0.0)))) is solved and first.solves == 1
    first.close()
    assert [path.name.split("-")[0] for path in tmp_path.iterdir()] == [first._code]
    second = scenes.SolvedSheet()
    assert np.array_equal(second.transfer(world), solved) and second.solves == 0
    assert second.transfer(World()) is not solved and second.solves == 1
    second.close(least=2)
    assert len(list(tmp_path.iterdir())) == 1
    second.close()
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(scenes, "MOST_FILES", 1)
    assert scenes.SolvedSheet().transfer(world) is not None and len(list(tmp_path.iterdir())) == 1  # gathered
    third = scenes.SolvedSheet()
    assert np.array_equal(third.transfer(world), solved) and third.transfer(World()) is not None and not third.solves


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "WORK", tmp_path_factory.mktemp("solved"))
        workers.sheet.cache_clear()
        yield workers.sheet()
        workers.sheet.cache_clear()


@pytest.mark.parametrize("title", ["unplug", "hang", "wrong_chip_id", "electrode_open", "power_cycle"])
def test_these_faults_are_named_never_wrong_and_over_in_time(sheet, title):
    row = row_of(title)
    score = matrix.run_case(sheet, workers.pipeline(), row, "held", PLACE, 3)
    figures = score.row()
    assert figures["named_%"] == 100 and figures["late"] == 0
    assert figures["wrong"] == figures["wrong_changing"]  # rough places at most
    assert 100 < score.frames < 190 and figures["unseen"] == 0


def test_a_contact_that_jumps_under_a_slide_is_named_and_is_no_second_touch(sheet):
    """It differs from the frames before for a few frames only, and the touch is not where it was."""
    found = matrix.run_case(sheet, workers.pipeline(), row_of(CONTACT_RISES), "sliding", matrix.places(2, 5)[0], 5)
    assert (found.wrong, found.named, found.late) == (0, 1, 0)
    assert found.during_valid > found.during / 2


def test_no_frame_after_a_fault_hides_a_touch_that_waits_to_be_confirmed(sheet):
    place = matrix.places(2, 5)[1]
    score = matrix.run_case(sheet, workers.pipeline(), row_of("fifo_overflow"), "held", place, 6)
    assert score.unseen == score.wrong == score.late == 0


@pytest.mark.release
def test_a_gain_that_was_believed_while_nothing_was_explained_is_given_up(sheet):
    """Else nothing explains the scans after the fault, until a skin is too long unexplained."""
    row = row_of("fifo_overflow, silent")
    for place in matrix.places(2, 5):
        score = matrix.run_case(sheet, workers.pipeline(), row, "begins", place, 5)
        assert score.wrong == score.late == 0


@pytest.mark.release
def test_what_stands_beside_an_open_electrode_is_asked_whether_it_is_one(sheet):
    """An electrode off the skin changes the rest of it as a touch would: one such stood for eleven seconds."""
    found = availability.session(sheet, workers.pipeline(), "electrode dead", 1500, 5000).row()
    assert found["wrong"] == 0 and found["named_%"] == 100 and found["reported_%"] == 100


@pytest.mark.release
@pytest.mark.parametrize("scan", ["full", "rolling"])
def test_two_touches_that_begin_together_are_never_one_between_them(sheet, scan):
    touches = scenes.touches_at_random(16, 23)
    pairs = zip(touches[::2], touches[1::2], strict=True)
    pairs = [(a, b) for a, b in pairs if math.hypot(a.x - b.x, a.y - b.y) > 0.025]
    begins = [8.0 + 1.51 * k for k in range(len(pairs))]
    tracks = [
        scenes.press(touch, at, at + 0.7, ramp=(0.005, 0.03, 0.1)[k % 3])
        for k, (pair, at) in enumerate(zip(pairs, begins, strict=True))
        for touch in pair
    ]
    session = Session(sheet, scenes.script(tuple(tracks)), 23, workers.pipeline(scan=scan))
    moments = list(session.run(begins[-1] + 1.2))
    session.close()
    assert len(pairs) > 4 and not any(m.phantoms() for m in moments)
    for at in begins:
        held = [m for m in moments if at + 0.3 < m.middle_s < at + 0.55]
        assert all(m.valid and len(m.contacts) == 2 for m in held), at


def test_without_a_fault_a_skin_says_what_touches(sheet):
    found = availability.session(sheet, workers.pipeline(), "ok", 600, 2).row()
    assert found["touches"] > 1 and found["reported_%"] == 100 and found["valid_%"] > 95 and found["wrong"] == 0


@pytest.fixture(scope="module")
def drifting_contact(sheet):
    """What the skin changes by is seen through the changed contact: learnt without it, the drift's covariance was none
    after a minute, and no frame came any more.
    """
    return availability.session(sheet, workers.pipeline(), "electrode drifting", 1500, 11004).row()


@pytest.mark.release
def test_drift_is_followed_beside_touches_where_a_contact_has_changed_for_good(drifting_contact):
    assert drifting_contact["valid_%"] > 99 and drifting_contact["reported_%"] == 100


@pytest.mark.release
def test_no_frame_is_wrong_where_a_contact_has_changed_for_good(drifting_contact):
    assert drifting_contact["wrong"] == 0


def test_random_scenes_have_presses_faults_and_never_more_than_two_touches():
    scene = random_scene(200.0, 4)
    assert len(scene.presses) > 20 and len(scene.faults) > 5
    assert random_scene(200.0, 4).script == scene.script != random_scene(200.0, 5).script
    timeline = Timeline(scene.script)
    most = max(len(timeline.at(t).touches) for t in np.arange(0.0, 200.0, 0.5))
    assert 1 <= most <= 2
    assert not timeline.at(4.9).touches
    assert random_scene(200.0, 4, faults=False).faults == ()


def test_rows_without_drift_are_found(sheet):
    answers, alarms = drifted.rows_alone(
        sheet, Bundle.load("square16"), CHANGES[0], [(0.01, 0.01), (-0.02, 0.015)], 1, 0.2, False
    )
    assert alarms == 0 and all(a.found and a.valid and not a.extra for a in answers)
    assert {round(a.newtons) for a in answers} == {1, 3, 5}


def test_a_small_gain_step_is_no_touch(sheet):
    found = gain_steps.step(sheet, workers.pipeline(), 0.002, "untouched", PLACE, 1)
    assert found.false == found.ended_false == found.late == 0 and found.frames == gain_steps.LASTS


def test_the_command_says_what_it_knows(capsys):
    for argv in (["--only", "nonsense"], ["--frames", "3"]):
        with pytest.raises(SystemExit):
            faults.main(argv)
    assert "expected the beginning of" in (text := capsys.readouterr().err) and "200 to" in text
    with pytest.raises(SystemExit):
        drift.main(["--only", "nonsense"])


def test_the_command_prints_a_table_and_writes_a_report(sheet, capsys, tmp_path, monkeypatch):
    for module in (faults, faults_report):
        monkeypatch.setattr(module, "SITUATIONS", ("untouched",))
    assert faults.main(["--only", "gain", "--places", "1", "--cores", "1", "--out", str(tmp_path)]) == 0
    assert "fault matrix" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert faults.main(["--frames", "200", "--cores", "1", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "soak.json").is_file() and "random faults and presses" in capsys.readouterr().out


def test_more_random_frames_are_added_to_those_of_the_last_report(tmp_path, monkeypatch, capsys):
    seeds = []

    def spread(work, tasks, cores, what):
        seeds.extend(seed for _, seed, _ in tasks)
        yield from (soak.SoakTally(chunks=1, frames=frames, counted=frames - 1) for frames, _, _ in tasks)

    monkeypatch.setattr(workers, "spread", spread)
    words = ["--frames", str(2 * soak.CHUNK), "--cores", "1", "--out", str(tmp_path)]
    assert faults.main(words) == 0 and faults.main([*words, "--more"]) == 0
    report = json.loads((tmp_path / "soak.json").read_text())
    assert report["soak"]["frames"] == 4 * soak.CHUNK and report["soak"]["chunks"] == 4
    assert [run["frames"] for run in report["runs"]] == [2 * soak.CHUNK] * 2
    assert len(set(seeds)) == 4
    with pytest.raises(SystemExit):
        faults.main([*words, "--more", "--seed", "9"])
    assert "is of seed 5" in capsys.readouterr().err
