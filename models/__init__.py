"""Offline: geometry, forward model, data, networks, bundles."""

import sys

_usual = sys.excepthook
sys.excepthook = lambda kind, *rest: None if kind is KeyboardInterrupt else _usual(kind, *rest)  # Ctrl-C: no traceback
