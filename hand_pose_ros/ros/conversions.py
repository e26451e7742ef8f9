"""Hand estimates to messages and back. Pure functions; numpy becomes plain Python, because messages check types."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import Header

from hand_pose_ros.estimator import HandEstimate, Side
from hand_pose_ros.geometry import Cube
from hand_pose_ros.msg import HandJoints, HandJointsArray, HandSkeleton
from hand_pose_ros.skeleton import Skeleton

SIDES: dict[Side, int] = {'unknown': HandJoints.UNKNOWN, 'left': HandJoints.LEFT, 'right': HandJoints.RIGHT}
_SIDE_NAMES = {number: side for side, number in SIDES.items()}


def stamp_ns(header: Header) -> int:
    """The stamp of a header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def hands_to_msg(header: Header, hands: Sequence[HandEstimate], skeleton: Skeleton) -> HandJointsArray:
    """All hands of one image; `header` is that of the image, and is copied as it is."""
    return HandJointsArray(header=header, skeleton=skeleton.name, hands=[hand_to_msg(hand) for hand in hands])


def hand_to_msg(hand: HandEstimate) -> HandJoints:
    """One hand, in metres in the optical frame of the camera."""
    return HandJoints(
        id=hand.id, side=SIDES[hand.side], score=float(hand.score),
        joints=[Point(x=x, y=y, z=z) for x, y, z in hand.joints.tolist()],
        confidence=array('f', hand.confidence.tolist()),
        cube_center=Point(**{axis: float(value) for axis, value in zip('xyz', hand.cube.center, strict=True)}),
        cube_size=float(hand.cube.side))


def hand_from_msg(message: HandJoints, skeleton: Skeleton) -> HandEstimate:
    """The inverse of `hand_to_msg`.

    Raises:
        InputError: the cube of the message is none.
    """
    center = message.cube_center
    return HandEstimate(
        joints=np.array([(point.x, point.y, point.z) for point in message.joints], np.float32).reshape(-1, 3),
        joint_names=skeleton.joint_names, confidence=np.array(message.confidence, np.float32), score=message.score,
        side=_SIDE_NAMES.get(message.side, 'unknown'), cube=Cube((center.x, center.y, center.z), message.cube_size),
        id=message.id)


def skeleton_to_msg(header: Header, skeleton: Skeleton, model: str, model_version: str) -> HandSkeleton:
    """What the joints mean; published once, latched."""
    return HandSkeleton(header=header, name=skeleton.name, joint_names=list(skeleton.joint_names),
                        parents=array('b', skeleton.parents), model=model, model_version=model_version)
