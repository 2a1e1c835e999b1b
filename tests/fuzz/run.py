"""Feeds the decoders, led by coverage: atheris (libFuzzer) where it is installed, plain mutation elsewhere.

    python tests/fuzz/run.py                       every decoder, 5000 inputs each, the same every time, as in CI
    python tests/fuzz/run.py --seconds 600 frame   one of them, searched for a while: other inputs every time
    python tests/fuzz/run.py --keep ...            and put what reached new code into the corpus (small ones only)

Exits 1 where a decoder raised anything but its own error, took longer than 10 s or more than 2 GB for one input; the
input lies in build/fuzz then.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CORPUS = Path(__file__).parent / "corpus"
FOUND = ROOT / "build" / "fuzz"
LONGEST = 20_000  # bytes of an input
KEPT_SIZE, KEPT_NUMBER = 3000, 12  # of an input of the corpus, and of inputs for a decoder
SLOWEST_S, MOST_MB = 10, 2048
RUNS, MOST_S = 5000, 300  # inputs for each decoder where nothing is searched for, and how long one may take for them
OURS = ["protocol", "models", "services", "mcap", "zipfile", "tomllib", "csv", "json"]


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="which decoders; default: all")
    parser.add_argument("--seconds", type=int, default=0, help="for each: a search, from another seed every time")
    parser.add_argument("--runs", type=int, default=RUNS, help="inputs for each, from a fixed seed, without --seconds")
    parser.add_argument("--keep", action="store_true", help="add what reached new code to the corpus")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    sys.path[:0] = [str(ROOT)]
    if args.one:
        return feed(args.one, Path(args.work), args.seconds, args.runs)
    from tests.fuzz.decoders import TARGETS, seeds

    unknown = set(args.targets) - set(TARGETS)
    if unknown:
        parser.error(f"no decoder {min(unknown)}: expected some of {', '.join(TARGETS)}")
    bad = [name for name in args.targets or TARGETS if not fuzz(name, seeds(name), args)]
    if bad:
        print(f"raised, hung or grew: {', '.join(bad)}; the inputs are in {FOUND}")
    return 1 if bad else 0


def fuzz(name: str, seeds: list[bytes], args: argparse.Namespace) -> bool:
    """One decoder in a process of its own, from its seeds and its corpus; whether it stood."""
    FOUND.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
        for data in [*seeds, *(path.read_bytes() for path in sorted((CORPUS / name).glob("*")))]:
            Path(folder, hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
        before = {path.name for path in Path(folder).iterdir()}
        command = [sys.executable, __file__, "--one", name, "--work", folder]
        command += ["--seconds", str(args.seconds), "--runs", str(args.runs)]
        began = time.monotonic()
        ran = subprocess.run(command, capture_output=True, text=True, timeout=args.seconds * 3 + MOST_S)
        fresh = [path for path in Path(folder).iterdir() if path.name not in before]
        verdict = "stood" if ran.returncode == 0 else "FAILED"
        speed, took = _speed(ran.stdout + ran.stderr), time.monotonic() - began
        print(f"{name:14s} {verdict}, {speed}, {len(before)} inputs before, {len(fresh)} new, {took:.0f} s", flush=True)
        if ran.returncode:
            print((ran.stdout + ran.stderr)[-4000:])
        elif args.keep:
            _keep(name, fresh)
        return ran.returncode == 0


def _speed(text: str) -> str:
    """What libFuzzer or the plain mutation said of itself at its end."""
    done = [line for line in text.splitlines() if line.startswith(("Done ", "tried "))]
    return done[-1] if done else "did not end"


def _keep(name: str, fresh: list[Path]) -> None:
    room = KEPT_NUMBER - len(list((CORPUS / name).glob("*")))
    (CORPUS / name).mkdir(parents=True, exist_ok=True)
    small = [path for path in sorted(fresh, key=lambda p: p.stat().st_mtime_ns) if path.stat().st_size <= KEPT_SIZE]
    for path in small[:: max(1, len(small) // room if room > 0 else 1)][: max(0, room)]:
        data = path.read_bytes()
        (CORPUS / name / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)


def feed(name: str, work: Path, seconds: int, runs: int) -> int:
    """In the process of its own."""
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        import atheris
    except ImportError:
        return _plain(name, work, seconds, runs)
    with atheris.instrument_imports(include=OURS):
        from tests.fuzz.decoders import TARGETS
    target = TARGETS[name]
    target(b"")  # what it loads once does not count as its first input's time
    options = [f"-max_total_time={seconds}"] if seconds else [f"-runs={runs}", "-seed=1"]
    options += [f"-max_len={LONGEST}", f"-timeout={SLOWEST_S}", f"-rss_limit_mb={MOST_MB}"]
    options += [f"-artifact_prefix={FOUND}/{name}-", "-print_final_stats=0"]
    atheris.Setup([sys.argv[0], *options, str(work)], target)
    atheris.Fuzz()
    return 0


def _plain(name: str, work: Path, seconds: int, runs: int) -> int:
    from tests.fuzz.decoders import TARGETS

    inputs = [path.read_bytes() for path in sorted(work.iterdir())]
    rng, tried, end = random.Random(None if seconds else 1), 0, time.monotonic() + seconds
    while time.monotonic() < end if seconds else tried < runs:
        data = bytearray(rng.choice(inputs))
        for _ in range(rng.randint(1, 5)):
            at = rng.randint(0, len(data))
            data[at : at + rng.randint(0, 8)] = rng.randbytes(rng.randint(0, 8))
        tried += 1
        began = time.monotonic()
        try:
            TARGETS[name](bytes(data[:LONGEST]))
            assert time.monotonic() - began < SLOWEST_S, f"took {time.monotonic() - began:.0f} s"
        except Exception:
            (FOUND / f"{name}-crash").write_bytes(data)
            raise
    print(f"tried {tried} inputs without atheris, which is not installed")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
