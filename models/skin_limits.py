"""What a skin and its bundle may have: one table. The first who could know asks it (`skin new`, a skin's file, a
training before it begins), and whoever reads a bundle asks it again.
"""

from __future__ import annotations

from protocol.link_messages import MAX_SCAN

LEAST_ELECTRODES, MOST_ELECTRODES = 4, 64
MOST_MEASUREMENTS = MAX_SCAN
"""Of a board's scan list. With 496 a scan takes 180 ms, and the estimate of a touch 70 to 95 ms of one core, at most
0.2 s; with 928 (32 electrodes, adjacent) a scan 337 ms, the estimate 300 to 410 ms, at most 0.9 s: later than the next
scan."""
SMALLEST_M, LARGEST_M = 5e-3, 3.0
"""A skin's longer side; beyond it a length was given in another unit than is said."""
NAME = r"[A-Za-z0-9_.-]{1,64}"
"""Of a skin or a bundle: it becomes a folder's."""
MOST_PIXELS = 256
"""Along a side of the matrices' image."""
BUNDLE_BYTES = 8 * 1024 * 1024
NETWORKS_BYTES = 4_150_000
"""Of that, what the networks take that a training makes."""
