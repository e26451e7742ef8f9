"""Hand estimates -> messages. Pure functions; numpy becomes plain Python here, because messages check types."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

from geometry_msgs.msg import Point
from std_msgs.msg import Header

from hand_pose_ros.estimator import HandEstimate
from hand_pose_ros.msg import HandJoints, HandJointsArray, HandSkeleton
from hand_pose_ros.skeleton import Skeleton

SIDES = {'unknown': HandJoints.UNKNOWN, 'left': HandJoints.LEFT, 'right': HandJoints.RIGHT}


def stamp_ns(header: Header) -> int:
    """The stamp of a header in nanoseconds."""
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def hands_to_msg(header: Header, hands: Sequence[HandEstimate], skeleton: Skeleton) -> HandJointsArray:
    """All hands of one image; `header` is that of the image, and is copied as it is."""
    return HandJointsArray(header=header, skeleton=skeleton.name, hands=[hand_to_msg(hand) for hand in hands])


def hand_to_msg(hand: HandEstimate) -> HandJoints:
    """One hand, in metres in the optical frame of the camera."""
    center = Point(**{axis: float(value) for axis, value in zip('xyz', hand.cube.center, strict=True)})
    return HandJoints(
        id=str(hand.id), side=SIDES[hand.side], score=float(hand.score),
        joints=[Point(x=x, y=y, z=z) for x, y, z in hand.joints.tolist()],
        confidence=array('f', hand.confidence.tolist()),
        cube_center=center, cube_size=float(hand.cube.side))


def skeleton_to_msg(header: Header, skeleton: Skeleton, model: str, model_version: str) -> HandSkeleton:
    """What the joints mean; published once, latched."""
    return HandSkeleton(header=header, name=skeleton.name, joint_names=list(skeleton.joint_names),
                        parents=array('b', skeleton.parents), model=model, model_version=model_version)
