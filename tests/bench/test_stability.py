"""The worst of `skin bench stability` as tests: what holds whatever a board sends; and that the benchmark can fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.stability import changed_bytes as bytes_of_others
from bench.stability import garbage, report
from bench.stability import key_attacks as keys
from bench.stability import late_bytes as held_up
from bench.stability.matrices import solved_long
from bench.stability.run import (
    METRES,
    TOUCHES,
    Answer,
    InProcessStages,
    Scene,
    Setting,
    judged,
    noisy,
    summary,
)
from models.bundle import Bundle
from models.forward import shared
from models.shapes import Array
from protocol.frames import Contact
from services.estimation.first.baseline import Baseline, NoBaseline
from tests import needs

RELATIVE = 10 ** (-80 / 20)  # the board's noise


@pytest.fixture(scope="module")
def setting() -> Setting:
    return Setting(Bundle.load("square16"), quick=True, seed=3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A touch of 3 N solved on the coarsest of the project's meshes."""
    model, touch = shared("square16", "inverse"), TOUCHES[1]
    z0 = np.abs(model.solve(1.0).impedances())
    return Scene(touch, np.abs(model.solve(model.touched([touch])).impedances()), z0)


@pytest.fixture(scope="module")
def runner(setting: Setting) -> InProcessStages:
    return InProcessStages(setting.bundle)


@pytest.fixture
def baseline(runner: InProcessStages, scene: Scene) -> Baseline:
    return runner.tare(scene.z0, RELATIVE, np.random.default_rng(0))


def distance_mm(answer: Answer, other: Array) -> float:
    place = answer.place()
    assert place is not None, answer.reasons
    return 1e3 * float(np.hypot(*(place - other)))


@pytest.mark.parametrize("exponent", [-9, 9])
def test_the_unit_of_the_measurements_divides_out(runner: InProcessStages, scene: Scene, exponent: int) -> None:
    factor, noise = 10.0**exponent, np.random.default_rng(1)
    z = noisy(scene.z, RELATIVE, noise)
    answers = []
    for scale in (1.0, factor):
        tare = runner.tare(scale * scene.z0, RELATIVE, np.random.default_rng(0))
        answers.append(runner.once(tare, scale * z))
    assert all(a.valid for a in answers)
    place = answers[0].place()
    assert place is not None and distance_mm(answers[1], place) < 0.05
    assert answers[1].force() == pytest.approx(answers[0].force(), rel=0.01)


@pytest.mark.parametrize("name", [*garbage.NOT_NUMBERS, *garbage.ODD_NUMBERS])
def test_what_is_no_measurement_is_left_out(
    runner: InProcessStages, scene: Scene, baseline: Baseline, name: str
) -> None:
    """In 1, 10 or 40 of 120 channels the touch is still where it is; in all of them nothing is valid."""
    value = (garbage.NOT_NUMBERS | garbage.ODD_NUMBERS)[name]
    rng = np.random.default_rng(2)
    for count in (1, 10, 40, 119, 120):
        z = noisy(scene.z, RELATIVE, rng).astype(complex)
        z[rng.permutation(120)[:count]] = value
        answer = runner.once(baseline, z)
        assert not answer.broken
        if count <= 40:
            assert answer.valid
            assert distance_mm(answer, METRES * scene.touch.centroid) < 3
        else:
            assert not answer.valid


@pytest.mark.parametrize("family", garbage.FAMILIES)
def test_frames_that_no_skin_made_are_never_valid(
    runner: InProcessStages, scene: Scene, baseline: Baseline, family: str
) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        answer = runner.once(baseline, *garbage.FAMILIES[family](scene.z0, rng))
        assert not answer.broken and not answer.valid, answer


def test_a_stream_of_garbage_leaves_nothing_behind(runner: InProcessStages, scene: Scene, baseline: Baseline) -> None:
    rng = np.random.default_rng(5)
    runner.begin(baseline)
    for _ in range(6):
        for family in garbage.FAMILIES.values():
            assert not runner.see(*family(scene.z0, rng)).broken
    for _ in range(100):
        answer = runner.see(noisy(scene.z0, RELATIVE, rng))
    assert answer.valid and not answer.contacts
    for _ in range(3):
        answer = runner.see(noisy(scene.z, RELATIVE, rng))
    assert answer.valid and distance_mm(answer, METRES * scene.touch.centroid) < 2


@pytest.mark.parametrize("lost", [1, 59, 61, 119, 120])
def test_a_saved_baseline_of_too_few_measurements_is_refused(
    runner: InProcessStages, scene: Scene, baseline: Baseline, lost: int
) -> None:
    saved = baseline.to_dict()
    saved["z0"] = np.where(np.arange(120) < lost, 0.0, baseline.z0)
    if lost > 60:
        with pytest.raises(NoBaseline, match=f"only {120 - lost} of 120"):
            Baseline.from_dict(saved, 120)
        return
    answer = runner.once(Baseline.from_dict(saved, 120), noisy(scene.z, RELATIVE, np.random.default_rng(8)))
    assert not judged(answer, scene.touch)


@pytest.mark.parametrize("dead", [1, 2, 3, 8, 15])
def test_dead_electrodes_cost_accuracy_or_validity_never_truth(
    setting: Setting, runner: InProcessStages, scene: Scene, baseline: Baseline, dead: int
) -> None:
    pattern, rng = np.asarray(setting.bundle.pattern), np.random.default_rng(dead)
    for _ in range(4):
        lost = np.isin(pattern, rng.permutation(16)[:dead]).any(axis=1)
        z = noisy(scene.z, RELATIVE, rng)
        z[lost] = np.nan
        answer = runner.once(baseline, z)
        assert not judged(answer, scene.touch)
        assert answer.valid == (dead <= 2)


def test_no_jump_within_noise(runner: InProcessStages, scene: Scene, baseline: Baseline) -> None:
    """At the board's noise, and on the whole way from one noisy frame to the next."""
    rng = np.random.default_rng(6)
    a, b = noisy(scene.z, RELATIVE, rng, 2)
    places = [runner.once(baseline, a + t * (b - a)).place() for t in np.linspace(0, 1, 21)]
    assert all(p is not None for p in places)
    steps = 1e3 * np.linalg.norm(np.diff(np.array(places), axis=0), axis=1)
    assert steps.max() < 0.3 and steps.sum() < 2


def test_extended_precision_solves_what_double_cannot() -> None:
    """The Hilbert matrix of order 12, condition 1.7e16: its inverse times known numbers."""
    n = 12
    hilbert = 1 / (np.arange(n)[:, None] + np.arange(n)[None] + np.longdouble(1))
    exact = np.ones(n, np.longdouble)
    longer = np.abs(solved_long(hilbert, hilbert @ exact) - exact).max()
    double = np.abs(np.linalg.solve(hilbert.astype(float), (hilbert @ exact).astype(float)) - 1).max()
    assert longer < 0.02 and longer < double


def test_pytorch_evaluates_a_shipped_file_as_onnx_runtime_does(setting: Setting, scene: Scene) -> None:
    needs.TRAIN.here()
    from bench.stability import precision

    path = setting.bundle.network_path("full")
    assert path is not None
    import torch

    from bench.stability.graph import Graph

    pre = setting.bundle.prereconstructor()
    stack, context, scale = pre.condition(np.full(120, RELATIVE)).stack(pre.difference(scene.z, scene.z0))
    feeds = [({"stack": stack[None], "context": context[None]}, scale, scene.touch)]
    ours = precision._run(path, feeds)
    for dtype in (torch.float32, torch.float64):
        graph = Graph(path, dtype)
        theirs = [[graph.run(feeds[0][0])[name] for name in precision.OUTPUTS]]
        assert not precision._compared(ours, theirs, feeds, precision.PARITY_MM)["broken"]
    theirs[0][0] = np.roll(theirs[0][0], 3, axis=-1)  # three pixels are 3 mm
    assert precision._compared(ours, theirs, feeds, precision.PARITY_MM)["broken"]


# the benchmark's own judgement


def answer_at(x: float, y: float, force: float, valid: bool = True) -> Answer:
    contact = Contact(id=1, position=[x, y, 0.0], force_n=force)
    return Answer(valid=valid, touched=True, contacts=[contact])


def test_a_valid_contact_far_away_breaks_the_promise_and_fails_the_run() -> None:
    touch = TOUCHES[1]
    x, y = METRES * touch.centroid
    right = answer_at(x + 0.001, y, touch.force(METRES) * 1.1)
    wrong = answer_at(x + 0.011, y, 3.0)
    assert not judged(right, touch) and judged(right, None) == ["valid on garbage, with contacts"]
    assert judged(wrong, touch) == ["valid contact far from the touch"]
    assert not judged(replace(wrong, valid=False), touch)
    row = summary([(right, touch), (wrong, touch), (Answer(broken=["crash: boom"]), touch)])
    assert row["position_max_%"] == pytest.approx(11) and row["valid_%"] == pytest.approx(200 / 3)
    assert row["broken"] == {"valid contact far from the touch": 1, "crash: boom": 1}
    assert len(report.broken({"part": [{"case": "case", **row}]})) == 2


def test_errors_are_those_of_valid_frames_with_a_contact() -> None:
    touch = TOUCHES[0]
    seen = answer_at(0.001, 0.0, 1.8)
    row = summary([(seen, touch), (Answer(valid=True), touch), (answer_at(0.03, 0.0, 9.0, valid=False), touch)])
    assert row["position_%"] == pytest.approx(1) and row["force_%"] == pytest.approx(20) and row["missed"] == 1


def test_a_stage_that_lets_infinity_out_is_found(
    runner: InProcessStages, scene: Scene, baseline: Baseline, monkeypatch
) -> None:
    network = runner.pipeline.inference._network
    real = network.run

    def spoiled(frame):
        image, *rest = real(frame)
        image = image.copy()
        image[3, 4] = np.inf
        return image, *rest

    monkeypatch.setattr(network, "run", spoiled)
    answer = runner.once(baseline, scene.z)
    assert "not finite: image.image" in answer.broken and not answer.valid


@pytest.mark.parametrize("part", bytes_of_others.PARTS)
def test_what_was_changed_is_never_believed(setting: Setting, part: str) -> None:
    rows = list(bytes_of_others.PARTS[part](setting))
    assert not report.broken({part: rows})
    assert any(row["refused_%"] == 100 for row in rows) and all(row["frames"] > 10 for row in rows)


def test_a_decoder_that_believes_or_raises_is_seen() -> None:
    """The benchmark can fail."""

    def believes(data: bytes) -> object:
        raise bytes_of_others.Broken("a changed state was believed")

    def raises(data: bytes) -> object:
        raise IndexError("out of range")

    rows = [bytes_of_others.case("one", [b"x"] * 3, believes), bytes_of_others.case("two", [b"x"], raises)]
    assert report.broken({"part": rows}) == [
        "part: one: a changed state was believed (3 of 3)",
        "part: two: crash: IndexError: out of range (1 of 1)",
    ]


def test_time_that_is_believed_wrongly_breaks_the_promise(monkeypatch) -> None:
    """A clock that takes any delay for the crystal's rate; scans that are never known to be frozen."""
    growing = next(case for case in held_up.UNTIMED if case.name == "growing by 20 ms/s")
    frozen = next(case for case in held_up.AGAIN if case.name.startswith("the same scan"))
    for case in (growing, frozen):
        row = held_up.judged(case, seed=1)
        assert row["broken"] == {} and row["frames"] > 150 and row["valid_%"] > 30
    monkeypatch.setattr("services.board.clock.MAX_RATE_ERROR", 1.0)
    monkeypatch.setattr("services.board.frozen.PROOF", 10**9)
    for case in (growing, frozen):
        assert held_up.judged(case, seed=1)["broken"]["a frame to act on is older than it may be"] > 20


def test_keys_open_what_they_are_for_and_nothing_else(setting: Setting) -> None:
    rows = list(keys.attacked(setting))
    assert not report.broken({"keys": rows})
    assert len(rows) == len(keys.ATTACKS) and all(row["refused_%"] == 100 for row in rows)


def test_a_gate_that_lets_everybody_in_breaks_the_promise(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.keys.Admission.allows", lambda admission, key: True)
    monkeypatch.setattr("protocol.keys.Admission.operates", lambda admission, key: True)
    monkeypatch.setattr("protocol.transport.check", lambda transport: None)
    wanted = ("a reader with a key that is not listed", "a client that gives commands", "keys configured by half")
    monkeypatch.setattr(keys, "ATTACKS", {n: a for n, a in keys.ATTACKS.items() if n.startswith(wanted)})
    found = " ".join(report.broken({"keys": list(keys.attacked(setting))}))
    assert "read by a stranger" in found and "a client changed something" in found
    assert "half a configuration was used" in found
