"""The publisher process: contacts, forces, shapes. `python -m services.publisher`; the stage is in publishing.py."""

import importlib
import sys
import threading

from services.process import main, stages
from services.pipeline import publishing
from services.runner import Runner


def run(runner: Runner) -> None:
    """Contacts flow before the first touch needs the tracker's library, which is as slow to import as all the rest."""
    stages(publishing)(runner)
    threading.Thread(target=importlib.import_module, args=("scipy.optimize",), daemon=True).start()


if __name__ == "__main__":
    sys.exit(main("publisher", run))
