"""Robot controllers that act on contacts, small enough to read in one go. Against the demo (`make up`):

    .venv/bin/python -m examples.stop_on_contact      # and in another terminal ./skin press --x 0.02 --y 0 --force 3

They import from `protocol`, being run from the checkout; with the wheel installed write `eitskin` for it.
"""

import sys

_usual = sys.excepthook
sys.excepthook = lambda kind, *rest: None if kind is KeyboardInterrupt else _usual(kind, *rest)  # Ctrl-C: no traceback
