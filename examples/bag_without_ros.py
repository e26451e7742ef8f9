#!/usr/bin/env python3
"""The joints of every depth image of a bag (ROS 1, sqlite3 or MCAP) as CSV, without ROS.

    python examples/bag_without_ros.py demo/hand.mcap > joints.csv
"""

import csv
import os
import sys

from hand_pose_ros.bags import DepthBag
from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.estimator import HandPoseEstimator


def main() -> None:
    estimator = HandPoseEstimator.from_pretrained(max_hands=2)
    table = csv.writer(sys.stdout)
    # With several depth topics, or without camera_info: DepthBag(path, depth_topic=..., intrinsics=(fx, fy, cx, cy))
    with DepthBag(sys.argv[1]) as bag:
        table.writerow(['stamp_ns', 'frame_id', 'hand', 'side', 'joint', 'x_m', 'y_m', 'z_m', 'confidence'])
        for frame in bag:
            for hand in estimator(frame.depth, frame.intrinsics, time_s=frame.stamp_ns / 1e9):
                for name, point, confidence in zip(hand.joint_names, hand.joints, hand.confidence, strict=True):
                    table.writerow([frame.stamp_ns, frame.frame_id, hand.id, hand.side, name,
                                    *(f'{value:.4f}' for value in point), f'{confidence:.2f}'])
    sys.stdout.flush()


if __name__ == '__main__':
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main()
    except BrokenPipeError:  # nobody reads on, as after | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except HandPoseError as error:
        sys.exit(str(error))
