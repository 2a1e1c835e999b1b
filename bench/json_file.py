"""Reports as strict JSON files, and their pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import models
from bench.goals import Goal
from bench.machine import provenance
from protocol.whole_file import write_whole


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a report; its folder is made where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(_strict(dict(content)), indent=1, allow_nan=False) + "\n")


def write_report(
    path: Path, arguments: Sequence[str] | None, goals: Sequence[Goal], found: Mapping[str, Any], picture: bool = True
) -> None:
    """Of the benchmark that the file is named after: how it was made, its figures, what it found; and the picture."""
    head = provenance(path.stem.removesuffix("_live"), arguments)
    write_json(path, {**head, "targets": [goal.to_dict() for goal in goals], **found})
    if picture:
        drawn(path)
    print(f"wrote {path}")


def drawn(report: Path) -> None:
    """The picture of a report, beside it. Without matplotlib a line says so: what was measured stands all the same."""
    try:
        from bench import plots  # matplotlib takes a while
    except ModuleNotFoundError as missing:
        print(f"no picture of {report.name}: {models.not_installed(missing) or missing}")
        return
    plots.draw(report)


def _strict(value: Any) -> Any:
    """JSON knows no infinity (touches never told apart) and no NaN: null."""
    if isinstance(value, dict):
        return {k: _strict(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_strict(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
