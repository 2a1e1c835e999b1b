"""A program for the supervisor's tests: notes its start in a file, then waits; with `fail`, ends at once."""

import sys
import time

with open(sys.argv[1], "a") as log:
    log.write(f"{time.monotonic()}\n")
if sys.argv[2:] == ["fail"]:
    sys.exit(3)
time.sleep(600)
