"""Hands as markers for viewers: joints, bones coloured per finger, and the cube that was searched.

Plain data: `ros.conversions` makes visualization_msgs of it, and `bags.BagWriter` writes it where there is no ROS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from hand_pose_ros.drawing import FINGER_COLORS
from hand_pose_ros.hand import HandEstimate
from hand_pose_ros.skeleton import Skeleton

ADD, DELETE = 0, 2
LINE_LIST, SPHERE_LIST = 5, 7
"""Constants of visualization_msgs/Marker."""

PARTS = ('joints', 'bones', 'cube')
"""The markers of a hand: namespace `<id of the hand>/<part>`, marker id 0."""
JOINT_DIAMETER_M, BONE_WIDTH_M, CUBE_LINE_M = 0.009, 0.005, 0.001

Color = tuple[float, float, float, float]
"""Red, green, blue, alpha in [0, 1]."""
_GREY = (0.6, 0.6, 0.6, 0.6)
_CORNERS = list(product((-0.5, 0.5), repeat=3))
_EDGES = np.array([(a, b) for a, b in combinations(_CORNERS, 2)
                   if sum(p != q for p, q in zip(a, b, strict=True)) == 1]).reshape(-1, 3)


@dataclass(frozen=True)
class Marker:
    """One visualization_msgs/Marker. Its pose is the identity.

    Attributes:
        namespace: with it, a later marker replaces or deletes this one.
        action: ADD or DELETE. All that follows is for ADD.
        type: SPHERE_LIST, or LINE_LIST with two points for each line.
        scale: diameter along x, y and z, or width of the lines in x; metres.
        points: (N, 3) metres, in the frame of the image.
        colors: one for each point.
    """

    namespace: str
    action: int = ADD
    type: int = SPHERE_LIST
    scale: tuple[float, float, float] = (0.0, 0.0, 0.0)
    points: NDArray[np.floating] = field(default_factory=lambda: np.empty((0, 3)))
    colors: tuple[Color, ...] = ()


class HandMarkers:
    """Markers of consecutive images. A lost hand is deleted at once.

    Only what is gone is deleted. If each message deleted everything, viewers would flicker.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        self._shown: set[str] = set()
        self._bones = np.array(skeleton.bones).reshape(-1)
        self._joint_colors = tuple(_color(FINGER_COLORS[finger]) for finger in skeleton.fingers)
        # A bone belongs to the finger at its far end, for example that from the wrist to the thumb.
        self._bone_colors = tuple(self._joint_colors[child] for _, child in skeleton.bones for _ in range(2))

    def update(self, hands: Sequence[HandEstimate]) -> list[Marker]:
        """Deletions of the hands that were there before and are not now, and markers of the hands of an image."""
        ids = {hand.id for hand in hands}
        lost, self._shown = sorted(self._shown - ids), ids
        return [*(Marker(f'{hand}/{part}', DELETE) for hand in lost for part in PARTS),
                *(marker for hand in hands for marker in self._show(hand))]

    def clear(self) -> list[Marker]:
        """Deletions of everything that is shown."""
        return self.update(())

    def _show(self, hand: HandEstimate) -> tuple[Marker, ...]:
        joints, bones, cube = (f'{hand.id}/{part}' for part in PARTS)
        corners = np.array(hand.cube.center) + _EDGES * hand.cube.side
        return (Marker(joints, ADD, SPHERE_LIST, (JOINT_DIAMETER_M,) * 3, hand.joints, self._joint_colors),
                Marker(bones, ADD, LINE_LIST, (BONE_WIDTH_M, 0.0, 0.0), hand.joints[self._bones], self._bone_colors),
                Marker(cube, ADD, LINE_LIST, (CUBE_LINE_M, 0.0, 0.0), corners, (_GREY,) * len(corners)))


def _color(rgb: tuple[int, int, int]) -> Color:
    r, g, b = (value / 255 for value in rgb)
    return r, g, b, 1.0
