"""The bridge to ROS 2 as a process: `python -m bridges.ros2`, which `skin bridge ros2` starts."""

import sys

from bridges.process import main
from bridges.ros2.bridge import Ros2Bridge

if __name__ == "__main__":
    sys.exit(main("ros2", Ros2Bridge))
