"""Hands as markers for RViz and Foxglove: joints, bones coloured per finger, and the cube that was searched."""

from __future__ import annotations

from itertools import combinations, product

from geometry_msgs.msg import Point, Vector3
from rclpy.duration import Duration
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from hand_pose_ros.drawing import FINGER_COLORS
from hand_pose_ros.msg import HandJoints, HandJointsArray
from hand_pose_ros.skeleton import Skeleton

PARTS = ('joints', 'bones', 'cube')
"""The markers of a hand: namespace `<id of the hand>/<part>`, marker id 0."""
JOINT_DIAMETER_M, BONE_WIDTH_M, CUBE_LINE_M = 0.009, 0.005, 0.001

_CORNERS = list(product((-0.5, 0.5), repeat=3))
_EDGES = [(a, b) for a, b in combinations(_CORNERS, 2) if sum(p != q for p, q in zip(a, b, strict=True)) == 1]


class HandMarkers:
    """Markers of consecutive images; remembers what it has shown, so that a lost hand is deleted at once.

    Deleting only what is gone, instead of everything in each message, is what keeps viewers from flickering.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._shown: set[str] = set()
        colors = [_color(FINGER_COLORS[finger]) for finger in skeleton.fingers]
        self._joint_colors = colors
        # A bone belongs to the finger at its far end: the one from the wrist to the thumb is the thumb's.
        self._bone_colors = [colors[child] for _, child in skeleton.bones for _ in range(2)]

    def update(self, hands: HandJointsArray, lifetime_s: float) -> MarkerArray:
        """Markers of the hands of an image, and deletions of the hands that were there before and are not now.

        Args:
            lifetime_s: after how long without news a viewer removes a marker by itself; 0 = never.
        """
        lifetime = Duration(seconds=lifetime_s).to_msg()
        markers = []
        for hand in hands.hands:
            for marker in (self._joints(hand), self._bones(hand), _cube(hand)):
                marker.header, marker.lifetime = hands.header, lifetime
                marker.pose.orientation.w = 1.0
                markers.append(marker)
        ids = {hand.id for hand in hands.hands}
        lost, self._shown = self._shown - ids, ids
        return MarkerArray(markers=[*_deletions(hands.header, lost), *markers])

    def clear(self, header: Header) -> MarkerArray:
        """Deletions of everything that is shown."""
        lost, self._shown = self._shown, set()
        return MarkerArray(markers=_deletions(header, lost))

    def _joints(self, hand: HandJoints) -> Marker:
        return Marker(ns=f'{hand.id}/joints', type=Marker.SPHERE_LIST, scale=_cubic(JOINT_DIAMETER_M),
                      points=hand.joints, colors=self._joint_colors)

    def _bones(self, hand: HandJoints) -> Marker:
        return Marker(ns=f'{hand.id}/bones', type=Marker.LINE_LIST, scale=Vector3(x=BONE_WIDTH_M),
                      points=[hand.joints[end] for bone in self._skeleton.bones for end in bone],
                      colors=self._bone_colors)


def _cube(hand: HandJoints) -> Marker:
    c, size = hand.cube_center, hand.cube_size
    return Marker(ns=f'{hand.id}/cube', type=Marker.LINE_LIST, scale=Vector3(x=CUBE_LINE_M),
                  color=ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.6),
                  points=[Point(x=c.x + x * size, y=c.y + y * size, z=c.z + z * size)
                          for edge in _EDGES for x, y, z in edge])


def _deletions(header: Header, ids: set[str]) -> list[Marker]:
    return [Marker(header=header, ns=f'{hand}/{part}', action=Marker.DELETE) for hand in sorted(ids) for part in PARTS]


def _cubic(size: float) -> Vector3:
    return Vector3(x=size, y=size, z=size)


def _color(rgb: tuple[int, int, int]) -> ColorRGBA:
    r, g, b = (value / 255 for value in rgb)
    return ColorRGBA(r=r, g=g, b=b, a=1.0)
