"""`hand-pose estimator`: the ROS 2 node, for machines without the `ros2` command."""

from __future__ import annotations

import argparse

DESCRIPTION = 'Run the ROS 2 node until Ctrl-C.'

EXAMPLES = """examples:
  hand-pose estimator
  hand-pose estimator --ros-args -r depth/image_rect:=/camera/camera/depth/image_rect_raw
  hand-pose estimator --ros-args -p transport:=compressedDepth -p side:=right
  hand-pose estimator --ros-args --params-file estimator.yaml

Depth images come in on depth/image_rect, with depth/camera_info; joints go out on hand/joints.
"""

HINT = 'parameters are set with --ros-args -p NAME:=VALUE; --parameters lists them'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the verb takes."""
    parser.add_argument('--ros-args', nargs=argparse.REMAINDER, default=[], metavar='...',
                        help='remappings (-r from:=to) and parameters (-p name:=value), as for ros2 run')
    parser.add_argument('--parameters', action='store_true', help='print the table of parameters and exit')


def run(args: argparse.Namespace) -> int:
    """Run the node until Ctrl-C, which is no error.

    Raises:
        HandPoseError: there is no ROS, or a parameter is wrong.
    """
    if args.parameters:
        from hand_pose_ros.ros.params import markdown_table
        print(markdown_table())
        return 0
    try:
        from hand_pose_ros.ros.node import main
        return main(['--ros-args', *args.ros_args])
    except KeyboardInterrupt:  # while it was loading
        return 0
