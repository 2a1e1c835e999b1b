"""The publisher process: contacts, forces, shapes. `python -m services.publisher`; the stage is
services/publishing.py.
"""

import sys

from services.publishing import Publishing
from services.runner import main, stages

if __name__ == "__main__":
    sys.exit(main("publisher", stages(Publishing)))
