"""Hand estimates to messages and back. Pure functions. numpy becomes plain Python, because messages check types."""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseArray, TransformStamped, Vector3
from numpy.typing import ArrayLike, NDArray
from rclpy.duration import Duration
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from hand_pose_ros.angles import ANGLES, finger_angles
from hand_pose_ros.errors import InputError
from hand_pose_ros.geometry import Cube
from hand_pose_ros.hand import SIDES, HandEstimate, side_of
from hand_pose_ros.markers import Color
from hand_pose_ros.markers import Marker as HandMarker
from hand_pose_ros.msg import HandJoints, HandJointsArray, HandSkeleton
from hand_pose_ros.skeleton import Skeleton


def hands_to_msg(header: Header, hands: Sequence[HandEstimate], skeleton: Skeleton) -> HandJointsArray:
    """All hands of one image. `header` is the header of the image, and is copied unchanged."""
    return HandJointsArray(header=header, skeleton=skeleton.name, hands=[hand_to_msg(hand) for hand in hands])


def hand_to_msg(hand: HandEstimate) -> HandJoints:
    """One hand, in metres in the optical frame of the camera."""
    return HandJoints(
        id=hand.id, side=SIDES.index(hand.side), score=float(hand.score),
        joints=_points(hand.joints), confidence=array('f', hand.confidence.tolist()),
        cube_center=_points([hand.cube.center])[0], cube_size=float(hand.cube.side))


def hand_from_msg(message: HandJoints, skeleton: Skeleton) -> HandEstimate:
    """The inverse of `hand_to_msg`.

    Raises:
        InputError: the number of joints is not that of the skeleton, or the cube is not in front of the camera.
    """
    joints, confidences = len(message.joints), len(message.confidence)
    if not joints == confidences == len(skeleton):
        raise InputError(f'a hand has {joints} joints and {confidences} confidences, but {skeleton.name} has '
                         f'{len(skeleton)}: publish as many, or name another skeleton')
    center = message.cube_center
    return HandEstimate(
        joints=np.array([(point.x, point.y, point.z) for point in message.joints], np.float32),
        joint_names=skeleton.joint_names, confidence=np.array(message.confidence, np.float32), score=message.score,
        side=side_of(message.side), cube=Cube((center.x, center.y, center.z), message.cube_size),
        id=message.id)


def skeleton_to_msg(header: Header, skeleton: Skeleton, model: str, model_version: str) -> HandSkeleton:
    """What the joints mean."""
    return HandSkeleton(header=header, name=skeleton.name, joint_names=list(skeleton.joint_names),
                        parents=array('b', skeleton.parents), model=model, model_version=model_version)


def markers_to_msg(header: Header, markers: Sequence[HandMarker], lifetime_s: float) -> MarkerArray:
    """The markers of an image.

    Args:
        lifetime_s: seconds without news after which a viewer removes a marker by itself; 0 = never.
    """
    lifetime = Duration(seconds=lifetime_s).to_msg()
    messages = []
    for marker in markers:
        x, y, z = marker.scale
        messages.append(Marker(
            header=header, ns=marker.namespace, type=marker.type, action=marker.action, lifetime=lifetime,
            scale=Vector3(x=x, y=y, z=z), points=_points(marker.points), colors=_colors(marker.colors)))
    return MarkerArray(markers=messages)


def in_frame(hands: HandJointsArray, transform: TransformStamped) -> HandJointsArray:
    """The same hands, in metres, in the target frame of the transform. The stamp stays the same."""
    t, q = transform.transform.translation, transform.transform.rotation
    rotation = Rotation.from_quat((q.x, q.y, q.z, q.w))

    def moved(points: Sequence[Point]) -> list[Point]:
        return _points(rotation.apply([(p.x, p.y, p.z) for p in points]) + np.array([t.x, t.y, t.z]))

    return HandJointsArray(
        header=Header(stamp=hands.header.stamp, frame_id=transform.header.frame_id), skeleton=hands.skeleton,
        hands=[HandJoints(id=hand.id, side=hand.side, score=hand.score, joints=moved(hand.joints),
                          confidence=hand.confidence, cube_center=moved([hand.cube_center])[0],
                          cube_size=hand.cube_size) for hand in hands.hands])


def poses_to_msg(hands: HandJointsArray) -> PoseArray:
    """The joints of all hands, one hand after the other, as poses without rotation. For tools without our messages."""
    return PoseArray(header=hands.header, poses=[Pose(position=joint) for hand in hands.hands for joint in hand.joints])


def prefixes(hands: Sequence[HandEstimate]) -> list[str]:
    """Prefixes for the joint names of each hand: l_ or r_. If that is taken or the side is unknown, the id and _."""
    names: list[str] = []
    for hand in hands:
        prefix = {'left': 'l_', 'right': 'r_'}.get(hand.side, '')
        names.append(prefix if prefix and prefix not in names else f'{hand.id}_')
    return names


def joint_states_to_msg(header: Header, hands: Sequence[HandEstimate]) -> JointState:
    """The finger angles (see `hand_pose_ros.angles`) in radians, for example of r_index_mcp_flexion.

    Hands of unknown side are left out, because what is flexion on one side is extension on the other.
    """
    told = [(prefix, hand) for prefix, hand in zip(prefixes(hands), hands, strict=True) if hand.side != 'unknown']
    return JointState(
        header=header, name=[f'{prefix}{angle}' for prefix, _ in told for angle in ANGLES],
        position=array('d', [x for _, hand in told for x in finger_angles(hand.joints, hand.side).tolist()]))


def transforms_to_msgs(header: Header, hands: Sequence[HandEstimate], namespace: str = '/') -> list[TransformStamped]:
    """A frame for each joint, for example r_index_tip: a child of the frame of the image, without rotation.

    If the node has a namespace, for example /left, the name is left/r_index_tip, because all nodes share one /tf.
    """
    messages, above = [], f'{namespace}/'.lstrip('/')
    for prefix, hand in zip(prefixes(hands), hands, strict=True):
        for name, (x, y, z) in zip(hand.joint_names, hand.joints.tolist(), strict=True):
            message = TransformStamped(header=header, child_frame_id=f'{above}{prefix}{name}')
            message.transform.translation = Vector3(x=x, y=y, z=z)
            messages.append(message)
    return messages


def patch_to_msg(header: Header, patch: NDArray[np.float32]) -> Image:
    """What a network sees, (1, H, W) in [-1, 1], as a 32FC1 image. -1 is the front of the cube, 1 the back or nothing.
    """
    _, height, width = patch.shape
    return Image(header=header, height=height, width=width, encoding='32FC1', step=4 * width,
                 is_bigendian=sys.byteorder == 'big', data=array('B', patch.tobytes()))


def _points(points: ArrayLike) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in np.asarray(points).tolist()]


@lru_cache
def _colors(colors: tuple[Color, ...]) -> list[ColorRGBA]:
    return [ColorRGBA(r=r, g=g, b=b, a=a) for r, g, b, a in colors]
