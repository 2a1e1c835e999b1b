"""The running service. Numerical libraries get one thread each: a stage is small, and other stages need the other
cores. onnxruntime sends nobody anything, and keeps nothing in the user's home.
"""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "ORT_DISABLE_TELEMETRY"):
    os.environ.setdefault(_variable, "1")
