"""What makes two runs of the tests one and the same: the one place that pins seeds, threads and kernels.

Import it before numpy: tests/conftest.py does, first of all. Processes that a test starts inherit the variables, and so
do the workers of pytest-xdist, which is how PYTHONHASHSEED takes effect. EITSKIN_UNPINNED=1 leaves kernels and threads
as the machine has them, so that pinning hides nothing from users (`make check-all` runs once so).
"""

import contextlib
import os
import random
import sys
from pathlib import Path

SEED = 0
FIXED = {"PYTHONHASHSEED": "0", "EITSKIN_STUB_SEED": "1"}  # the stub's noise: firmware_stub/__main__.py
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# OpenBLAS and numpy choose by the processor what to compute with, and the last bits differ. These are kernels that
# every x86-64 processor with AVX2 has; elsewhere the choice stays the library's.
KERNELS = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}


def pin() -> None:
    """Set the environment of this process and of its children."""
    os.environ.update(FIXED)
    if os.environ.get("EITSKIN_UNPINNED"):
        return
    os.environ.update(THREADS)
    flags = _processor_flags()
    if "avx2" in flags:
        os.environ["OPENBLAS_CORETYPE"] = KERNELS["OPENBLAS_CORETYPE"]
    if "avx512f" in flags:  # numpy warns where there is nothing to disable
        os.environ["NPY_DISABLE_CPU_FEATURES"] = KERNELS["NPY_DISABLE_CPU_FEATURES"]


def seed() -> None:
    """The generators that modules share, anew before each test."""
    random.seed(SEED)
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed(SEED)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(SEED)


def _processor_flags() -> set[str]:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return set(line.partition(":")[2].split())
    return set()
