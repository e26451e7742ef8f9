#!/usr/bin/env python3
"""Print where the node sees the tip of the index finger.

    ros2 run hand_pose_ros estimator         # or: hand-pose estimator
    python examples/subscribe.py

It needs ROS 2, for example from pip install '.[ros]'. If there is only compressed depth, as in demo/hand.mcap, start
the node with --ros-args -p transport:=compressedDepth.
"""

import os
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from hand_pose_ros.errors import HandPoseError
from hand_pose_ros.hand import side_of
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import init, shutdown
from hand_pose_ros.skeleton import get_skeleton


class Listener(Node):
    """Listens to hand/joints. To listen to another topic: --ros-args -r hand/joints:=/your/hand/joints."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.create_subscription(HandJointsArray, 'hand/joints', self.on_hands, 10)

    def on_hands(self, message: HandJointsArray) -> None:
        """Called for every image that the node processed. Without a hand, the list is empty."""
        if not message.hands:
            print('no hand', flush=True)
        for hand in message.hands:
            index_tip = get_skeleton(message.skeleton).joint_names.index('index_tip')  # models have different joints
            # Metres, in the frame message.header.frame_id: x right, y down, z forward, unless target_frame is set.
            tip = hand.joints[index_tip]
            print(f'{hand.id} {side_of(hand.side):<7} index tip at {tip.x:+.3f} {tip.y:+.3f} {tip.z:.3f} m, '
                  f'confidence {hand.confidence[index_tip]:.2f}', flush=True)


def main() -> None:
    init()  # rclpy.init(), whose errors it explains
    try:
        rclpy.spin(Listener())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except BrokenPipeError:  # nobody reads on, as after | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except HandPoseError as error:
        sys.exit(f'hand/joints: {error}')
    finally:
        shutdown()


if __name__ == '__main__':
    try:
        main()
    except HandPoseError as error:
        sys.exit(str(error))
