#!/usr/bin/env python3
"""Open and close a ros2_control gripper as the hand opens and closes. The command follows from the finger angles.

    python examples/gripper.py --ros-args -r gripper/commands:=/gripper_controller/commands -p max_opening:=0.08

Start the node first, as for examples/subscribe.py: this script listens to it. The command is the opening in metres, as
a forward_command_controller expects it. If there are several hands, the script follows one of them until it is gone,
and then the one with the highest score. Without a hand that it can trust, the gripper does not move. The script assumes
that the gripper is open at the start: open it first.
"""

import sys

import numpy as np
import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from hand_pose_ros.angles import ANGLES, finger_angles
from hand_pose_ros.errors import HandPoseError, InputError
from hand_pose_ros.hand import side_of
from hand_pose_ros.msg import HandJointsArray
from hand_pose_ros.ros import init, shutdown
from hand_pose_ros.skeleton import HAND21

PIP = [ANGLES.index(f'{finger}_pip_flexion') for finger in ('index', 'middle', 'ring', 'pinky')]
FIST_RAD = 1.4
"""In a fist, the middle joint of a finger is bent by at least this angle."""
MIN_SCORE = 0.5
SPEED = 0.2
"""Maximum speed in metres per second. One wrong estimate must not slam the gripper."""


def closing(joints: np.ndarray, side: str) -> float:
    """Joints of hand21 (21, 3) -> 0 for an open hand, 1 for a fist. The median of the fingers counts."""
    return float(np.clip(np.median(finger_angles(joints, side)[PIP]) / FIST_RAD, 0, 1))


class Gripper(Node):
    def __init__(self) -> None:
        super().__init__('gripper')
        descriptor = ParameterDescriptor(dynamic_typing=True, read_only=True)  # 1 is as good as 1.0
        self.max_opening = self.declare_parameter('max_opening', 0.08, descriptor).value
        if type(self.max_opening) not in (int, float) or not 0 < self.max_opening < np.inf:
            raise InputError(f'max_opening is {self.max_opening!r}: give metres, such as 0.08')
        self.opening, self.moved = self.max_opening, self.get_clock().now()
        self.followed = ''  # id of a hand
        self.commands = self.create_publisher(Float64MultiArray, 'gripper/commands', 10)
        self.create_subscription(HandJointsArray, 'hand/joints', self.on_hands, 10)

    def on_hands(self, message: HandJointsArray) -> None:
        if message.skeleton != HAND21.name:
            self.get_logger().error(f"hand/joints has the joints of '{message.skeleton}': start the node with a model "
                                    'of hand21, such as the default', once=True)
            return
        # Two hands have nearly the same score. With the score alone, the gripper would switch between them.
        hand = max(message.hands, key=lambda hand: (hand.id == self.followed, hand.score), default=None)
        if hand is None or hand.score < MIN_SCORE or side_of(hand.side) == 'unknown':
            return
        self.followed = hand.id
        joints = np.array([(point.x, point.y, point.z) for point in hand.joints])
        wanted = self.max_opening * (1 - closing(joints, side_of(hand.side)))
        now = self.get_clock().now()
        # Clocks jump: back when a bag starts again, and far ahead after a pause.
        reach = SPEED * np.clip((now - self.moved).nanoseconds / 1e9, 0, 0.1)
        step = np.clip(wanted - self.opening, -reach, reach)
        self.opening = float(np.clip(self.opening + step, 0, self.max_opening))
        self.moved = now
        self.commands.publish(Float64MultiArray(data=[self.opening]))
        self.get_logger().info(f'opening {self.opening:.3f} m', throttle_duration_sec=1.0)


def main() -> None:
    init()  # rclpy.init(), whose errors it explains
    try:
        rclpy.spin(Gripper())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        shutdown()


if __name__ == '__main__':
    try:
        main()
    except HandPoseError as error:
        sys.exit(str(error))
