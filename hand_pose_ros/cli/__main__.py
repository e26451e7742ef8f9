"""`python -m hand_pose_ros.cli`: the same as `hand-pose`."""

import sys

from hand_pose_ros.cli import main

if __name__ == '__main__':
    sys.exit(main())
