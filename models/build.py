"""One command from a skin's geometry to a shipped bundle.

    python -m models.build --skin square16                 the long training, about four hours
    python -m models.build --skin square16 --quick         at most a quarter of an hour from nothing on two idle cores
    python -m models.build --skin square16 --minutes 5 --anyway    for CI: proves the path, not the accuracy
    python -m models.build --skin square16 --no-network    matrices only: the services show the one-step image
    python -m models.build --skin square16 --package       trains nothing: ships the checkpoints in models/work/SKIN
    python -m models.build --skin square16 --package --only fast   that checkpoint alone, into the bundle there is
    python -m models.build --skin square16 --response      adds response.npz to the bundle there is
    python -m models.build --skin FOLDER --quick           of what `skin register` wrote: a network of that very skin,
                                                           kept where its images are better than those without

Samples and checkpoints stay in models/work/SKIN; a second call uses what is there and makes what is missing. A training
that was interrupted goes on from its checkpoint, one that is finished is not done again; a call with another budget or
seed, or of a skin that has changed, trains anew. The fast network starts as a part of the full one and learns from it.
"""

from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from models import (
    bundle,
    checkpoint,
    class_temperature,
    command,
    data,
    export,
    geometry,
    manifest,
    samples,
    solved_presses,
    train,
    verdict,
    warped,
)
from models.augmentation import OwnSkin, random_condition
from models.distillation import Teacher
from models.evaluation import LEVELS, evaluate, predict
from models.forward import ForwardModel
from models.linearise import linearise
from models.network import MMCNN, NetworkConfig, multiply_accumulates
from models.prereconstruction import Array, Matrices, PreReconstructor
from models.pruning import is_part
from models.response_file import ResponseTables
from models.response_tables import response_tables
from protocol.errors import EitskinError

VALID = 1000
PACKAGING = 2.0  # minutes for export and measuring


@dataclass(frozen=True)
class Plan:
    """What a build costs: scenes, and minutes of training of each network."""

    scenes: int
    full: float
    fast: float

    @staticmethod
    def of(minutes: float) -> Plan:
        """Shares of a budget on two idle cores, packaging included: of the rest an eighth for scenes (40 a second), and
        most to train.
        """
        rest = max(minutes - PACKAGING, minutes / 4)
        return Plan(scenes=int(max(500, min(20000, rest / 8 * 60 * 40))), full=0.58 * rest, fast=0.14 * rest)

    def announcement(self, skin: str) -> str:
        """What is to come, and until when on two idle cores."""
        whole = self.scenes / 40 / 60 + self.full + self.fast + PACKAGING
        end = datetime.now() + timedelta(minutes=whole)
        return (
            f"{skin}: {self.scenes} scenes, {self.full:.0f} minutes for the network, {self.fast:.0f} for the fast one, "
            f"then export and measuring: {whole:.0f} minutes on two idle cores, until {end:%H:%M}"
        )


FULL, QUICK = Plan(57000, 214.0, 13.0), Plan.of(14.5)


class TooLittle(EitskinError):
    """A training was not enough for a bundle; the text says what to do."""


class BuildTarget:
    """What a bundle is built of, and where. model: of a skin that `skin register` wrote; work: scenes, checkpoints."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.skin, self.registered = geometry.load(args.skin), warped.registered(args.skin)
        self.model = None if self.registered is None else warped.warped(self.registered)
        self.own = None if self.model is None else self.model.own
        self.name = self.skin.name if self.registered is None else self.registered.path.resolve().name
        self.out: Path = args.out or (bundle.BUNDLES / self.name if self.registered is None else self.registered.path)
        self.work: Path = args.work or data.WORK / self.name

    def scenes(self, split: str, pre: PreReconstructor) -> samples.Samples:
        """A split of `work`; of a registered skin, as that skin would have measured it."""
        scenes = samples.load(self.work, split, pre)
        return scenes if self.model is None else self.model.samples(scenes)


def physics(target: BuildTarget) -> tuple[Matrices, samples.Samples]:
    """Matrices of a skin, and the held-out scenes in their normalisation."""
    # With z0 of the model as the divisor, contact impedances off by 30 % change d by 0.2 % instead of 0.5 %; but it
    # takes a converter that reads ohm. Skins recorded in counts of unknown gain a channel divide by their own baseline.
    normalisation = "model" if target.skin.pattern_name == "pairs" else "measured"
    matrices = linearise(ForwardModel(target.skin), normalisation) if target.model is None else target.model.matrices
    held_out = target.scenes("valid", PreReconstructor(matrices))
    return replace(matrices, level=samples.levels(held_out, PreReconstructor(matrices))), held_out


def networks(
    folder: Path,
    pre: PreReconstructor,
    held_out: samples.Samples,
    presses: solved_presses.SolvedPresses | None,
    own: OwnSkin | None = None,
    only: str | None = None,
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Exports the checkpoints in a folder, or `only` one variant's: ONNX of each, and what the manifest says about
    them. presses: what the temperature of the class probabilities is fitted to; a registered skin has none of known
    shapes. Raises CheckpointError.
    """
    made: dict[str, bytes] = {}
    entries: dict[str, Any] = {}
    stack, context = calibration(pre, held_out, own=own)
    for variant in checkpoints(folder, only):
        model, state = restore(folder / f"{variant}.pt")
        shape_class = None
        if presses is not None:
            shape_class = class_temperature.seen_classes(presses, pre, predict(model)).said()
            class_temperature.cooled(model, shape_class["temperature"])
        made[variant] = export.to_onnx(model, stack[:32], context[:32])
        entries[variant] = {
            "parameters": sum(p.numel() for p in model.parameters()),
            "multiply_accumulates": multiply_accumulates(model.config),
            "config": model.config.to_dict(),
            "shape_class": shape_class,
            "training": {
                **state.get("said", {}),
                "minutes": round(state["numbers"]["elapsed"] / 60, 1),
                "batches": state["numbers"]["steps"],
            },
        }
    if "full" in made:
        made["int8"] = export.to_int8(made["full"], stack, context)
        entries["int8"] = {"from": "full", "calibration_frames": len(stack)}
    for variant, content in made.items():
        session = export.session(content)
        entries[variant]["run_time_ms"] = export.run_time_ms(content, stack, context)
        entries[variant]["held_out"] = {
            level: _rounded(evaluate(predict(session), held_out, pre, decibel, limit=400, own=own))
            for level, decibel in LEVELS.items()
        }
        milliseconds = entries[variant]["run_time_ms"]["median"]
        text = "; ".join(
            f"{level}: contact IoU {row['contact IoU']:.3f}, position {row['position % of side']:.2f} % of the side"
            for level, row in entries[variant]["held_out"].items()
        )
        print(f"{variant}: {len(content) / 1024:.0f} kB, {milliseconds:.2f} ms a frame; held out, {text}", flush=True)
    return made, entries


def _rounded(figures: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in figures.items()}


def checkpoints(folder: Path, only: str | None = None) -> list[str]:
    """Variants that a folder has a checkpoint of, or `only` one. Raises CheckpointError where there is none."""
    wanted = list(train.CONFIGS) if only is None else [only]
    if found := [v for v in wanted if (folder / f"{v}.pt").is_file()]:
        return found
    names = " or ".join(f"{v}.pt" for v in wanted)
    raise checkpoint.CheckpointError(
        f"found no checkpoint in {folder}, expected {names}: name the folder that has it with --work, or train it first"
    )


def replace_one(variant: str, target: BuildTarget) -> bundle.Bundle:
    """The bundle there is with the checkpoint of one variant; the other files stay as they are. Run times of all of its
    networks are measured anew, since those of two days cannot be compared.
    """
    shipped, work = bundle.Bundle.load(target.out), target.work
    pre, cache = shipped.prereconstructor(), work / "presses.npz"
    held_out = samples.load(work, "valid", pre)
    made, entries = networks(work, pre, held_out, solved_presses.solve(target.skin, cache=cache), only=variant)
    entries[variant]["built"] = manifest.built()
    if (curve := work / f"{variant}.png").is_file():
        shutil.copy(curve, shipped.path / f"training_{variant}.png")
    entries = {**shipped.manifest["network"], variant: entries[variant]}
    replaced = bundle.replace_network(shipped, variant, made[variant], entries)
    stack, context = calibration(pre, held_out)
    for name, entry in entries.items():
        if (path := replaced.network_path(name)) is not None:
            entry["run_time_ms"] = export.run_time_ms(path.read_bytes(), stack, context)
    return bundle.replace_manifest(replaced.path, {**replaced.manifest, "network": entries})


def restore(path: Path) -> tuple[MMCNN, dict[str, Any]]:
    """The network a checkpoint ships (averaged weights, best on held-out scenes), and all of its state. Raises
    CheckpointError.
    """
    state = checkpoint.read(path)
    model = MMCNN(NetworkConfig.from_dict(state["config"]))
    model.load_state_dict(state["best"] or state["average"])
    return model.eval(), state


def calibration(
    pre: PreReconstructor, held_out: samples.Samples, frames: int = 256, own: OwnSkin | None = None
) -> tuple[Array, Array]:
    """Stacks and contexts as they will be met: every kind of noise, drift and dead electrode of training."""
    rng = np.random.default_rng(7)
    parts = []
    for _ in range(frames // 16):
        index = rng.integers(len(held_out), size=16)
        parts.append(samples.make(held_out, index, None, random_condition(pre, rng, own), rng))
    batch = samples.join(parts)
    return batch.stack.numpy(), batch.context.numpy()


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m models.build", description="Build a skin's bundle.")
    parser.add_argument(
        "--skin", default="square16", help="a shipped skin, a .toml file, or what `skin register` wrote"
    )
    parser.add_argument("--out", type=Path, help="bundle folder (default: models/bundles/SKIN, or what was registered)")
    parser.add_argument("--work", type=Path, help="samples and checkpoints (default models/work/SKIN)")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--quick", action="store_true", help="a quarter of an hour in all")
    budget.add_argument("--minutes", type=command.minutes, help="any other budget, for all of it on two idle cores")
    budget.add_argument("--no-network", action="store_true", help="matrices only")
    budget.add_argument("--package", action="store_true", help="export the checkpoints there are, train nothing")
    budget.add_argument("--response", action="store_true", help="response.npz alone, into the bundle there is")
    parser.add_argument(
        "--only", choices=sorted(train.CONFIGS), help="with --package: one network of the bundle there is"
    )
    parser.add_argument("--anyway", action="store_true", help="write the bundle even where the verdict is: too little")
    parser.add_argument("--matrices", type=Path, help="with --package: the bundle the checkpoints were trained with")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = _arguments(argv)
    began = time.perf_counter()
    target = BuildTarget(args)
    if args.response:
        added = bundle.add_response(bundle.Bundle.load(target.out), response_tables(ForwardModel(target.skin)))
        print(f"{added.path}: response.npz added, {added.hash[:12]}, after {time.perf_counter() - began:.0f} s")
        return
    if args.package:
        checkpoints(target.work, args.only)  # before what takes minutes
    if args.package and args.only:
        replaced = replace_one(args.only, target)
        print(f"{replaced.path}: another {args.only} network, {replaced.hash[:12]}")
        return
    build(target, args, began)


def build(target: BuildTarget, args: argparse.Namespace, began: float) -> None:
    """The whole bundle. Raises TooLittle."""
    plan = QUICK if args.quick else Plan.of(args.minutes) if args.minutes else FULL
    matrices, held_out = _prepared(target, args, plan)
    pre, made, entries = PreReconstructor(matrices), dict[str, bytes](), dict[str, Any]()
    print(f"physics ready after {time.perf_counter() - began:.0f} s", flush=True)
    tables = None
    if target.registered is None and matrices.normalisation == "model":
        tables = response_tables(ForwardModel(target.skin))
    if not args.no_network:
        bundle.check_room(target.out, matrices, tables)
        if not args.package:
            _train(target, args, plan, pre, held_out)
        count = solved_presses.PRESSES if plan.scenes >= 4 * VALID else solved_presses.PRESSES // 4
        cache = target.work / "presses.npz"
        presses = solved_presses.solve(target.skin, count, cache=cache) if target.own is None else None
        made, entries = networks(target.work, pre, held_out, presses, target.own)
    if "full" in entries and not _is_enough(target, args, pre, held_out, entries["full"]):
        return
    written = _write(target, matrices, made, entries, tables)
    size = sum(f.stat().st_size for f in written.path.iterdir()) / 2**20
    print(f"{written.path}: {size:.2f} MB, {written.hash[:12]}, after {(time.perf_counter() - began) / 60:.1f} minutes")
    if "full" in entries:
        print(f"verdict: {entries['full']['verdict']['text']}")


def _prepared(target: BuildTarget, args: argparse.Namespace, plan: Plan) -> tuple[Matrices, samples.Samples]:
    """The matrices, and the held-out scenes in their normalisation; makes the scenes that are missing."""
    if args.package:
        # A checkpoint fits the matrices that it was trained with.
        matrices = bundle.Bundle.load(args.matrices or target.out).matrices
        return matrices, target.scenes("valid", PreReconstructor(matrices))
    if not args.no_network:
        print(plan.announcement(target.name), flush=True)
        valid = VALID if plan.scenes >= 4 * VALID else max(100, plan.scenes // 5)
        make_scenes(args.skin, target.work, plan.scenes, valid, args)
    elif not data.chunk_files(target.work, "valid"):
        make_scenes(args.skin, target.work, 0, 250, args)
    return physics(target)


def _train(
    target: BuildTarget, args: argparse.Namespace, plan: Plan, pre: PreReconstructor, held_out: samples.Samples
) -> None:
    """Leaves a checkpoint of each network in `work`."""
    scenes = target.scenes("train", pre)
    start = None if target.registered is None else warped.start(target.registered)
    minutes = {"full": plan.full, "fast": plan.fast}
    if start is not None:  # a registered skin: what its presses leave open no second network can know
        minutes = {"full": plan.full + plan.fast}
    teacher: Teacher | None = None
    for variant, budget in minutes.items():
        # What can be a part of the full network learns from it, which was trained before.
        learns = teacher is not None and is_part(train.CONFIGS[variant], teacher.model.config)
        trainer = train.train(
            variant,
            target.skin,
            pre,
            scenes,
            held_out,
            budget,
            target.work / f"{variant}.pt",
            args.seed,
            args.jobs,
            start=start,
            own=target.own,
            teacher=teacher if learns else None,
            go_on=True,
        )
        teacher = teacher or trainer.as_teacher(variant)


def _is_enough(
    target: BuildTarget,
    args: argparse.Namespace,
    pre: PreReconstructor,
    held_out: samples.Samples,
    entries: dict[str, Any],
) -> bool:
    """Whether the bundle is to be written; the verdict goes into `entries`. Raises TooLittle."""
    spent, without = entries["training"], verdict.one_step(held_out, pre, target.own)
    if target.own is not None:
        judged = verdict.judge_registered(entries["held_out"], spent["batches"], spent["minutes"], without)
    else:
        floor = verdict.position_floor(args.skin, held_out)
        judged = verdict.judge(entries["held_out"], spent["batches"], spent["minutes"], without["contact IoU"], floor)
    entries["verdict"] = judged.to_dict()
    if judged.grade != "too little" or args.anyway:
        return True
    if target.registered is None:
        raise TooLittle(
            f"verdict: {judged.text} {target.out} is not written, the checkpoint is in {target.work}: train longer, or "
            "have it written with --anyway (make train ANYWAY=1)"
        )
    print(f"verdict: {judged.text}\n{target.registered.path} is left as it was, the checkpoint is in {target.work}")
    return False


def _write(
    target: BuildTarget,
    matrices: Matrices,
    made: dict[str, bytes],
    entries: dict[str, Any],
    tables: ResponseTables | None,
) -> bundle.Bundle:
    if target.registered is None or target.model is None:
        about = manifest.describe(target.skin.name, target.skin, matrices, network=entries or None)
        written = bundle.write(target.out, about, matrices, made, response=tables)
    else:
        about = manifest.of_registered(target.registered, network=entries or None, warped=target.model.provenance)
        written = bundle.write(target.out, about, matrices, made, target.registered.locator)
    for curve in target.work.glob("*.png") if made else ():
        shutil.copy(curve, target.out / f"training_{curve.name}")
    return written


def make_scenes(skin: str, work: Path, scenes: int, valid: int, args: argparse.Namespace) -> None:
    """Scenes that `work` lacks, in chunks of the size that it has already, or that suits their number."""
    chunk = data.chunk_size(work) or (1000 if scenes >= 4000 else 500 if scenes >= 2000 else 125)
    wanted = data.specs(skin, "valid", valid, args.seed, chunk) + data.specs(skin, "train", scenes, args.seed, chunk)
    if not data.generate(work, wanted, args.jobs):
        print(f"using the scenes in {work}: remove it to make others")


if __name__ == "__main__":
    command.run("models.build", main)
