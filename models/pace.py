"""How a training run gets on: its bar and remaining time, where its time goes, and what limits it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from models.evaluation import LEVELS
from protocol.whole_file import whole_file

STARVED = 0.7  # of the processor time that its threads could have had: below, other programs had the rest
MUCH = 0.4  # share of the time from which making batches, or held-out checks, is what to look at


class Pace:
    """Wall time by part ("batches", "network", "held-out"), against the processor time that this process had."""

    def __init__(
        self,
        threads: int = 1,
        device: str = "cpu",
        clock: Callable[[], float] = time.perf_counter,
        processor: Callable[[], float] = time.process_time,
    ) -> None:
        self.threads, self.device = threads, device
        self._clock, self._processor = clock, processor
        self._began, self._used = clock(), processor()
        self.parts: dict[str, float] = {}

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        began = self._clock()
        yield
        self.parts[part] = self.parts.get(part, 0.0) + self._clock() - began

    def wall_s(self) -> float:
        return max(self._clock() - self._began, 1e-9)

    def processor_share(self) -> float:
        """The share of the time of `threads` cores that this process had."""
        return (self._processor() - self._used) / (self.wall_s() * self.threads)

    def said(self, batches: int, size: int) -> str:
        """Throughput, and what limits it, in words."""
        wall = self.wall_s()
        share = {part: s / wall for part, s in self.parts.items()}
        took = ", ".join(f"{part} {100 * s:.0f} %" for part, s in sorted(share.items(), key=lambda kv: -kv[1]))
        rate = f"{batches / wall:.2g} batches of {size} scenes a second (of the time: {took})"
        return f"{rate}; {self._limit(share)}"

    def _limit(self, share: dict[str, float]) -> str:
        making = share.get("batches", 0.0)
        if self.device != "cpu":
            if making > MUCH:
                return "what limits it: the processor, which makes the batches, not the GPU"
            return "what limits it: the GPU"
        cores = f"{self.threads} core{'s' if self.threads > 1 else ''}"
        used = self.processor_share()
        if used < STARVED:
            return f"what limits it: other programs on this machine; training had {100 * used:.0f} % of {cores}"
        what = "making batches" if making > MUCH else "the network's arithmetic"
        return f"what limits it: {what} on {cores}; a GPU, or more cores with --jobs, would be faster"


class TrainingBar:
    """A bar with the remaining time on a terminal; on any other output, a line of words at each held-out check."""

    def __init__(self, name: str, budget_s: float, quiet: bool = False, console: Console | None = None) -> None:
        self.name, self.budget_s, self.quiet = name, budget_s, quiet
        self.console = console or Console()
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
        )
        hidden = quiet or not self.console.is_terminal
        self._progress = Progress(*columns, console=self.console, disable=hidden, refresh_per_second=2)
        self._task = self._progress.add_task(name, total=budget_s, said="")

    def __enter__(self) -> TrainingBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def at(self, elapsed_s: float, batches: int) -> None:
        """After each batch."""
        self._progress.update(
            self._task, completed=min(elapsed_s, self.budget_s), said=f"{batches / max(elapsed_s, 1e-9):.2g} batches/s"
        )

    def checked(self, row: dict[str, Any]) -> None:
        """A held-out check: see Trainer.run."""
        if self.quiet:
            return
        left = max(0.0, self.budget_s / 60 - row["minutes"])
        found = "; ".join(
            f"{level}: contact IoU {row[f'contact IoU, {level}']:.3f}, "
            f"position {row[f'position % of side, {level}']:.2f} % of the side"
            for level in LEVELS
        )
        self.console.print(
            f"{self.name}: minute {row['minutes']:.1f}, {left:.1f} left, {row['steps']} batches; held out, {found}",
            soft_wrap=True,
            highlight=False,
        )


def plot(curve: list[dict[str, Any]], path: Path) -> None:
    """Loss and held-out figures against minutes, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4))
    minutes = [row["minutes"] for row in curve]
    for name in ("image", "mask", "jaccard", "amplitude", "peak", "integral", "class"):
        axes[0].semilogy(minutes, [row.get(name, np.nan) for row in curve], label=name)
    for level in LEVELS:
        for name in ("mean IoU", "contact IoU"):
            axes[1].plot(minutes, [row[f"{name}, {level}"] for row in curve], label=f"{name}, {level}")
    for axis, title in zip(axes, ("training loss, by term", "held-out single touches"), strict=True):
        axis.set_xlabel("minutes")
        axis.set_title(title)
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    with whole_file(path) as part:
        figure.savefig(part, dpi=110)
    plt.close(figure)
