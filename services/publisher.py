"""The publisher process: contacts, forces, shapes. `python -m services.publisher`; the stage is in publishing.py."""

import sys

from services.process import main, stages
from services.touch_publishing import TouchPublishing

if __name__ == "__main__":
    sys.exit(main("publisher", stages(TouchPublishing)))
