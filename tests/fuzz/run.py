"""Feeds the decoders, led by coverage: atheris (libFuzzer) where it is installed, plain mutation elsewhere.

    python tests/fuzz/run.py [--seconds 600] [DECODER...]

Without --seconds 5000 inputs each, the same every time. Exits 1 where a decoder raised anything but its own error, took
longer than 10 s or more than 2 GB for one input; the input lies in build/fuzz then: small ones belong into corpus/.
"""

import argparse
import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOUND = ROOT / "build" / "fuzz"
LONGEST = 20_000  # bytes of an input
SLOWEST_S, MOST_MB = 10, 2048
RUNS, MOST_S = 5000, 300  # inputs for each decoder where nothing is searched for, and how long that may take
OURS = ["protocol", "models", "services", "mcap", "zipfile", "tomllib", "csv", "json"]


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", help="which decoders; default: all")
    parser.add_argument("--seconds", type=int, default=0, help="for each: a search, from another seed every time")
    parser.add_argument("--work", help=argparse.SUPPRESS)  # of the process of its own that each decoder has
    args = parser.parse_args(arguments)
    sys.path[:0] = [str(ROOT)]
    if args.work:
        return feed(args.targets[0], Path(args.work), args.seconds)
    from tests.fuzz.decoders import TARGETS, seeds

    if unknown := set(args.targets) - set(TARGETS):
        parser.error(f"no decoder {min(unknown)}: expected some of {', '.join(TARGETS)}")
    bad = [name for name in args.targets or TARGETS if not stands(name, seeds(name), args.seconds)]
    if bad:
        print(f"raised, hung or grew: {', '.join(bad)}; the inputs are in {FOUND}")
    return 1 if bad else 0


def stands(name: str, seeds: list[bytes], seconds: int) -> bool:
    """Whether a decoder stands what is made of its seeds."""
    FOUND.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
        for k, data in enumerate(seeds):
            Path(folder, f"{k:03d}").write_bytes(data)
        command = [sys.executable, __file__, name, "--work", folder, "--seconds", str(seconds)]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=seconds * 3 + MOST_S)
        fresh = len(list(Path(folder).iterdir())) - len(seeds)
    print(f"{name:14s} {'FAILED' if ran.returncode else 'stood'}, {len(seeds)} inputs, {fresh} new", flush=True)
    if ran.returncode:
        print((ran.stdout + ran.stderr)[-4000:])
    return ran.returncode == 0


def feed(name: str, work: Path, seconds: int) -> int:
    """In the process of its own."""
    os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        import atheris

        instrumented = atheris.instrument_imports(include=OURS)
    except ImportError:
        atheris, instrumented = None, contextlib.nullcontext()
    with instrumented:
        from tests.fuzz.decoders import TARGETS
    TARGETS[name](b"")  # what it loads once does not count as its first input's time
    if atheris:
        options = [f"-max_total_time={seconds}"] if seconds else [f"-runs={RUNS}", "-seed=1"]
        options += [f"-max_len={LONGEST}", f"-timeout={SLOWEST_S}", f"-rss_limit_mb={MOST_MB}"]
        atheris.Setup([sys.argv[0], *options, f"-artifact_prefix={FOUND}/{name}-", str(work)], TARGETS[name])
        atheris.Fuzz()  # which ends the process
    inputs = [path.read_bytes() for path in sorted(work.iterdir())]
    rng, tried, end = random.Random(None if seconds else 1), 0, time.monotonic() + seconds
    while time.monotonic() < end if seconds else tried < RUNS:
        data = bytearray(rng.choice(inputs))
        for _ in range(rng.randint(1, 5)):
            at = rng.randint(0, len(data))
            data[at : at + rng.randint(0, 8)] = rng.randbytes(rng.randint(0, 8))
        tried, began = tried + 1, time.monotonic()
        try:
            TARGETS[name](bytes(data[:LONGEST]))
            assert time.monotonic() - began < SLOWEST_S, f"took {time.monotonic() - began:.0f} s"
        except Exception:
            (FOUND / f"{name}-crash").write_bytes(data)
            raise
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
