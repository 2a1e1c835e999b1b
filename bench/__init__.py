"""Benchmarks. Numerical libraries get one thread, as in the services."""

import models  # noqa: F401  (Ctrl-C, or a package that is missing, gives no traceback)
import services  # noqa: F401  (sets it, before numpy is loaded)
