"""How much time one run of the network saves for several skins whose frames wait at once."""

from __future__ import annotations

import time

import numpy as np
from rich.table import Table

from bench.tracking.scene import Recorded
from models.bundle import Bundle
from protocol.frames import DeltaFrame
from services.inference import Inference
from services.networks import network
from services.preprocessing import Preprocessing
from services.runtime.config import Skin, TouchConfig

TOGETHER = (1, 2, 4, 8)  # skins
FRAMES, ROUNDS = 64, 3


def batched(recorded: Recorded, bundle: Bundle) -> dict[str, dict[str, float]]:
    """Skins that wait at once -> CPU of a frame's network [ms], one run for all of them and one for each; and by how
    much the images differ at most [S/m].
    """
    skin = Skin(port="stub", bundle="square16", touch=TouchConfig(hold=False))
    pre, inference = Preprocessing("palm", skin, bundle), Inference("palm", skin, bundle)
    made = [pre.process(recorded.frame(k), frozenset({"delta"}))[0] for k in range(len(recorded))]
    asked = [inference.stack(delta) for delta in made if isinstance(delta, DeltaFrame)]
    stacks = [stack for stack in asked if stack is not None]
    shared = network(str(bundle.network_path("int8")))
    found = {}
    for n in TOGETHER:
        rounds = [stacks[k : k + n] for k in range(0, min(len(stacks), FRAMES) // n * n, n)]
        times: dict[str, list[float]] = {"one run": [], "each alone": []}
        differ = 0.0
        for _ in range(ROUNDS):
            for each in rounds:
                began = time.thread_time()
                together = shared.run_many(each)
                between = time.thread_time()
                alone = [shared.run(stack) for stack in each]
                ended = time.thread_time()
                times["one run"].append(1e3 * (between - began) / n)
                times["each alone"].append(1e3 * (ended - between) / n)
                differ = max(differ, *(float(np.abs(a[0] - b[0]).max()) for a, b in zip(together, alone, strict=True)))
        found[str(n)] = {name: float(np.median(values)) for name, values in times.items()} | {"differ": differ}
    return found


def batch_table(batches: dict[str, dict[str, float]]) -> Table:
    table = Table(title="frames that wait at once: CPU of the network, ms a frame", title_justify="left")
    for heading in ("skins", "one run", "each alone", "images differ by, S/m"):
        table.add_column(heading, justify="right")
    for n, row in batches.items():
        table.add_row(n, f"{row['one run']:.2f}", f"{row['each alone']:.2f}", f"{row['differ']:.1g}")
    return table
