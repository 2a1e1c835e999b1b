"""`skin bench trust`: what is counted, and that nothing of it is counted of what is right. `skin dev same`."""

from dataclasses import replace

import pytest

from bench import ROOT, same
from bench.trust import plans, runs
from bench.trust.judge import Judge
from bench.trust.scene import Trouble, TrustScene
from bench.trust.score import TrustScore
from bench.trust.session import PlayedSession, SessionPlan
from firmware_stub.worlds import table
from protocol.frames import Contact, ContactFrame
from simulation.host import loaded
from simulation.scenes import DiscPress, script
from simulation.truth import TruePaths

FRAME_S = 0.0436


def judged(what: TrustScene, says=None, *, late_s: float = 0.03, refused: bool = False, **frame: object) -> TrustScore:
    """The score of frames that show exactly what touches, but for those from a time that `says` has until the next."""
    judge, changes = Judge(what), sorted((says or {}).items())
    for k in range(int(what.seconds / FRAME_S)):
        t = k * FRAME_S
        right = [contact(p.x, p.y, p.force_n, number=p.number + 1) for p in judge.truth.at(t)]
        said = [contacts for since, contacts in changes if since <= t]
        shown = said[-1] if said and said[-1] is not None else right
        made = ContactFrame(skin="palm", scan=k, stamps={"sample": round(t * 1e9)}, valid=True, contacts=shown)
        judge.look(t + late_s, replace(made, **{"valid_for_s": 0.13, **frame}), refused)
    return judge.finish()


def contact(x: float, y: float, force: float, number: int = 1, sigma: float = 0.05) -> Contact:
    sigmas = {"force_sigma_n": sigma, "position_sigma": [1e-4, 1e-4, 0.0]}
    return Contact(id=number, position=[x, y, 0.0], force_n=force, **sigmas)


def press(begin, end, force, x, y):
    """A disc whose force rises and falls within 0.1 s."""
    return DiscPress(x, y, begin, end, force, 0.1).path()


def scene(seconds, *tracks):
    return TrustScene(seconds, script(*tracks))


HELD = scene(12.0, press(7.0, 11.0, 3.0, 0.02, 0.0))
BRIEFLY, NONE = "hidden briefly", "hidden briefly, none shown"


def test_nothing_is_counted_of_frames_that_are_right() -> None:
    score = judged(HELD)
    assert score.counts["frames"] > 100 and score.counts["touches"] == 1
    right = {"frames", "touches", "touched", "touched valid", "untouched", "untouched valid", "force n", "place n"}
    assert {key.partition("/")[0] for key, count in score.counts.items() if count} == right
    assert score.beyond("force", 3) == score.beyond("place", 3) == 0.0
    assert score.percent("touched valid", "touched") == score.percent("untouched valid", "untouched") == 100.0


@pytest.mark.parametrize(("says", "counted"), [
    ({6.5: [contact(0.0, 0.0, 1.0)], 6.6: None}, {"phantom": 2, "phantom incidents": 1}),
    ({8.0: [contact(0.02, 0.016, 3.0)], 8.3: None}, {"phantom": 7, "phantom incidents": 1}),
    ({8.0: [contact(0.02, 0.014, 3.0)], 8.3: None}, {"phantom": 0, "hidden": 0}),
    ({8.0: [], 8.09: None}, {"wrong count": 0, "hidden": 0}),
    ({8.0: [], 8.25: None}, {"wrong count": 1, "hidden": 0}),
    ({8.0: [], 8.5: None}, {"wrong count": 1, "hidden": 1, "never shown": 0}),
    ({6.0: []}, {"wrong count": 1, "hidden": 1, "never shown": 1}),
    ({8.0: [contact(0.02, 0.0, 3.0, number=9)], 9.0: None}, {"id changed": 2}),
    ({6.5: [], 7.13: None}, {BRIEFLY: 0, NONE: 0}),  # fully from 7.1 s on: their scans begin before
    ({6.5: [], 7.16: None}, {BRIEFLY: 1, NONE: 1, "hidden": 0}),
    ({8.0: [contact(0.02, 0.016, 3.0)], 8.09: None}, {BRIEFLY: 2, NONE: 0, "hidden": 0}),
    ({8.0: [], 10.0: None}, {BRIEFLY: 7, NONE: 7, "hidden": 1}),  # the first 0.3 s
])  # fmt: skip
def test_what_must_not_be_is_counted(says, counted) -> None:
    score = judged(HELD, says)
    assert {key: score.counts[key] for key in counted} == counted
    assert judged(HELD, says, valid=False).counts[BRIEFLY] == 0


def test_a_contact_on_the_way_of_a_slide_is_no_phantom() -> None:
    slide = press(7.0, 9.0, 3.0, -0.03, 0.0)
    path = replace(slide, poses=(*slide.poses[:2], *(replace(pose, x=0.03) for pose in slide.poses[2:])))
    fast = replace(path, times=(7.0, 7.1, 7.3, 9.0))  # 0.3 m/s
    behind = TruePaths((fast,)).paths[0].at(7.2 - FRAME_S)
    shown = {7.2: [contact(behind.x - 0.01, 0.0, 3.0)], 7.21: None}
    assert judged(scene(10.0, fast), shown).counts["phantom"] == 0


def test_errors_are_counted_by_phase_and_their_width_is_kept() -> None:
    score, wide = (judged(HELD, {8.0: [contact(0.02, 0.0, 3.2, sigma=s)], 9.0: None}) for s in (0.05, 0.5))
    beyond = score.counts["force 3/hold"]
    assert 20 <= beyond <= 25 and score.counts["force 6/hold"] == wide.counts["force 3/hold"] == 0
    for x, limit in ((0.0205, 3), (0.0207, 6)):
        assert judged(HELD, {8.0: [contact(x, 0.0, 3.0)], 9.0: None}).counts[f"place {limit}/hold"] == beyond
    wide = judged(HELD, {7.0: [contact(0.02, 0.0, 3.2, sigma=0.5)], 11.0: None})
    assert wide.median_sigma("force") == pytest.approx(0.5, rel=0.1)
    assert score.median_sigma("force") == pytest.approx(0.05, rel=0.1)
    assert wide.log_score("force") < judged(HELD).log_score("force") - 2


def test_ages_refused_images_and_words_are_counted() -> None:
    assert judged(HELD, late_s=0.12).counts["aged"] == 0
    aged = judged(HELD, late_s=0.14)
    assert aged.counts["aged"] == aged.counts["frames"]
    refused = judged(HELD, refused=True)
    assert 85 < refused.counts["refused"] < 95
    assert judged(HELD, reasons=["changing"]).percent("changing", "touched valid") == 100.0
    assert judged(HELD, valid=False).percent("touched valid", "touched") == 0.0


def test_faults_are_named_named_late_or_named_falsely() -> None:
    trouble = Trouble("gain", "held", 8.0, 9.0, ("gain",))
    with_fault = replace(HELD, troubles=(trouble,))
    named = judged(with_fault, reasons=["gain"])
    assert [named.counts[key] for key in ("faults", "named", "named late")] == [1, 1, 0]
    assert named.counts["named falsely/gain"] > 0  # before it began
    assert judged(with_fault, reasons=["multiplexer"]).counts["named"] == 0
    late = replace(HELD, troubles=(replace(trouble, begin=6.0, within_s=-0.5),))
    assert judged(late, reasons=["gain"]).counts["named late"] == 1
    assert judged(with_fault, valid=False).percent("in fault valid/gain", "in fault/gain") == 0.0


def test_a_fault_is_named_by_the_board_too_and_frames_are_valid_again_in_time() -> None:
    what = replace(HELD, troubles=(Trouble("hang", "held", 8.0, 8.5, (), 1.0, True, 1.0),))
    for named, valid_s in ((True, 9.0), (False, 10.0)):
        judge = Judge(what)
        judge.heard(8.2 if named else 5.0, "the board is silent")
        for k in range(200):
            t = 5.5 + k * FRAME_S
            frame = ContactFrame(skin="palm", scan=k, stamps={"sample": round(t * 1e9)}, valid=not 8.0 < t < valid_s)
            judge.look(t, frame, False)
        counts = judge.finish().counts
        assert (counts["named"], counts["back late"]) == ((1, 0) if named else (0, 1))


def test_every_plan_draws_its_rows_from_seed_and_number() -> None:
    sheet = table.sheet("plain", 1)
    for name, plan in plans.PLANS.items():
        for row in plan.rows[:2]:
            tasks = runs.TrustRun(name, "seed", 20.0).tasks(row, "full")[:2]
            first, second = (replace(task.plan, seconds=20.0) for task in tasks)
            one = plan.scene(first, sheet)
            assert one == plan.scene(first, sheet) and (one != plan.scene(second, sheet) or name == "tracking")
    held = plans.fault_scene(SessionPlan("plain", 1, 38.0, plan="faults", row="hang"), sheet)
    assert [trouble.situation for trouble in held.troubles] == list(plans.SITUATIONS) and len(held.script.tracks) == 3


@pytest.mark.live
@pytest.mark.release
def test_another_checkout_says_the_same_of_the_same_frames_and_what_is_kept_is_not_played_again(tmp_path, monkeypatch):
    """Its stages in a process of their own, an act included."""
    run = runs.TrustRun("worlds", "5", 0.15, ("", str(ROOT)), seconds=9.0)
    found = run.scores(["plain"], ["full"], runs.KeptScores(tmp_path / "kept.json"))
    ours, other = found["plain", "full"].values()
    assert ours.counts["frames"] > 50 and ours.counts == other.counts and ours.notes == other.notes
    monkeypatch.setattr(runs, "play", None)
    again = run.scores(["plain"], ["full"], runs.KeptScores(tmp_path / "kept.json"))["plain", "full"]
    assert again[""].counts == ours.counts and again[""].median_sigma("force") == ours.median_sigma("force")


def test_the_truth_says_nothing_of_what_a_world_hides() -> None:
    what = scene(12.0, press(7.0, 9.0, 3.0, 0.0, 0.0))
    plan, skin = SessionPlan("creep", 3, what.seconds), runs.skin_of("full", "square16")
    session = PlayedSession(plan, what, table.sheet("creep", 3), skin, loaded("square16"))
    assert session.host.rig.field.at(9.2).residues
    truth = TruePaths(what.script.tracks, session.sheet)
    assert truth.at(8.0)[0].force_n == pytest.approx(3.0) and truth.at(9.2) == []
    session.host.close()


def test_the_same_is_the_same_and_another_number_is_seen(tmp_path, monkeypatch):
    def lines():
        same.record(tmp_path / "lines", "adaptive")
        return same.read(tmp_path / "lines")["recording adaptive"]

    found = lines()
    assert len(found) > 500 and not same.difference(found, lines())
    monkeypatch.setattr("services.preprocessing.PLACE_SIGMA", 1.1e-4)
    assert "estimates\n  here   [{" in same.difference(found, lines())
