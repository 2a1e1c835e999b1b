"""The mean of several checkpoints of one training run, with the statistics of its normalisation taken anew.

    python -m models.average --skin square16 --bundle BUNDLE --data FOLDER A.pt B.pt --out full.pt

Weights from different times of one run lie in one valley of the loss, and their mean errs less than each of them
(Izmailov et al. 2018, "Averaging weights leads to wider optima"). The statistics of batch normalisation belong to each
of them alone, so they are measured on the scenes again.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from torch import nn

from models import checkpoint, command, data, geometry, samples
from models.checkpoint import CheckpointError
from models.network import MMCNN, NetworkConfig

BATCHES = 300  # that statistics are taken over


def average(checkpoints: list[dict[str, Any]], batches: samples.Batches) -> dict[str, Any]:
    """The last checkpoint, what it ships replaced by the mean of what all of them would."""
    kept = [c["best"] or c["average"] for c in checkpoints]
    mean = {
        name: sum(k[name] for k in kept) / len(kept) if value.dtype.is_floating_point else value
        for name, value in kept[-1].items()
    }
    model = MMCNN(NetworkConfig.from_dict(checkpoints[-1]["config"]))
    model.load_state_dict(mean)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.reset_running_stats()
            module.momentum = None  # the mean over all batches
    model.train()
    with torch.no_grad():
        for _ in range(BATCHES):
            batch = batches.draw()
            model.parts(batch.stack, batch.context)
    minutes = [round(c["numbers"]["elapsed"] / 60, 1) for c in checkpoints]
    said = {**checkpoints[-1].get("said", {}), "mean_of_checkpoints_after_minutes": minutes}
    return {**checkpoints[-1], "best": model.state_dict(), "said": said}


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.average", description="Average checkpoints of one run.")
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("--skin", default="square16")
    parser.add_argument("--bundle", help="whose matrices they were trained with (default SKIN's)")
    parser.add_argument("--data", type=Path, help="folder of samples (default models/work/SKIN)")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--limit", type=int, default=8000, help="scenes that are read")
    args = parser.parse_args(argv)
    skin = geometry.load(args.skin)
    folder = args.data or data.WORK / skin.name
    pre = command.bundle_of(skin, args.bundle or skin.name).prereconstructor()
    found = [checkpoint.read(path) for path in args.checkpoints]
    for path, other in zip(args.checkpoints, found, strict=True):
        if other["config"] != found[-1]["config"]:
            raise CheckpointError(
                f"found networks of other sizes in {path} and {args.checkpoints[-1]}, expected those of one "
                "training: name no others"
            )
    data.check_skin(folder, skin)
    scenes = samples.load(folder, "train", pre, args.limit)
    torch.save(average(found, samples.Batches(scenes, pre, skin, seed=1)), args.out)


if __name__ == "__main__":
    command.run("models.average", main)
