"""The live page as a process: `python -m bridges.page`, which `skin up` and `skin bridge page` start."""

import sys

from bridges.page.bridge import PageBridge
from bridges.process import main

if __name__ == "__main__":
    sys.exit(main("page", PageBridge))
