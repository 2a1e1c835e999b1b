"""What was counted so far, on disk: a run resumes and adds up. Counts of other code are never added to."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

from bench import ROOT, WORK
from bench.json_file import write_json
from bench.trust.score import TrustScore

CODE = ("protocol", "models", "services", "firmware_stub", "bench/trust", "bench/tracking/host.py")


def code() -> str:
    """A hash of everything that a score depends on."""
    digest = hashlib.sha256()
    for name in CODE:
        path = ROOT / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    for manifest in sorted((ROOT / "models" / "bundles").glob("*/manifest.json")):
        digest.update(manifest.read_bytes())
    return digest.hexdigest()[:12]


def published_seed() -> str:
    """The commit that is checked out: the parent of the one that publishes what was found with it. Raises ValueError
    where there is none.
    """
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        raise ValueError("this is no git checkout, which would say the seed: give --seed TEXT") from None
    return found.stdout.strip()


def session_seed(seed: str, world: str, number: int) -> int:
    """Of one session: from the sha256 of the seed's text, the world's name and the session's number."""
    return int.from_bytes(hashlib.sha256(f"{seed} {world} {number}".encode()).digest()[:4], "big")


class KeptScore:
    """Of one world, kind of scan and seed. `number`: of the session that comes next."""

    def __init__(self, name: str, seed: str, folder: Path | None = None) -> None:
        self.path = (folder or WORK / "trust" / code()) / seed[:12] / f"{name}.json"
        self.score, self.number = TrustScore(), 0
        if self.path.is_file():
            found: dict[str, Any] = json.loads(self.path.read_text(encoding="utf-8"))
            self.score, self.number = TrustScore.of(found["score"]), int(found["number"])

    def add(self, score: TrustScore) -> None:
        self.score.add(score)
        self.number += 1
        write_json(self.path, {"score": self.score.to_dict(), "number": self.number})

    @property
    def recordings(self) -> Path:
        return self.path.with_suffix("")
