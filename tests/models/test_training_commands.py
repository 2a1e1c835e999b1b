"""What the programs that train say where they cannot go on, and where a second call goes on from the first."""

import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import needs

needs.TRAIN.here()

import torch  # noqa: E402

from models import average, build, checkpoint, command, data, geometry, published, samples, train, verdict  # noqa: E402
from models.bundle import Bundle, BundleError  # noqa: E402
from models.checkpoint import CheckpointError, TrainingPlan  # noqa: E402
from models.network import NetworkConfig  # noqa: E402
from models.train import Trainer, full_network  # noqa: E402
from models.warm_start import NoSuchNetwork  # noqa: E402
from protocol.errors import EitskinError  # noqa: E402

pytestmark = pytest.mark.release  # trains, each time from nothing

ROOT = Path(__file__).resolve().parents[2]
SMALL = {
    "full": NetworkConfig(channels=(8, 12, 10), blocks=(1, 2, 1)),
    "fast": NetworkConfig(channels=(8, 8, 8), blocks=(1, 1, 1), lean=True),
}
BLINK = "0.002"  # minutes


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(train, "CONFIGS", SMALL)
    monkeypatch.setattr(train, "CPU_BATCH", (16, 2))


@pytest.fixture
def work(tmp_path, scenes):
    """A folder of chunks, of touches by the linearised model."""
    skin = geometry.load("square16")
    for split, rows in (("train", slice(0, 64)), ("valid", slice(64, 80))):
        arrays = {
            "difference": scenes.d[rows],
            "shapes": scenes.shapes[rows],
            "image": np.zeros((len(scenes.d[rows]), 4, 4), np.float16),
            "blur": np.zeros(len(scenes.d[rows]), np.float32),
            "z0": Bundle.load("square16").z0,
        }
        np.savez_compressed(tmp_path / f"{split}-00000.npz", **arrays)
    said = {"schema": data.SCHEMA, "skin": "square16", "mesh": "training", "seed": 1, "chunk": 64}
    (tmp_path / "data.json").write_text(json.dumps(said | {"geometry": data._digest(skin)}))
    return tmp_path


@pytest.fixture
def batches(pre, scenes):
    return samples.Batches(scenes, pre, geometry.load("square16"), seed=0, size=16, groups=2, bank=4)


def trained(work, *arguments):
    train.main(["--data", str(work), "--out", str(work / "out.pt"), "--minutes", BLINK, *map(str, arguments)])


def state(path):
    return torch.load(path, weights_only=True)


# -- one line -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("module", "arguments", "said"),
    [
        ("models.train", ["--skin", "nowhere"], "no skin 'nowhere': expected one of"),
        ("models.train", ["--data", "/nowhere"], "found no train-*.npz in /nowhere, expected scenes"),
        ("models.train", ["--minutes", "-1"], "--minutes: found -1, expected a number above 0"),
        ("models.build", ["--minutes", "-3"], "--minutes: found -3, expected a number above 0"),
        ("models.build", ["--minutes", "0"], "--minutes: found 0, expected a number above 0"),
        ("models.build", ["--package", "--only", "fast", "--work", "/nowhere"], "found no checkpoint in /nowhere"),
        ("models.published", ["--minutes", "nan"], "--minutes: found nan, expected a number above 0"),
        ("models.average", ["/nowhere.pt", "--out", "/nowhere/full.pt"], "found no file /nowhere.pt"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_an_error_is_one_line(monkeypatch, module, arguments, said):
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    with pytest.raises(SystemExit) as end:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    assert isinstance(end.value.code, str)  # to stderr, with exit status 1
    assert end.value.code.startswith(f"{module}: {said}") and "\n" not in end.value.code


def test_the_line_is_on_stderr_and_the_status_is_1():
    command_line = [sys.executable, "-m", "models.average", "/nowhere.pt", "--out", "/nowhere/full.pt"]
    ran = subprocess.run(command_line, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 1 and not ran.stdout and len(ran.stderr.splitlines()) == 1


def test_minutes_are_a_number():
    assert command.minutes("1.5") == 1.5
    for text in ("-1", "0", "nan", "inf", "-inf"):
        with pytest.raises(command.ArgumentError, match="expected a number above 0"):
            command.minutes(text)


@pytest.mark.parametrize(
    ("given", "passed"),
    [("QUICK=1", "--quick"), ("QUICK=0", ""), ("MINUTES=0", "--minutes 0"), ("ANYWAY=1", "--anyway")],
)
def test_make_passes_on_what_it_is_given(given, passed):
    printed = subprocess.run(["make", "-n", "train", given], cwd=ROOT, capture_output=True, text=True).stdout
    ran = next(line for line in printed.splitlines() if "models.build" in line)
    assert ran.partition("--skin square16")[2].split() == passed.split()


# -- arguments that do not fit --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        (["--bundle", "nowhere"], BundleError, "no bundle 'nowhere'"),
        (["--bundle", "disc16"], command.OtherSkin, "expected a bundle of the skin 'square16' as it is"),
        (["--teacher", "disc16"], command.OtherSkin, "expected a bundle of the skin 'square16' as it is"),
        (["--from", "disc16"], NoSuchNetwork, "has no network 'full' to start from: name another bundle"),
        (["--skin", "disc16"], data.OtherScenes, "holds scenes of a skin 'square16' that is not 'disc16'"),
        (["--resume"], CheckpointError, "found no file .*out.pt, expected a checkpoint"),
        (["--from", "square16", "--teacher", "square16"], command.ArgumentError, "found --from and --teacher"),
        (["--from", "square16", "--resume"], command.ArgumentError, "found --from and --resume"),
    ],
)
def test_what_does_not_fit_is_said(work, arguments, error, said):
    with pytest.raises(error, match=said):
        trained(work, *arguments)
    assert issubclass(error, EitskinError) and not (work / "out.pt").exists()


def test_a_bundle_of_the_same_pattern_on_another_outline_is_another_skin(bundle):
    skin = geometry.load("square16")
    assert command.bundle_of(skin, "square16").hash == bundle.hash
    with pytest.raises(command.OtherSkin):
        command.bundle_of(skin.moved(0.05), "square16")


def test_chunks_that_cannot_be_used_are_named(work, pre):
    chunk = work / "valid-00000.npz"
    with np.load(chunk) as file:
        arrays = dict(file)
    np.savez_compressed(chunk, **{k: v for k, v in arrays.items() if k != "blur"})
    with pytest.raises(data.OtherScenes, match="found no array 'blur'"):
        samples.load(work, "valid", pre)
    np.savez_compressed(chunk, **{**arrays, "difference": np.zeros((16, 192), np.float32)})
    with pytest.raises(data.OtherScenes, match="192 measurements, expected 120"):
        samples.load(work, "valid", pre)
    chunk.write_bytes(b"rubbish")
    with pytest.raises(EitskinError, match="valid-00000.npz"):
        samples.load(work, "valid", pre)


def test_the_published_network_is_not_trained_on_another_skins_scenes(work, monkeypatch):
    shutil.copytree(work, work / "disc16")
    monkeypatch.setattr(data, "WORK", work)
    with pytest.raises(data.OtherScenes, match="is not 'disc16'"):
        published.main(["--skin", "disc16"])


def test_only_checkpoints_of_one_network_are_averaged(work, batches, scenes):
    for variant, config in SMALL.items():
        Trainer(config, batches, scenes).save(work / f"{variant}.pt")
    paths = [str(work / f"{variant}.pt") for variant in SMALL]
    with pytest.raises(CheckpointError, match="networks of other sizes"):
        average.main([*paths, "--data", str(work), "--out", str(work / "mean.pt")])


# -- going on from a checkpoint -------------------------------------------------------------------------------------
def test_a_checkpoint_of_another_training_is_refused(small, work, batches, scenes, bundle):
    trained(work)
    with pytest.raises(CheckpointError, match=r"a network of 8/12/10 channels.* expected one of 8/8/8 .*--variant"):
        trained(work, "--resume", "--variant", "fast")
    with pytest.raises(CheckpointError, match=r"had no teacher, expected .*bundle square16 .*leave --teacher out"):
        Trainer(SMALL["full"], batches, scenes).resume(work / "out.pt", full_network(bundle, batches))
    torch.save({**state(work / "out.pt"), "matrices": "0" * 64}, work / "out.pt")
    with pytest.raises(CheckpointError, match="trained with the matrices 000000000000, expected"):
        trained(work, "--resume")
    for content in (b"rubbish", b""):
        (work / "out.pt").write_bytes(content)
        with pytest.raises(CheckpointError, match="out.pt: found a file that cannot be read"):
            trained(work, "--resume")


def test_a_training_with_a_teacher_goes_on_with_that_teacher(monkeypatch, work, batches, scenes, bundle):
    """Without it, the manifest would name a teacher that half of the training did not have."""
    monkeypatch.setattr(train, "CONFIGS", SMALL)
    trainer, teacher = Trainer(SMALL["fast"], batches, scenes), full_network(bundle, batches)
    trainer.learn_from(teacher)
    trainer.start = {"part_of": teacher.said}
    trainer.save(work / "out.pt")
    assert state(work / "out.pt")["said"]["part_of"]["bundle"] == bundle.hash
    with pytest.raises(CheckpointError, match=rf"learnt from the bundle square16 {bundle.hash[:12]} .*with --teacher"):
        trained(work, "--resume", "--variant", "fast")
    again = Trainer(SMALL["fast"], batches, scenes)
    other = type(teacher)(teacher.model, {**teacher.said, "network": "1" * 64})
    with pytest.raises(CheckpointError, match=r"expected one that learnt from .*network 111111111111"):
        again.resume(work / "out.pt", other)
    again.resume(work / "out.pt", teacher)
    assert "taught mask" in again.step(0.5)


def test_only_the_very_same_training_is_gone_on_from(work, batches, scenes, bundle, capsys):
    path, plan = work / "a.pt", TrainingPlan(3.0, 0)
    trainer = Trainer(SMALL["full"], batches, scenes)
    trainer.step(0.1)
    trainer.minutes = 3.0
    trainer.save(path)

    def goes_on(plan, config=SMALL["full"]):
        return Trainer(config, batches, scenes).resume_same(path, plan)

    assert goes_on(plan) and "after 0.0 of 3.0 minutes and 1 batches; going on" in capsys.readouterr().out
    for other, said in (
        (TrainingPlan(4.0, 0), "minutes 3, expected 4; trained anew"),
        (TrainingPlan(3.0, 1), "seed 0, expected 1; trained anew"),
        (TrainingPlan(3.0, 0, {"network": "1" * 64}), "started from none, expected 111111111111; trained anew"),
    ):
        assert not goes_on(other) and said in capsys.readouterr().out
    assert not goes_on(plan, SMALL["fast"]) and "8/12/10" in capsys.readouterr().out
    torch.save({k: v for k, v in state(path).items() if k != "matrices"}, path)
    assert not goes_on(plan) and "does not say which skin" in capsys.readouterr().out
    path.write_bytes(b"rubbish")
    assert not goes_on(plan) and "cannot be read" in capsys.readouterr().out


def test_a_bundle_of_too_little_training_is_not_written_unless_asked_for(small, work, bundle, pre, monkeypatch):
    entry, judged = bundle.manifest["network"]["full"], verdict.TrainingVerdict("too little", "far from it.", {})
    monkeypatch.setattr(build, "make_scenes", lambda *_: None)
    monkeypatch.setattr(build, "physics", lambda skin, folder, _: (bundle.matrices, samples.load(folder, "valid", pre)))
    monkeypatch.setattr(build.solved_presses, "solve", lambda *_, **__: None)
    monkeypatch.setattr(build, "response_tables", lambda _: None)
    networks = {"full": bundle.network_path("full").read_bytes()}, {"full": dict(entry)}
    monkeypatch.setattr(build, "networks", lambda *_: networks)
    monkeypatch.setattr(build, "_verdict", lambda *_: judged)
    out, asked = work / "bundle", ["--work", str(work), "--minutes", "0.02", "--out", str(work / "bundle")]
    with pytest.raises(
        build.TooLittle, match=r"far from it\. .*bundle is not written, .*: train longer, or .*--anyway"
    ):
        build.main(asked)
    assert not out.exists()
    build.main([*asked, "--anyway"])
    assert Bundle.load(out).manifest["network"]["full"]["verdict"]["grade"] == "too little"


class Packaging(Exception):
    """Training is over."""


def test_a_second_build_goes_on_and_the_fast_network_learns_from_the_full_one(
    small, work, bundle, pre, monkeypatch, capsys
):
    def packaging(*_, **__):
        raise Packaging

    def built(*arguments):
        with pytest.raises(Packaging):
            build.main(["--work", str(work), "--minutes", "0.02", *arguments])
        return [state(work / f"{variant}.pt") for variant in SMALL]

    monkeypatch.setattr(build, "make_scenes", lambda *_: None)
    monkeypatch.setattr(build, "physics", lambda skin, folder, _: (bundle.matrices, samples.load(folder, "valid", pre)))
    monkeypatch.setattr(build.solved_presses, "solve", packaging)
    full, fast = built()
    model = build.restore(work / "full.pt")[0]
    assert fast["numbers"]["start"] == {"part_of": {"variant": "full", "network": checkpoint.weights_hash(model)}}
    assert "taught mask" in fast["numbers"]["curve"][-1] and "taught mask" not in full["numbers"]["curve"][-1]
    capsys.readouterr()

    again = built()  # both are finished
    assert [s["numbers"]["steps"] for s in again] == [s["numbers"]["steps"] for s in (full, fast)]
    assert capsys.readouterr().out.count("using it, remove it to train anew") == 2

    cut = {**full, "numbers": {**full["numbers"], "elapsed": 0.0, "finished": False}}
    torch.save(cut, work / "full.pt")
    further, other = built()
    assert further["numbers"]["steps"] > full["numbers"]["steps"]
    said = capsys.readouterr().out
    assert "full.pt: found a checkpoint after 0.0 of 0.0 minutes" in said and "going on from there" in said
    assert other["numbers"]["start"]["part_of"]["network"] == checkpoint.weights_hash(
        build.restore(work / "full.pt")[0]
    )

    built("--seed", "2")
    assert "with the seed 1, expected 2; trained anew" in capsys.readouterr().out
