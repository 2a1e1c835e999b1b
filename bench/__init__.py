"""Benchmarks. Numerical libraries get one thread, as in the services."""

import models  # noqa: F401  (Ctrl-C leaves without a traceback)
import services  # noqa: F401  (sets it, before numpy is loaded)
