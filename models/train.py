"""Training of the shipped network: budgeted by minutes, resumable, on a GPU where there is one.

    python -m models.train --skin square16 --minutes 80            writes models/work/square16/full.pt and full.png
    python -m models.train --skin square16 --minutes 80 --resume   goes on from the checkpoint
    python -m models.train --skin square16 --minutes 80 --from square16   starts from a bundle's network, at low rates
    python -m models.train --skin square16 --minutes 60 --variant fast --teacher square16   a part of a bundle's full
                                                                    network, which it learns from (distillation.py)

A training with a teacher is resumed with the same --teacher; --from goes with neither.

The budget sets the schedule: the learning rate rises over the first percent and falls to zero at the last minute,
whatever the machine's speed. What is kept is the running average of the weights; the best on held-out scenes is kept
aside, and training stops early where the average has not become better for a quarter of the budget; not before half
of it, because a resumed run with a longer budget takes its learning rate up again, and never where it started from a
trained network.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from models import checkpoint, command, data, geometry, manifest, samples
from models.augmentation import OwnSkin
from models.bundle import Bundle
from models.checkpoint import CheckpointError, TrainingPlan
from models.distillation import Teacher, taught
from models.evaluation import LEVELS, evaluate, predict
from models.losses import losses, total
from models.network import FAST, FULL, MMCNN, NetworkConfig, laid_out
from models.optim import Muon
from models.pace import Pace, TrainingBar, plot
from models.prereconstruction import PreReconstructor
from models.pruning import part, worth
from models.warm_start import BATCHES, NoSuchNetwork, normalised, restored

# Of a checkpoint, and all plain.
NUMBERS = ("elapsed", "steps", "curve", "best_score", "best_at", "rates", "start", "minutes", "finished")
CONFIGS = {"full": FULL, "fast": FAST}
MUON_RATE, ADAM_RATE = 0.02, 2e-3
AVERAGE = 0.999
CPU_BATCH, GPU_BATCH = (64, 4), (1024, 16)  # scenes of a batch, and noise conditions among them
FINE = 0.04  # of the learning rates, where training starts from a trained network: more, and it is lost first
PART = 0.5  # the same for a part of a trained network: what was cut has to be made up for
OTHER_SKIN = 0.3  # the same for a registered skin, which the network has not seen: there is much to learn


class Trainer:
    """One network's training state: everything that a checkpoint holds."""

    def __init__(
        self, config: NetworkConfig, batches: samples.Batches, held_out: samples.Samples, seed: int = 0
    ) -> None:
        torch.manual_seed(seed)
        self.seed, self.commit = seed, manifest.commit()
        self.device = batches.device
        self.model = laid_out(MMCNN(config).to(self.device), torch.channels_last)
        self.average = copy.deepcopy(self.model)
        # Compiling takes minutes on a processor and gains little there.
        self._parts = torch.compile(self.model.parts) if self.device.type == "cuda" else self.model.parts
        self.config, self.batches, self.held_out = config, batches, held_out
        hidden = [
            p
            for n, p in self.model.named_parameters()
            if p.ndim == 4 and not n.startswith(("out.", "aside.", "classes.")) and not n.endswith("place")
        ]
        chosen = {id(p) for p in hidden}
        rest = [p for p in self.model.parameters() if id(p) not in chosen]
        self.optimizers = [
            Muon(hidden, MUON_RATE),
            torch.optim.AdamW(rest, ADAM_RATE, betas=(0.9, 0.98), weight_decay=0.01),
        ]
        self.rates = [MUON_RATE, ADAM_RATE]
        self.elapsed, self.steps = 0.0, 0  # seconds, batches
        self.minutes, self.finished = 0.0, False  # the budget; whether it is spent, or training has stopped before
        self.matrices = checkpoint.matrices_hash(batches.pre.m)
        self.start: dict[str, Any] = {}  # what the manifest says of where it started
        self.teacher: Teacher | None = None
        self.curve: list[dict[str, Any]] = []
        self.best: dict[str, Any] | None = None
        self.best_score, self.best_at = -math.inf, 0.0
        self.pace = Pace(torch.get_num_threads(), self.device.type)

    def step(self, done: float) -> dict[str, Tensor]:
        """One batch at fraction `done` of the budget. The losses stay on the device: reading one waits for it."""
        with self.pace.of("batches"):
            batch = self.batches.draw()
        with self.pace.of("network"):
            return self._learn(batch, done)

    def _learn(self, batch: samples.Batch, done: float) -> dict[str, Tensor]:
        warm, factor = min(1.0, done / 0.01 + 0.01), 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
        for optimizer, rate in zip(self.optimizers, self.rates, strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate * warm * factor
        self.model.train()
        with torch.autocast("cuda", torch.bfloat16, enabled=self.device.type == "cuda"):
            parts = self._parts(batch.stack, batch.context)
        mask, amplitude, sigma, classes = (p.float() for p in parts)
        terms = losses((mask, amplitude, sigma, classes), batch.target)
        if self.teacher is not None:
            turn = self.batches.symmetries[self.steps % len(self.batches.symmetries)].turn
            said = self.teacher.parts(batch.stack, batch.context, turn)
            terms |= taught((mask, amplitude, sigma, classes), said, batch.target)
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
        total(terms).backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), 5.0)
        for optimizer in self.optimizers:
            optimizer.step()
        self.steps += 1
        blend = min(AVERAGE, (1 + self.steps) / (10 + self.steps))
        with torch.no_grad():
            for mine, theirs in zip(self.average.state_dict().values(), self.model.state_dict().values(), strict=True):
                mine.lerp_(theirs, 1 - blend) if mine.dtype.is_floating_point else mine.copy_(theirs)
        return {name: value.detach() for name, value in terms.items()}

    def run(
        self, minutes: float, path: Path, quiet: bool = False, folder: Path | None = None, name: str = "training"
    ) -> None:
        """Trains until the budget (all runs together) is spent; a checkpoint every two minutes.

        folder: where samples are still being made; what has appeared there is taken in at every check. Held-out checks
        take at most a tenth of the time, however slow the machine is.
        """
        chunks = len(data.chunk_files(folder)) if folder else 0
        budget, sums, count, saved = 60 * minutes, dict[str, Tensor](), 0, self.elapsed
        self.minutes, self.finished = minutes, False
        began = time.perf_counter() - self.elapsed
        next_check = self.elapsed + max(budget / 30, 15.0)
        with TrainingBar(name, budget, quiet) as bar:
            while self.elapsed < budget or not self.steps:  # finding a part can take longer than a short budget
                terms = self.step(self.elapsed / budget)
                sums = {k: v + sums.get(k, 0.0) for k, v in terms.items()}
                count += 1
                self.elapsed = time.perf_counter() - began
                bar.at(self.elapsed, self.steps)
                if self.elapsed >= min(next_check, budget):
                    row = self._check(sums, count)
                    chunks = self._take_new(folder, chunks)
                    sums, count = {}, 0
                    check_s = time.perf_counter() - began - self.elapsed
                    next_check = self.elapsed + max(budget / 30, 15.0, 10 * check_s)
                    bar.checked(row)
                    if self._no_better(row, budget):
                        print(f"no better on held-out scenes since minute {self.best_at / 60:.1f}: stopped")
                        break
                if self.elapsed - saved > 120:
                    saved = self.elapsed
                    self.save(path)
        self.finished = True
        self.save(path)

    def _take_new(self, folder: Path | None, known: int) -> int:
        """Takes in the samples made since `folder` held so many chunks; returns how many it holds now."""
        found = len(data.chunk_files(folder)) if folder else 0
        if folder and found > known:
            self.batches.add(samples.load(folder, "train", self.batches.pre, skip=known))
        return max(found, known)

    def _check(self, sums: dict[str, Tensor], count: int) -> dict[str, Any]:
        """Held-out figures of the averaged network, as a row of the curve. sums: of `count` losses since the last."""
        row: dict[str, Any] = {"minutes": self.elapsed / 60, "steps": self.steps}
        row |= {k: float(v) / count for k, v in sums.items()}
        with self.pace.of("held-out"):
            for level, decibel in LEVELS.items():
                own = self.batches.own
                figures = evaluate(predict(self.average), self.held_out, self.batches.pre, decibel, own=own)
                row |= {f"{k}, {level}": v for k, v in figures.items()}
        row["scenes"] = len(self.batches.samples)
        self.curve.append(row)
        return row

    def _no_better(self, row: dict[str, Any], budget: float) -> bool:
        """Keeps the network aside where it is the best so far; else, whether that has been so for too long."""
        score = sum(row[f"contact IoU, {level}"] for level in LEVELS)
        if score > self.best_score:
            self.best_score, self.best_at = score, self.elapsed
            self.best = copy.deepcopy(self.average.state_dict())
            return False
        # A trained network gets worse before it gets better: while the rate falls, nothing can be said.
        return not self.start and self.elapsed - max(self.best_at, 0.5 * budget) > 0.25 * budget

    def result(self) -> MMCNN:
        """The averaged network that was best on held-out scenes, on the CPU, for inference."""
        model = copy.deepcopy(self.average)
        model.load_state_dict(self.best or self.average.state_dict())
        return laid_out(model.cpu(), torch.contiguous_format).eval()

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {
            "config": self.config.to_dict(),
            "matrices": self.matrices,
            "said": {
                "seed": self.seed,
                "commit": self.commit,
                "scenes": len(self.batches.samples),
                "device": str(self.device),
                **self.start,
            },
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "best": self.best,
            "optimizers": [o.state_dict() for o in self.optimizers],
            "numbers": {k: getattr(self, k) for k in NUMBERS},
        }
        part = path.with_suffix(".part")
        torch.save(state, part)
        part.replace(path)

    def start_from(self, bundle: Bundle, variant: str, share: float = FINE) -> None:
        """The network of a bundle as the start, with a share of the learning rates. Raises NoSuchNetwork."""
        path = bundle.network_path(variant)
        if path is None:
            raise NoSuchNetwork(
                f"the bundle {bundle.name} has no network {variant!r} to start from: name another bundle, or leave "
                "it out"
            )
        model = restored(path.read_bytes(), self.config)
        batches = [self.batches.draw() for _ in range(BATCHES)]
        normalised(model, [(b.stack, b.context) for b in batches])
        for mine in (self.model, self.average):
            mine.load_state_dict(model.state_dict())
        self.rates = [share * rate for rate in self.rates]
        self.start = {"from": _network_said(bundle, variant)}

    def start_as_part(self, teacher: Teacher) -> None:
        """The teacher's most valuable channels and blocks as the start; finding them counts as training. Raises
        NoPart.
        """
        began = time.perf_counter()
        self.learn_from(teacher)
        whole = copy.deepcopy(teacher.model)
        model = part(whole, self.config, worth(whole, self.batches))
        for mine in (self.model, self.average):
            mine.load_state_dict(model.state_dict())
        self.rates = [PART * rate for rate in self.rates]
        self.start = {"part_of": teacher.said}
        self.elapsed = time.perf_counter() - began

    def as_teacher(self, variant: str) -> Teacher:
        """The network that this training ships as the teacher of another one. variant: its name in the bundle to be."""
        model = self.result()
        return Teacher(model, {"variant": variant, "network": checkpoint.weights_hash(model)})

    def learn_from(self, teacher: Teacher) -> None:
        self.teacher = Teacher(laid_out(teacher.model.to(self.device).eval(), torch.channels_last), teacher.said)

    def resume(self, path: Path, teacher: Teacher | None = None) -> None:
        """Goes on from a checkpoint, with the teacher that it had. Raises CheckpointError where it is not one of this
        network, skin and teacher.
        """
        state = checkpoint.read(path, self.device)
        if wrong := checkpoint.misfit(state, self.config, self.matrices, teacher.said if teacher else None):
            raise CheckpointError(f"{path}: {wrong.found}: {wrong.do}")
        self._take_up(path, state, teacher)

    def resume_same(self, path: Path, plan: TrainingPlan, teacher: Teacher | None = None) -> bool:
        """Whether there is a checkpoint of this very training, which is then gone on from. Says what was found."""
        if not path.exists():
            return False
        try:
            state = checkpoint.read(path, self.device)
        except CheckpointError as why:
            print(f"{why}; trained anew", flush=True)
            return False
        if wrong := checkpoint.misfit(state, self.config, self.matrices, teacher.said if teacher else None, plan):
            print(f"{path}: {wrong.found}; trained anew", flush=True)
            return False
        self._take_up(path, state, teacher)
        spent = f"{self.elapsed / 60:.1f} of {plan.minutes:.1f} minutes"
        todo = "using it, remove it to train anew" if self.finished else "going on from there"
        print(f"{path}: found a checkpoint after {spent} and {self.steps} batches; {todo}", flush=True)
        return True

    def _take_up(self, path: Path, state: dict[str, Any], teacher: Teacher | None) -> None:
        try:
            for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
                optimizer.load_state_dict(saved)
        except (KeyError, ValueError) as why:
            raise CheckpointError(
                f"{path}: found a checkpoint of another version's optimizers ({why}): remove it and train anew"
            ) from None
        if teacher is not None:
            self.learn_from(teacher)
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        self.best = state["best"]
        for name, value in state["numbers"].items():
            setattr(self, name, value)


def _network_said(bundle: Bundle | None, variant: str) -> dict[str, str] | None:
    """What the manifest says of a bundle's network."""
    if bundle is None or (path := bundle.network_path(variant)) is None:
        return None
    return {"bundle": bundle.hash, "network": bundle.manifest["files"][path.name]}


def full_network(bundle: Bundle, batches: samples.Batches) -> Teacher:
    """A bundle's full network as a teacher. Raises NoSuchNetwork."""
    path = bundle.network_path("full")
    if path is None:
        raise NoSuchNetwork(
            f"the bundle {bundle.name} has no network 'full' to learn from: name another bundle, or train "
            "without a teacher"
        )
    model = restored(path.read_bytes(), FULL)
    normalised(model, [(b.stack, b.context) for b in (batches.draw() for _ in range(BATCHES))])
    said = {"name": bundle.name, "bundle": bundle.hash, "network": bundle.manifest["files"][path.name]}
    return Teacher(model, said)


def train(
    variant: str,
    skin: geometry.SkinGeometry,
    pre: PreReconstructor,
    scenes: samples.Samples,
    held_out: samples.Samples,
    minutes: float,
    path: Path,
    seed: int = 0,
    threads: int = 1,
    resume: bool = False,
    folder: Path | None = None,
    start: Bundle | None = None,
    own: OwnSkin | None = None,
    teacher: Bundle | Teacher | None = None,
    go_on: bool = False,
) -> Trainer:
    """Trains a variant of CONFIGS; leaves the checkpoint at `path` and its curves (PNG) behind.

    folder: see Trainer.run. start: a bundle whose network is the start, instead of random weights. own: what was
    measured of this very skin.
    teacher: a larger network, or the bundle whose full network it is; a part of it is the start, and training learns
    from its answers. resume: goes on from the checkpoint, which must be there. go_on: does so where it is of this very
    training; one that is finished is not trained again. Raises CheckpointError, NoSuchNetwork, NoPart.
    """
    torch.set_num_threads(threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    size, groups = GPU_BATCH if device.type == "cuda" else CPU_BATCH
    batches = samples.Batches(scenes, pre, skin, seed, size, groups, device=device, own=own)
    trainer = Trainer(CONFIGS[variant], batches, held_out, seed)
    larger = full_network(teacher, batches) if isinstance(teacher, Bundle) else teacher
    if resume:
        trainer.resume(path, larger)
    elif go_on and trainer.resume_same(path, TrainingPlan(minutes, seed, _network_said(start, variant)), larger):
        if trainer.finished:
            return trainer
    elif larger is not None:
        trainer.start_as_part(larger)
    elif start is not None:
        trainer.start_from(start, variant, FINE if own is None else OTHER_SKIN)
    weights = sum(p.numel() for p in trainer.model.parameters()) / 1e6
    print(f"{variant}: {weights:.2f} M parameters, {len(scenes)} scenes, {trainer.device}", flush=True)
    before = trainer.steps
    trainer.run(minutes, path, folder=folder, name=variant)
    print(f"{variant}: {trainer.pace.said(trainer.steps - before, trainer.batches.size)}", flush=True)
    plot(trainer.curve, path.with_suffix(".png"))
    return trainer


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.train", description="Train a skin's network.")
    parser.add_argument("--skin", default="square16")
    parser.add_argument("--variant", choices=sorted(CONFIGS), default="full")
    parser.add_argument("--bundle", help="whose matrices to train with (default SKIN's)")
    parser.add_argument("--data", type=Path, help="folder of samples (default models/work/SKIN)")
    parser.add_argument("--out", type=Path, help="checkpoint (default models/work/SKIN/VARIANT.pt)")
    parser.add_argument("--minutes", type=command.minutes, default=80.0)
    parser.add_argument("--limit", type=int, help="use at most so many samples")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint, with the teacher that it had")
    parser.add_argument("--from", dest="start", help="the bundle whose network to start from, at a lower rate")
    parser.add_argument("--teacher", help="the bundle whose full network to start as a part of, and to learn from")
    args = parser.parse_args(argv)
    if args.start and (args.teacher or args.resume):
        raise command.ArgumentError(
            f"found --from and {'--teacher' if args.teacher else '--resume'}, expected one start: a bundle's network "
            "(--from), a part of one (--teacher) or the checkpoint (--resume); leave --from or the other out"
        )
    skin = geometry.load(args.skin)
    folder = args.data or data.WORK / skin.name
    path = args.out or data.WORK / skin.name / f"{args.variant}.pt"
    pre = command.bundle_of(skin, args.bundle or skin.name).prereconstructor()
    start = Bundle.load(args.start) if args.start else None
    teacher = command.bundle_of(skin, args.teacher) if args.teacher else None
    data.check_skin(folder, skin)
    scenes, held_out = (samples.load(folder, split, pre, args.limit) for split in ("train", "valid"))
    train(
        args.variant,
        skin,
        pre,
        scenes,
        held_out,
        args.minutes,
        path,
        args.seed,
        args.threads,
        resume=args.resume,
        folder=None if args.limit else folder,
        start=start,
        teacher=teacher,
    )


if __name__ == "__main__":
    command.run("models.train", main)
