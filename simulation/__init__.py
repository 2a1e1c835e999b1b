"""A skin in simulated time, for tests and benchmarks: nothing here looks at a clock. The same seed says the same."""

import services  # noqa: F401  (one thread for the numerical libraries, before numpy starts them)
