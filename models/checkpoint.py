"""Checkpoints of a training: how one is read, and whether a training can go on from it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from models.network import MMCNN, NetworkConfig
from models.prereconstruction import Matrices
from protocol.errors import EitskinError

NEEDED = ("config", "model", "average", "best", "optimizers", "numbers")


class CheckpointError(EitskinError, ValueError):
    """A checkpoint is not there, cannot be read, or is of another training."""


class Misfit(NamedTuple):
    """found: with what was expected; do: what whoever asked to go on from the checkpoint can do."""

    found: str
    do: str


@dataclass(frozen=True)
class TrainingPlan:
    """What a training was started with, beside its skin and its network. start: what the manifest says of the bundle's
    network that it started from.
    """

    minutes: float
    seed: int
    start: dict[str, Any] | None = None


def read(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """All of a checkpoint's state. Raises CheckpointError."""
    if not path.is_file():
        raise CheckpointError(
            f"found no file {path}, expected a checkpoint: name one that is there, or train one first"
        )
    try:
        state = dict(torch.load(path, map_location=device, weights_only=True))
        _ = [state[name] for name in NEEDED], state["numbers"]["elapsed"], state["numbers"]["steps"]
        MMCNN(NetworkConfig.from_dict(state["config"])).load_state_dict(state["average"])
    except Exception as why:  # pickle, zipfile and PyTorch raise their own: a damaged file, or another kind
        raise CheckpointError(
            f"{path}: found a file that cannot be read ({type(why).__name__}), expected a checkpoint: it is damaged, "
            "of another kind or of another version; remove it and train anew"
        ) from None
    return state


def misfit(
    state: dict[str, Any],
    config: NetworkConfig,
    matrices: str,
    teacher: dict[str, Any] | None,
    plan: TrainingPlan | None = None,
) -> Misfit | None:
    """Why a training cannot go on from a checkpoint; None where it can.

    matrices: `matrices_hash` of those it trains with; teacher: what the manifest says of its teacher; plan: where it
    must be the very same training, not only a further one of the same network.
    """
    theirs, start = NetworkConfig.from_dict(state["config"]), state["numbers"].get("start", {})
    if theirs != config:
        return Misfit(
            f"found a checkpoint of a network {_sizes(theirs)}, expected one {_sizes(config)}",
            "choose the --variant that it is of, or name another checkpoint with --out",
        )
    if state.get("matrices", matrices) != matrices:
        return Misfit(
            f"found a checkpoint trained with the matrices {state['matrices'][:12]}, expected {matrices[:12]}",
            "name the skin and the bundle that it was trained with, or train anew without --resume",
        )
    if wrong := _other_teacher(start.get("part_of"), teacher):
        return wrong
    if plan is not None and (found := _other_plan(state, start.get("from"), plan)):
        return Misfit(found, "train anew")
    return None


def _other_teacher(found: dict[str, Any] | None, given: dict[str, Any] | None) -> Misfit | None:
    if found is None and given is not None:
        return Misfit(
            f"found a checkpoint that had no teacher, expected one that learnt from {teacher_name(given)}",
            "leave --teacher out, or train anew without --resume",
        )
    if found is None or (given is not None and given["network"] == found["network"]):
        return None
    was = f"found a checkpoint that learnt from {teacher_name(found)}"
    do = "name that bundle with --teacher" if "bundle" in found else "go on with models.build, which trained both"
    expected = "and no teacher was named" if given is None else f"expected one that learnt from {teacher_name(given)}"
    return Misfit(f"{was}, {expected}", f"{do}, or train anew without --resume")


def _other_plan(state: dict[str, Any], start: dict[str, Any] | None, plan: TrainingPlan) -> str:
    if "matrices" not in state:
        return "found a checkpoint that does not say which skin it is of"
    for what, found, wanted in (
        ("minutes", state["numbers"].get("minutes"), plan.minutes),
        ("seed", state.get("said", {}).get("seed"), plan.seed),
        ("network that it started from", (start or {}).get("network"), (plan.start or {}).get("network")),
    ):
        if found != wanted:
            return f"found a checkpoint with the {what} {_short(found)}, expected {_short(wanted)}"
    return ""


def _short(value: float | str | None) -> str:
    return "none" if value is None else value[:12] if isinstance(value, str) else f"{value:.4g}"


def _sizes(config: NetworkConfig) -> str:
    kind = " and no attention" if config.lean else ""
    return f"of {'/'.join(map(str, config.channels))} channels, {'/'.join(map(str, config.blocks))} blocks{kind}"


def teacher_name(said: dict[str, Any]) -> str:
    """In words, of what a manifest says of a teacher."""
    network = f"network {said['network'][:12]}"
    if "bundle" not in said:
        return f"the {said.get('variant', 'full')} network that was trained before it ({network})"
    return " ".join(["the bundle", *([said["name"]] if "name" in said else []), f"{said['bundle'][:12]} ({network})"])


def matrices_hash(matrices: Matrices) -> str:
    """sha256 of what the images that a network learns from are made with. Of the skin too: its electrodes, its pattern
    and its outline are in the sensitivities.
    """
    m = matrices
    parts = (m.pattern, m.z0, m.jacobian, m.back, m.ladder)  # gram's last digits depend on the number of threads
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in parts)).hexdigest()


def weights_hash(model: MMCNN) -> str:
    """sha256 of a network's weights."""
    values = (value.detach().cpu().contiguous().numpy().tobytes() for value in model.state_dict().values())
    return hashlib.sha256(b"".join(values)).hexdigest()
