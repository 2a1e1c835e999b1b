"""The bridge to Foxglove as a process: `python -m bridges.foxglove`, which `skin bridge foxglove` starts."""

import sys

from bridges.foxglove.bridge import FoxgloveBridge
from bridges.process import main

if __name__ == "__main__":
    sys.exit(main("foxglove", FoxgloveBridge))
