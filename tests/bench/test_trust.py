"""`skin bench trust` and `skin bench shadow`: what is counted, and that nothing of it is counted of what is right."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.trust import __main__ as trust
from bench.trust import candidates, floor, kept, runs, shadow
from bench.trust.candidate import Today
from bench.trust.judge import Judge
from bench.trust.scene import BEGIN_S, SceneDrawer, Trouble, TrustScene
from bench.trust.score import TrustScore
from bench.trust.truth import SceneTruth
from firmware_stub.timeline import Script
from firmware_stub.world import World
from firmware_stub.worlds import table
from protocol.frames import Contact, ContactFrame, RawFrame, pack, unpack
from services.estimation.values import numbers
from services.recordings import golden
from services.recordings.replay_session import private_runtime
from tests.bench.trust_sessions import frames, played, press, scene, today

FRAME_S = 0.0436


@pytest.fixture(autouse=True)
def _private_runtime() -> Iterator[None]:
    with private_runtime():
        yield


def judged(
    what: TrustScene,
    says: dict[float, list[Contact]] | None = None,
    *,
    late_s: float = 0.03,
    refused: bool = False,
    **frame: object,
) -> TrustScore:
    """The score of frames that show exactly what touches, but for those between the times that `says` has (from the
    first of two on, until the next).
    """
    sheet = table.sheet("plain", 1)
    truth = SceneTruth(what, sheet)
    judge = Judge(truth)
    changes = sorted((says or {}).items())
    for k in range(int(what.seconds / FRAME_S)):
        t = k * FRAME_S
        right = [contact(p.x, p.y, p.force_n, number=p.number + 1) for p in truth.at(t)]
        said = [contacts for since, contacts in changes if since <= t]
        shown = said[-1] if said and said[-1] is not None else right
        made = ContactFrame(
            skin="palm", scan=k, stamps={"sample": round(t * 1e9)}, valid=True, valid_for_s=0.13, contacts=shown
        )
        judge.look(t + late_s, replace(made, **frame), refused)
    return judge.finish()


def contact(x: float, y: float, force: float, number: int = 1, sigma: float = 0.05) -> Contact:
    return Contact(
        id=number, position=[x, y, 0.0], force_n=force, force_sigma_n=sigma, position_sigma=[1e-4, 1e-4, 0.0]
    )


HELD = scene(12.0, press(7.0, 11.0, 3.0, 0.02, 0.0))
WRONG = (
    "phantom", "phantom incidents", "wrong count", "hidden", "never shown", "id changed", "refused", "aged",
    "named falsely", "named late", "changing", "coarse", "hidden briefly", "hidden briefly, none shown",
)  # fmt: skip


def test_nothing_is_counted_of_frames_that_are_right() -> None:
    score = judged(HELD)
    assert score.counts["frames"] > 100 and score.counts["touches"] == 1
    assert {key: score.counts[key] for key in WRONG} == dict.fromkeys(WRONG, 0)
    assert score.beyond("force", 3) == score.beyond("place", 3) == 0.0
    assert score.percent("touched valid", "touched") == score.percent("untouched valid", "untouched") == 100.0


@pytest.mark.parametrize(
    ("says", "counted"),
    [
        ({6.5: [contact(0.0, 0.0, 1.0)], 6.6: None}, {"phantom": 2, "phantom incidents": 1}),
        ({8.0: [contact(0.02, 0.016, 3.0)], 8.3: None}, {"phantom": 7, "phantom incidents": 1}),
        ({8.0: [contact(0.02, 0.014, 3.0)], 8.3: None}, {"phantom": 0, "hidden": 0}),
        ({8.0: [], 8.09: None}, {"wrong count": 0, "hidden": 0}),
        ({8.0: [], 8.25: None}, {"wrong count": 1, "hidden": 0}),
        ({8.0: [], 8.5: None}, {"wrong count": 1, "hidden": 1, "never shown": 0}),
        ({6.0: []}, {"wrong count": 1, "hidden": 1, "never shown": 1}),
        ({8.0: [contact(0.02, 0.0, 3.0, number=9)], 9.0: None}, {"id changed": 2}),
    ],
)
def test_what_must_not_be_is_counted(says: dict[float, list[Contact]], counted: dict[str, int]) -> None:
    score = judged(HELD, says)
    assert {key: score.counts[key] for key in counted} == counted
    assert bool(score.notes) == any(counted.values()) or set(counted) == {"id changed"}


@pytest.mark.parametrize(
    ("says", "frames", "none_shown", "hidden"),
    [
        ({6.5: [], 7.13: None}, 0, 0, 0),  # fully from 7.1 s on: their scans begin before
        ({6.5: [], 7.16: None}, 1, 1, 0),
        ({8.0: [], 8.09: None}, 2, 2, 0),
        ({8.0: [contact(0.02, 0.016, 3.0)], 8.09: None}, 2, 0, 0),
        ({8.0: [], 10.0: None}, 7, 7, 1),  # the first 0.3 s
    ],
)
def test_valid_frames_that_hide_a_touch_for_less_than_an_incident_are_counted(
    says: dict[float, list[Contact]], frames: int, none_shown: int, hidden: int
) -> None:
    counts = judged(HELD, says).counts
    found = [counts[key] for key in ("hidden briefly", "hidden briefly, none shown", "hidden")]
    assert found == [frames, none_shown, hidden]
    assert judged(HELD, says, valid=False).counts["hidden briefly"] == 0


def test_a_contact_on_the_way_of_a_slide_is_no_phantom() -> None:
    slide = press(7.0, 9.0, 3.0, -0.03, 0.0)
    path = replace(slide, poses=(*slide.poses[:2], *(replace(pose, x=0.03) for pose in slide.poses[2:])))
    fast = replace(path, times=(7.0, 7.1, 7.3, 9.0))  # 0.3 m/s
    behind = SceneTruth(scene(10.0, fast), table.sheet("plain", 1)).paths[0].at(7.2 - FRAME_S)
    assert behind is not None
    shown = {7.2: [contact(behind.x - 0.01, 0.0, 3.0)], 7.21: None}
    assert judged(scene(10.0, fast), shown).counts["phantom"] == 0


def test_errors_are_counted_by_phase_and_their_width_is_kept() -> None:
    off = [contact(0.02, 0.0, 3.2)]
    score = judged(HELD, {8.0: off, 9.0: None})
    beyond = score.counts["force 3/hold"]
    assert 20 <= beyond <= 25 and score.counts["force 6/hold"] == 0
    assert judged(HELD, {8.0: [contact(0.0205, 0.0, 3.0)], 9.0: None}).counts["place 3/hold"] == beyond
    assert judged(HELD, {8.0: [contact(0.0207, 0.0, 3.0)], 9.0: None}).counts["place 6/hold"] == beyond
    wide = judged(HELD, {7.0: [contact(0.02, 0.0, 3.2, sigma=0.5)], 11.0: None})
    assert wide.counts["force 3/hold"] == 0
    assert wide.median_sigma("force") == pytest.approx(0.5, rel=0.1)
    assert score.median_sigma("force") == pytest.approx(0.05, rel=0.1)
    right, hidden_in_sigma = judged(HELD).log_score("force"), wide.log_score("force")
    assert right is not None and hidden_in_sigma is not None and hidden_in_sigma < right - 2


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
    assert (named.counts["faults"], named.counts["named"], named.counts["named late"]) == (1, 1, 0)
    assert named.counts["named falsely/gain"] > 0  # before it began
    assert judged(with_fault, reasons=["multiplexer"]).counts["named"] == 0
    late = replace(HELD, troubles=(replace(trouble, begin=6.0, within_s=-0.5),))
    assert judged(late, reasons=["gain"]).counts["named late"] == 1
    share = judged(with_fault, valid=False)
    assert share.percent("in fault valid/gain", "in fault/gain") == 0.0


def test_scores_add_up_and_survive_the_disk(tmp_path: Path) -> None:
    one = judged(HELD, {8.0: [], 8.5: None})
    store = kept.KeptScore("plain-full", "seed", tmp_path)
    store.add(one)
    store = kept.KeptScore("plain-full", "seed", tmp_path)
    assert store.number == 1
    store.add(one)
    again = kept.KeptScore("plain-full", "seed", tmp_path).score
    assert again.counts["hidden"] == 2 and again.seconds == 24.0 and again.sessions == 2
    assert again.median_sigma("force") == one.median_sigma("force")
    bad = judged(HELD, {7.0: [contact(0.02, 0.0, 6.0)], 11.0: None})
    store.add(bad)
    assert bad.sums["force log"] < 0
    assert store.score.sums["force log"] == pytest.approx(2 * one.sums["force log"] + bad.sums["force log"])
    assert kept.KeptScore("plain-full", "other", tmp_path).number == 0


def test_a_scene_is_drawn_from_its_seed_within_its_bounds() -> None:
    sheet = table.sheet("plain", 1)
    one, same, other = (SceneDrawer(sheet, seed, 60.0).draw() for seed in (1, 1, 2))
    assert one == same != other
    kinds = set()
    for drawn in (one, other):
        assert drawn.tares[0] == 5.0
        for path in drawn.script.tracks:
            touch = path.poses[1]
            kinds.add(touch.kind)
            assert path.times[0] >= BEGIN_S and path.times[-1] < 70.0
            assert 0.004 <= touch.radius <= 0.025 and 0.29 < touch.force_n < 8.01
            assert max(abs(touch.x), abs(touch.y)) + touch.radius <= 0.0496
            at_once = [o.pose(path.times[1], path.times[1]) for o in drawn.script.tracks if o is not path]
            apart = [np.hypot(o.x - touch.x, o.y - touch.y) for o in at_once if o]
            assert min(apart, default=1.0) > 0.02
    assert "circle" in kinds and len(kinds) > 1


@pytest.mark.release
def test_every_kind_of_fault_is_drawn_in_every_situation() -> None:
    sheet = table.sheet("plain", 1)
    found = [t for seed in range(8) for t in SceneDrawer(sheet, seed, 120.0).draw().troubles]
    assert {t.situation for t in found} >= {"", "untouched", "held", "sliding", "begins", "electrode", "two"}
    assert len({t.what for t in found}) >= 11
    assert any(t.what == "none" for t in found)


class Blind(Today):
    """The service's stages, but for what they say: always that somebody presses in the middle."""

    def step(self, raw: RawFrame) -> ContactFrame | None:
        frame = super().step(raw)
        return frame and replace(frame, valid=True, contacts=[contact(0.0, 0.0, 1.0)])


def shadowed(tmp_path: Path, candidate: str) -> int:
    return shadow.main(
        f"--world plain --scan full --minutes 0.15 --session 9 --seed 5 --cores 1 --out {tmp_path}".split()
        + ["--candidate", candidate]
    )


def test_the_service_differs_from_itself_in_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "WORK", tmp_path)
    sessions = runs.run(
        "plain", "full", "5", 0.15, session_s=9.0, folder=tmp_path,
        candidates=(("today", "bench.trust.candidate:Today"), ("candidate", "bench.trust.candidate:Today")),
    )  # fmt: skip
    today_score, again = (replace(score, cpu_s=0.0) for score in sessions.values())
    assert today_score.counts["frames"] > 50 and today_score == again


@pytest.mark.release
def test_a_blind_candidate_is_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kept, "WORK", tmp_path)
    assert shadowed(tmp_path, "tests.bench.test_trust:Blind") == 1
    assert "phantom frames, the service 0" in capsys.readouterr().err


@pytest.mark.release
def test_a_failing_session_is_kept_as_a_recording_that_replays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = runs.run(
        "plain", "rolling", "5", 0.14, session_s=8.4, folder=tmp_path,
        candidates=(("today", "tests.bench.test_trust:Blind"),),
    )["today"]  # fmt: skip
    (recording,) = tmp_path.rglob("*.mcap")
    assert found.counts["phantom"] > 10
    lines = golden.run(recording)
    assert sum(line["valid"] for line in lines) > 100


def test_minutes_of_earlier_runs_count(tmp_path: Path) -> None:
    first = runs.run("plain", "full", "6", 0.15, session_s=9.0, folder=tmp_path)["today"]
    same = runs.run("plain", "full", "6", 0.15, session_s=9.0, folder=tmp_path)["today"]
    assert (first.sessions, same.sessions) == (1, 1) and same.cpu_s == first.cpu_s


def test_the_floor_is_the_force_from_which_on_all_are_shown() -> None:
    steps = [floor.LadderStep(0.01, force, 0.0, 0.0, 0.0, 1.0) for force in (0.1, 0.2, 0.4, 0.8)]
    said = [(0, 0.05), (999, 0.05), (1000, 0.2), (1000, 0.1)]  # shown of 1000, sigma
    frames_of = {}
    for step, (shown, sigma) in zip(steps, said, strict=True):
        right = ContactFrame(skin="palm", valid=True, contacts=[contact(0.0, 0.0, step.force, sigma=sigma)])
        none = ContactFrame(skin="palm", valid=True, contacts=[])
        frames_of[step] = [right] * shown + [none] * (1000 - shown)
    assert floor.floors(frames_of) == {0.01: {"shown_n": 0.2, "sure_n": 0.8}}
    frames_of[steps[2]] = [replace(frame, valid=False) for frame in frames_of[steps[2]]]
    assert floor.floors(frames_of) == {0.01: {"shown_n": 0.8, "sure_n": 0.8}}
    drawn, ladder = floor.ladder()
    assert {step.radius for step in ladder} == set(floor.RADII_M) and drawn.seconds < 400


def test_worlds_are_listed_and_others_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert trust.main(["--worlds"]) == 0
    assert "warm-hand: the touching hand warms its place (reported only)" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        trust.main(["--world", "moon"])
    assert "invalid choice: 'moon'" in capsys.readouterr().err
    assert shadow.main.__module__ == "bench.trust.shadow"


def test_a_candidate_with_other_numbers_has_them_while_it_runs_alone(tmp_path: Path) -> None:
    names = "without-memory", "FALSE_ALARM_Z2*1e6"
    found = runs.run(
        "creep", "full", "5", 0.2, session_s=12.0, folder=tmp_path,
        candidates=(("today", candidates.TODAY), *((name, name) for name in names)),
    )  # fmt: skip
    shown = {name: score.counts["touches"] - score.counts["never shown"] for name, score in found.items()}
    assert shown["today"] > 0 and shown["FALSE_ALARM_Z2*1e6"] < shown["today"]
    assert float(numbers.FALSE_ALARM_Z2) == 44.0


@pytest.mark.parametrize(
    "name, says",
    [
        ("without-luck", "no part 'luck' of the model: expected one of rates, "),
        ("LUCK*2", "no number 'LUCK'"),
        ("MEMORY_SHARE", "expected NAME\\*FACTOR, as MEMORY_SHARE\\*2"),
        ("nowhere:Nobody", "no candidate 'nowhere:Nobody'"),
    ],
)
def test_a_candidate_that_is_none_is_refused(name: str, says: str) -> None:
    with pytest.raises(candidates.UnknownCandidate, match=says):
        candidates.kind_of(name)


def test_the_truth_says_nothing_of_what_a_world_hides() -> None:
    what = scene(12.0, press(7.0, 9.0, 3.0, 0.0, 0.0))
    session = played(what, "full", world="creep")
    assert session.rig.field.at(9.2).residues
    truth = SceneTruth(what, session.sheet)
    assert truth.at(8.0)[0].force_n == pytest.approx(3.0)
    assert truth.at(9.2) == []
    session.rig.close()


def test_frames_of_a_session_are_those_of_the_service() -> None:
    what = scene(8.6, press(7.0, 8.4, 3.0, 0.01, 0.0))
    shown = [f for t, f in frames(what, "rolling") if 7.3 < t < 8.2]
    assert len(shown) > 150
    assert all(f.valid and len(f.contacts) == 1 for f in shown)
    assert {type(unpack(pack(f))) for f in shown[:3]} == {ContactFrame}
    assert Script("x").world(0.0, 0.0, 16) == World()
    assert today(played(scene(1.0), "full")).refused is False
