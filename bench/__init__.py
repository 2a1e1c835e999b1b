"""Benchmarks. Numerical libraries get one thread, as in the services."""

import services  # noqa: F401  (sets it, before numpy is loaded)
