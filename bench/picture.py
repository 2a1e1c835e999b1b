"""The picture of docs/method.md: six touches as they are, in a one-step image, and as the shipped bundle shows them.

    python -m bench.picture [--snr 70] [--out docs/touches.png]

The frames are computed on the reference mesh, which neither training nor inverse uses, with noise on frame and tare.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from models.bundle import Bundle
from models.command import real
from models.forward import ForwardModel
from models.prereconstruction import Array, PreReconstructor
from models.shapes import Shape, drop_image
from protocol.whole_file import whole_file
from services.recordings.npz_file import Input
from services.recordings.reconstruction import find_skin, reconstruct

TOUCHES = (
    [Shape("circle", 0.0, 0.0, 0.2, 0.15)],
    [Shape("L", -0.4, 0.35, 0.4, 0.3, 0.4)],
    [Shape("triangle", 0.35, -0.3, 0.38, 0.4, 0.9)],
    [Shape("rectangle", 0.3, 0.4, 0.4, 0.25, 0.6, 2.0)],
    [Shape("circle", -0.45, -0.35, 0.22, 0.3), Shape("square", 0.4, 0.35, 0.3, 0.4, 0.5)],
    [Shape("circle", -0.5, 0.5, 0.2, 0.3), Shape("circle", 0.5, 0.45, 0.2, 0.45), Shape("circle", 0, -0.45, 0.25, 0.2)],
)
UNTOUCHED_FRAMES = 64


def frames(snr_db: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(6, 120) touched and (64, 120) untouched |Z| [ohm], noisy."""
    rng = np.random.default_rng(seed)
    model = ForwardModel("square16", mesh="reference")
    z0 = model.solve(1.0).impedances()
    clean = np.array([model.solve(model.touched(shapes)).impedances() for shapes in TOUCHES])
    relative = 10 ** (-snr_db / 20)
    noisy = clean * (1 + relative * rng.standard_normal(clean.shape))
    return noisy, z0 * (1 + relative * rng.standard_normal((UNTOUCHED_FRAMES, len(z0))))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench.picture", description=__doc__)
    parser.add_argument("--snr", type=real(), default=70.0, help="noise, dB (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("docs/touches.png"))
    options = parser.parse_args(argv)
    touched, untouched = frames(options.snr)
    skin, bundle = find_skin("square16")
    images = reconstruct(Input(touched, untouched, None), skin, bundle)["image"]
    z0 = untouched.mean(axis=0)
    operator = PreReconstructor(Bundle.load("square16").matrices).condition(np.full(len(z0), 10 ** (-options.snr / 20)))
    one_step = [operator.one_step(z / z0 - 1, 96) for z in touched]
    figure, axes = plt.subplots(3, len(TOUCHES), figsize=(2 * len(TOUCHES), 6.2), layout="constrained")
    rows: tuple[tuple[str, Iterable[Array]], ...] = (
        ("truth", [drop_image(shapes, 96) for shapes in TOUCHES]),
        ("NOSER", one_step),
        ("eitskin", images),
    )
    for row, (name, pictures) in zip(axes, rows, strict=True):
        row[0].set_ylabel(name, fontsize=15)
        for axis, picture in zip(row, pictures, strict=True):
            shown = axis.imshow(picture, origin="lower", vmin=0, vmax=0.5, cmap="magma", extent=(-50, 50, -50, 50))
            axis.set(xticks=[], yticks=[])
    axes[0, 0].set_title("100 mm", fontsize=13, pad=8)
    axes[0, 0].annotate("", (0, 1.02), (1, 1.02), "axes fraction", arrowprops={"arrowstyle": "<->"})
    scale = figure.colorbar(shown, ax=axes, shrink=0.8)
    scale.set_label("conductivity drop, S/m", fontsize=15)
    scale.ax.tick_params(labelsize=13)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(options.out) as part:
        figure.savefig(part, dpi=95)
    print(f"{options.out}: noise {options.snr:g} dB, the sheet is 100 mm wide")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
