"""What a training says of itself: its pace and what limits it, its bar, and the verdict at its end."""

import io

import pytest
from rich.console import Console

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import build, geometry, samples, verdict  # noqa: E402
from models.bundle import Bundle  # noqa: E402
from models.network import NetworkConfig  # noqa: E402
from models.pace import Pace, TrainingBar  # noqa: E402
from models.train import Trainer  # noqa: E402


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def run(threads=2, device="cpu", making=1.0, network=9.0, processor=20.0):
    """A pace after `making` + `network` seconds, of which the process had `processor` seconds of processor time."""
    clock, used = Clock(), Clock()
    pace = Pace(threads, device, clock, used)
    for part, seconds in (("batches", making), ("network", network)):
        with pace.of(part):
            clock.now += seconds
    used.now = processor
    return pace


@pytest.mark.parametrize(
    ("pace", "says"),
    [
        (run(), "0.5 batches of 64 scenes a second (of the time: network 90 %, batches 10 %)"),
        (run(), "what limits it: the network's arithmetic on 2 cores"),
        (run(processor=4.0), "other programs on this machine; training had 20 % of 2 cores"),
        (run(threads=1, processor=10.0, making=6.0, network=4.0), "making batches on 1 core;"),
        (run(device="cuda", processor=3.0), "what limits it: the GPU"),
        (run(device="cuda", making=6.0, network=4.0), "the processor, which makes the batches, not the GPU"),
    ],
)
def test_what_limits_a_training(pace, says):
    assert says in pace.said(batches=5, size=64)


ROW = {
    "minutes": 2.0,
    "steps": 40,
    "contact IoU, noise-free": 0.5,
    "contact IoU, 70 dB": 0.4,
    "position % of side, noise-free": 1.0,
    "position % of side, 70 dB": 2.0,
}


def test_the_bar_shows_the_remaining_time_on_a_terminal_and_lines_elsewhere():
    text = {}
    for terminal in (True, False):
        out = io.StringIO()
        console = Console(file=out, force_terminal=terminal, width=120, _environ={})
        with TrainingBar("full", 600.0, console=console) as bar:
            for k in range(1, 4):
                bar.at(60.0 * k, 20 * k)
            bar.checked(ROW)
        text[terminal] = out.getvalue()
    assert "30%" in text[True] and "0.33 batches/s" in text[True]
    assert "30%" not in text[False]
    for said in text.values():
        assert "minute 2.0, 8.0 left, 40 batches; held out, noise-free: contact IoU 0.500, position 1.00 % of" in said


def held_out(iou, position, kind=0.7):
    return {
        level: {"contact IoU": iou, "position % of side": position, "class": kind} for level in ("noise-free", "70 dB")
    }


def test_a_plan_takes_the_minutes_that_it_is_given():
    """Scenes at 40 a second, both networks, and two minutes of packaging."""
    for minutes in (3.0, 4.0, 10.0, 60.0, 130.0):
        plan = build.Plan.of(minutes)
        assert plan.scenes / 40 / 60 + plan.full + plan.fast + 2.0 <= minutes
        assert plan.full > 0.15 * minutes
    assert build.QUICK == build.Plan.of(14.5) and build.QUICK.full == pytest.approx(7.25)


@pytest.mark.parametrize(
    ("iou", "position", "grade", "says"),
    [
        (0.83, 0.5, "good", "10 times its 1000 batches would bring 0.04 of contact IoU at most"),
        (0.70, 0.5, "usable", "10 times as many (50 minutes at this pace) would bring a contact IoU of about 0.78"),
        (0.83, 1.0, "usable", "2.5 times what the noise allows (0.40 %)"),
        (0.59, 0.5, "too little", "the one-step image, without any network: 0.57"),
        (0.83, 1.5, "too little", "MINUTES=90"),
    ],
)
def test_the_verdict(iou, position, grade, says):
    found = verdict.judge(held_out(iou, position), batches=1000, minutes=5.0, single_step=0.57, floor=0.4)
    assert found.grade == grade and found.text.startswith(grade) and says in found.text
    assert found.to_dict()["grade"] == grade


@pytest.mark.parametrize(
    ("iou", "position", "grade"),
    [
        (0.60, 1.0, "usable"),
        (0.60, 1.2, "usable"),
        (0.51, 1.0, "too little"),  # its touches are hardly better outlined
        (0.60, 2.5, "too little"),  # and farther from where they are
    ],
)
def test_the_network_of_a_registered_skin_must_be_better_than_no_network(iou, position, grade):
    without = {"contact IoU": 0.48, "position % of side": 1.19}
    found = verdict.judge_registered(held_out(iou, position), batches=1000, minutes=9.0, single_step=without)
    assert found.grade == grade and found.text.startswith(grade)
    assert "the one-step image: 0.48" in found.text and "(1.19 %)" in found.text


@pytest.fixture(scope="module")
def scenes(drawn):
    return drawn(48, seed=0, n=1)


def test_what_there_is_without_a_network(scenes):
    """README's table has 0.594 of NOSER's contact IoU, on frames of another mesh."""
    found = verdict.one_step(scenes, Bundle.load("square16").prereconstructor())
    assert 0.45 < found["contact IoU"] < 0.8 and 0.2 < found["position % of side"] < 2.0


def test_the_floor_of_position_falls_with_the_noise(scenes):
    at_70, at_90 = (verdict.position_floor("square16", scenes, decibel) for decibel in (70.0, 90.0))
    assert 0.1 < at_70 < 1.0 and at_90 < 0.3 * at_70


def test_a_training_shows_how_it_gets_on(scenes, tmp_path, capsys):
    torch.set_num_threads(1)
    pre = Bundle.load("square16").prereconstructor()
    batches = samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)
    trainer = Trainer(NetworkConfig(channels=(8, 8, 8), blocks=(1, 1, 1)), batches, scenes)
    trainer.run(0.02, tmp_path / "tiny.pt", name="tiny")
    assert "tiny: minute 0.0" in capsys.readouterr().out
    assert set(trainer.pace.parts) == {"batches", "network", "held-out"} and len(trainer.curve) == 1
    assert "what limits it: " in trainer.pace.said(trainer.steps, 16)


def test_the_plan_says_until_when():
    assert "3750 scenes, 7 minutes for the network, 2 for the fast one" in build.QUICK.said("mine")
    assert "13 minutes on two idle cores, until " in build.QUICK.said("mine")
